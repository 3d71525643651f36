"""`prepare`: from images, or cameras that another program found, to a scene folder to train on."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes.drawing import draw_cameras
from gridreg.scenes.extent import Extent, box_is_seen, camera_extent, points_extent
from gridreg.scenes.frames import Frame, StatedIntrinsics
from gridreg.scenes.load import NotASceneError, read_folder
from gridreg.scenes.own_images import (
    attach_masks,
    copy_frames,
    copy_images,
    find_cameras,
    shrink_images,
)
from gridreg.scenes.transforms import EXTENT_KEY

__all__ = ["Prepared", "prepare"]

Array = NDArray[np.float64]

_HALF_EDGE = 1.3


@dataclass(frozen=True)
class Prepared:
    """Result of :func:`prepare`; printed, it is described in two lines.

    Attributes:
        folder: the scene folder.
        registered: names of the images that have a camera.
        missing: names of the images that have none.
        extent: near, far and box, world units.
        drawing: the drawing of cameras and box.
    """

    folder: Path
    registered: tuple[str, ...]
    missing: tuple[str, ...]
    extent: Extent
    drawing: Path

    def __str__(self) -> str:
        low, high = self.extent.bounds.round(3).tolist()
        total = len(self.registered) + len(self.missing)
        without = f" (not {', '.join(self.missing)})" if self.missing else ""
        return (
            f"{self.folder}: {len(self.registered)} of {total} images have cameras{without}\n"
            f"near {self.extent.near:.3f}, far {self.extent.far:.3f}, box {low} to {high}; see {self.drawing}"
        )


def prepare(
    source: str | Path,
    out: str | Path,
    *,
    masks: str | Path | None = None,
    near: float | None = None,
    far: float | None = None,
    bounds: Sequence[Sequence[float]] | None = None,
    longest_edge: int = 800,
    progress: Callable[[str], None] = lambda stage: None,
) -> Prepared:
    """Make a scene folder: upright images, ``transforms.json``, and a drawing of the cameras and the box.

    The world is turned so that the cameras' mean up is z, centred on the box, and scaled so that the box
    reaches 1.3 to each side, the size at which the presets are at home. Near, far and box are written along
    and can be overridden when the scene is loaded.

    Args:
        source: a folder of images (JPEG or PNG, one size; pycolmap finds the cameras), or a scene whose
            cameras COLMAP, nerfstudio or instant-ngp found.
        out: the scene folder to make; must not exist.
        masks: folder with a mask for every image (white is kept), which becomes its alpha: called like the
            image, with the extension ``.png`` instead of its own or after it.
        near: distance from a camera where looking begins, world units of the made scene, instead of the derived one.
        far: distance from a camera where looking ends, likewise.
        bounds: ``(2, 3)`` lower and upper corner, likewise; the world stays turned, centred and scaled as derived.
        longest_edge: pixels; larger images are reduced (by area) once their cameras are known, as the photographs
            of a telephone would fill the memory and show no more than the grid can hold.
        progress: called with the name of each stage.

    Raises:
        InputError: for no, damaged or differently sized images, too few that could be registered, pycolmap
            missing, a mask missing, near, far or box that hold nothing, or a folder ``out`` that exists or
            cannot be written.
    """
    source, out = Path(source), Path(out)
    if not source.is_dir():
        raise InputError(f"{source}: no such folder of images")
    if out.exists():
        raise InputError(f"{out}: exists already, expected the name of a new folder")
    if longest_edge < 8:
        raise InputError(f"longest_edge: found {longest_edge}, expected at least 8 pixels")
    scratch: Path | None = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
        scene = scratch / "scene"
        (scene / "images").mkdir(parents=True)
        frames, points, names = _gather(source, scene, scratch, progress)
        if masks is not None:
            frames = attach_masks(frames, Path(masks), scene)
        progress("box")
        frames, extent = _write(
            frames, points, scene, longest_edge, lambda derived: _overridden(derived, near, far, bounds)
        )
        scene.rename(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from None
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
    registered = tuple(Path(frame.file_path).name for frame in frames)
    missing = tuple(name for name in names if name not in registered)
    return Prepared(out, registered, missing, extent, out / "cameras.png")


def _gather(
    source: Path, scene: Path, scratch: Path, progress: Callable[[str], None]
) -> tuple[list[Frame], Array | None, list[str]]:
    """Fill ``scene/images``; return frames, points and the names of all images."""
    try:
        files = read_folder(source)
    except NotASceneError:
        names = copy_images(source, scene)
        frames, points = find_cameras(scene, names, scratch, progress)
        return frames, points, names
    if files.ndc or not files.split_here:
        raise InputError(f"{source}: needs no preparation, load it as it is")
    frames = copy_frames(files, scene)
    return frames, files.points, [Path(frame.file_path).name for frame in frames]


def _overridden(
    extent: Extent, near: float | None, far: float | None, bounds: Sequence[Sequence[float]] | None
) -> Extent:
    box = extent.bounds if bounds is None else np.array(bounds, dtype=np.float64)
    wanted = Extent(extent.near if near is None else near, extent.far if far is None else far, box)
    if not 0 <= wanted.near < wanted.far < np.inf:
        raise InputError(f"near, far: found {wanted.near:g} and {wanted.far:g}, expected 0 <= near < far")
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise InputError(f"box: found {box.tolist()}, expected (2, 3) with lower corner below upper")
    return wanted


def _write(
    frames: list[Frame],
    points: Array | None,
    scene: Path,
    longest_edge: int,
    override: Callable[[Extent], Extent],
) -> tuple[list[Frame], Extent]:
    """Write ``transforms.json`` and ``cameras.png`` in normalised coordinates."""
    with Image.open(scene / frames[0].file_path) as image:
        size = image.size
    intrinsics = np.array([frame.camera.intrinsics(*size) for frame in frames])
    poses = np.stack([frame.pose for frame in frames])
    turn = _upwards(poses[:, :3, 1].mean(axis=0))
    poses[:, :3] = turn @ poses[:, :3]
    points = None if points is None else points @ turn.T
    masked = any(frame.mask_path for frame in frames)
    # Points of a masked scene may lie on what the masks cut away.
    extent = (
        camera_extent(poses, intrinsics, size) if points is None or masked else points_extent(poses, points)
    )
    centre = extent.bounds.mean(axis=0)
    scale = _HALF_EDGE / float((extent.bounds[1] - centre).max())
    poses[:, :3, 3] = scale * (poses[:, :3, 3] - centre)
    extent = override(Extent(scale * extent.near, scale * extent.far, scale * (extent.bounds - centre)))
    if not box_is_seen(extent, poses, intrinsics, size):
        raise InputError(
            f"box: no camera sees the box {extent.bounds.tolist()} between near {extent.near:g} and far {extent.far:g}"
        )
    frames = [replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True)]
    content = {EXTENT_KEY: {"near": extent.near, "far": extent.far, "bounds": extent.bounds.tolist()}}
    reduced = shrink_images(frames, scene, size, longest_edge)
    cameras = [_camera_keys(frame.camera, size, reduced) for frame in frames]
    shared = cameras[0] if all(camera == cameras[0] for camera in cameras) else {}
    listed = [
        {
            "file_path": frame.file_path,
            **({"mask_path": frame.mask_path} if frame.mask_path else {}),
            **({} if shared else camera),
            "transform_matrix": frame.pose.tolist(),
        }
        for frame, camera in zip(frames, cameras, strict=True)
    ]
    text = json.dumps({**shared, **content, "frames": listed}, indent=2)
    (scene / "transforms.json").write_text(text + "\n", encoding="utf-8")
    shown = None if points is None else scale * (points - centre)
    draw_cameras(scene / "cameras.png", poses, intrinsics, size, extent.bounds, points=shown)
    return frames, extent


def _upwards(up: Array) -> Array:
    """Return the ``(3, 3)`` smallest rotation that takes ``up`` to z; none where the cameras' ups cancel."""
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        return np.eye(3)
    x, y, z = up / length
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula for the axis up x z, with sine and cosine from the two products.
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + z))


def _camera_keys(camera: StatedIntrinsics, size: tuple[int, int], reduced: tuple[int, int]) -> dict[str, Any]:
    """Return the keys of a camera for images of ``size`` that are now ``reduced``."""
    fx, fy, cx, cy = camera.intrinsics(*size)
    x, y = reduced[0] / size[0], reduced[1] / size[1]
    lens = {key: value for key, value in asdict(camera.distortion).items() if value}
    return {
        "w": reduced[0],
        "h": reduced[1],
        "fl_x": fx * x,
        "fl_y": fy * y,
        "cx": cx * x,
        "cy": cy * y,
        **lens,
    }
