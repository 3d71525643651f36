"""`prepare`: from images, or cameras that another program found, to a scene folder to train on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.machine import remove_left_behind, temporary_beside
from gridreg.scenes.auto_masks import MASKS, check_masks, cut_masks
from gridreg.scenes.board import Board
from gridreg.scenes.board_cameras import board_extent
from gridreg.scenes.crops import crop_to_one_size
from gridreg.scenes.drawing import draw_cameras
from gridreg.scenes.extent import Extent, box_is_seen, camera_extent, centred, points_extent
from gridreg.scenes.focus import focus_extent, surround_focus
from gridreg.scenes.frames import Frame, camera_keys
from gridreg.scenes.gate import check_cameras, check_extent, check_spread
from gridreg.scenes.images import read_rgba
from gridreg.scenes.load import NotASceneError, read_folder
from gridreg.scenes.own_images import (
    Copied,
    attach_masks,
    copy_frames,
    find_photographs,
    shrink_images,
)
from gridreg.scenes.photographs import is_video, sharpest_frames
from gridreg.scenes.silhouettes import backdrop_of, is_opaque
from gridreg.scenes.transforms import EXTENT_KEY
from gridreg.scenes.views import IN_PLACE, World

__all__ = ["Prepared", "prepare"]

Array = NDArray[np.float64]


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


@np.errstate(all="ignore")
def prepare(
    source: str | Path,
    out: str | Path,
    *,
    masks: str | Path = "auto",
    model: str | Path | None = None,
    near: float | None = None,
    far: float | None = None,
    bounds: Sequence[Sequence[float]] | None = None,
    longest_edge: int = 800,
    progress: Callable[[str], None] = lambda stage: None,
) -> Prepared:
    """Make a scene folder: upright images, ``transforms.json``, and a drawing of the cameras and the box.

    The world is turned so that the cameras' mean up is z, centred on the box, and scaled so that the box
    reaches 1.3 to each side, the size at which the presets are at home. On the sheet it is in metres, z is up,
    and the sheet's middle is the origin. Near, far and box are written along and can be overridden when the scene is
    loaded.

    Args:
        source: a folder of images, or a video, of which the sharpest frames are taken: the sheet of `gridreg board`
            gives the cameras where it is seen, else pycolmap; or a scene whose cameras COLMAP, nerfstudio or
            instant-ngp found. Images of several sizes are cut to one, those on the sheet to the object.
        out: the scene folder to make; must not exist.
        masks: folder with a mask for every image (white is kept), which becomes its alpha: called like the
            image, with the extension ``.png`` instead of its own or after it; or a way to cut them, see
            `gridreg.scenes.auto_masks.cut_masks`: ``auto``, ``none`` or ``rembg``.
        model: the network of ``rembg``, an ONNX file.
        near: distance from a camera where looking begins, world units of the made scene, instead of the
            derived one.
        far: distance from a camera where looking ends, likewise.
        bounds: ``(2, 3)`` lower and upper corner, likewise; the world stays turned, centred and scaled as
            derived.
        longest_edge: pixels; larger images are reduced (by area) once their cameras are known, as the
            photographs
            of a telephone would fill the memory and show no more than the grid can hold.
        progress: called with the name of each stage.

    Raises:
        InputError: for no or damaged images, too few that could be registered, pycolmap missing, a mask missing,
            near, far or box that hold nothing, or a folder ``out`` that exists or cannot be written.
    """
    source, out = Path(source), Path(out)
    if not source.is_dir() and not (source.is_file() and is_video(source)):
        raise InputError(f"{source}: no such folder of images")
    if out.exists():
        raise InputError(f"{out}: exists already, expected the name of a new folder")
    if longest_edge < 8:
        raise InputError(f"longest_edge: found {longest_edge}, expected at least 8 pixels")
    network = check_masks(masks, model)
    scratch = temporary_beside(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        remove_left_behind(out.parent)
        scratch.mkdir()
        scene = scratch / "scene"
        (scene / "images").mkdir(parents=True)
        made = _gather(source, scene, scratch, progress)
        if str(masks) not in MASKS:
            made = made._replace(frames=attach_masks(made.frames, Path(masks), scene, made.copied))
        elif network is not None or (made.board is not None and str(masks) == "auto"):
            progress("masks")
            frames, said = cut_masks(scene, made.frames, made.board, network)
            made = made._replace(frames=frames)
            if said:
                progress(said)
        progress("box")
        frames, extent = _write(made, scene, longest_edge, near, far, bounds)
        scene.rename(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    registered = tuple(Path(frame.file_path).name for frame in frames)
    missing = tuple(image.path.name for image in made.copied if image.path.name not in registered)
    return Prepared(out, registered, missing, extent, out / "cameras.png")


class _Gathered(NamedTuple):
    """Frames whose images are in place, points on surfaces, all images, the sheet that they show, and the paths
    that the source holds out itself."""

    frames: list[Frame]
    points: Array | None
    copied: list[Copied]
    board: Board | None = None
    test: Set[str] = frozenset()


def _gather(source: Path, scene: Path, scratch: Path, progress: Callable[[str], None]) -> _Gathered:
    """Fill ``scene/images`` and find the cameras."""
    if is_video(source):
        progress("frames")
        taken = sharpest_frames(source, scratch / "frames")
        progress(f"the sharpest frame of each of {taken} stretches of the video")
        return _Gathered(*find_photographs(scratch / "frames", scene, scratch, progress))
    try:
        files = read_folder(source)
    except NotASceneError:
        return _Gathered(*find_photographs(source, scene, scratch, progress))
    if files.ndc or not files.split_here:
        raise InputError(f"{source}: needs no preparation, load it as it is")
    for note in files.notes:
        progress(note)
    check_spread(
        np.array([frame.pose[:3, 3] for frame in (*files.train, *files.test)]),
        [frame.where for frame in (*files.train, *files.test)],
    )
    frames, copied = copy_frames(files, scene)
    held = {frame.where for frame in files.test} if files.own_split else set()
    return _Gathered(
        frames, files.points, copied, None, {frame.file_path for frame in frames if frame.where in held}
    )


def _placed(
    poses: Array, intrinsics: Array, size: tuple[int, int], points: Array | None, room: bool
) -> tuple[Array, World, Extent]:
    """Return the rotation that takes up to z, the turned world in which the box reaches 1.3, and the extent
    in it."""
    turn = _upwards(poses[:, :3, 1].mean(axis=0))
    poses = poses.copy()
    poses[:, :3] = turn @ poses[:, :3]
    turned = None if points is None else points @ turn.T
    if room and surround_focus(poses):
        extent = focus_extent(poses, intrinsics, size, turned)
    elif turned is None:
        extent = camera_extent(poses, intrinsics, size)
    else:
        extent = points_extent(poses, turned)
    return turn, *centred(extent)


def _write(
    made: _Gathered,
    scene: Path,
    longest_edge: int,
    near: float | None,
    far: float | None,
    bounds: Sequence[Sequence[float]] | None,
) -> tuple[list[Frame], Extent]:
    """Write ``transforms.json`` and ``cameras.png`` in normalised coordinates."""
    frames, sizes = made.frames, {f"images/{image.path.name}": image.size for image in made.copied}
    size = sizes[frames[0].file_path]
    cut = made.board is not None and all(frame.mask_path for frame in frames)
    if cut or len({sizes[frame.file_path] for frame in frames}) > 1:
        frames, size = crop_to_one_size(frames, scene, sizes, to_masks=cut)
    intrinsics = np.array([frame.camera.intrinsics(*size) for frame in frames])
    poses = np.stack([frame.pose for frame in frames])
    check_cameras(poses, intrinsics, size, [frame.where for frame in frames])
    # Points of a masked scene may lie on what the masks cut away.
    masked = any(frame.mask_path for frame in frames)
    seen, room = (None, False) if masked else (made.points, _shows_room(frames[0], scene))
    try:
        if made.board is None:
            turn, world, extent = _placed(poses, intrinsics, size, seen, room)
        else:
            turn, world, extent = np.eye(3), IN_PLACE, board_extent(made.board, made.frames)
    except InputError:
        # Cameras in the middle of a room, for one: their world stays as it is, if somebody says where to look
        # in it.
        if near is None or far is None or bounds is None:
            raise
        turn, world, extent = np.eye(3), IN_PLACE, Extent(near, far, np.zeros((2, 3)))
    poses[:, :3] = turn @ poses[:, :3]
    poses = world.inward(poses)
    extent = Extent(
        extent.near if near is None else near,
        extent.far if far is None else far,
        extent.bounds if bounds is None else np.array(bounds, dtype=np.float64),
    )
    check_extent(*extent, poses[:, :3, 3])
    if not box_is_seen(extent, poses, intrinsics, size):
        raise InputError(
            f"box: no camera sees the box {extent.bounds.tolist()} between near {extent.near:g} and far {extent.far:g}"
        )
    frames = [replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True)]
    content: dict[str, Any] = {
        EXTENT_KEY: {"near": extent.near, "far": extent.far, "bounds": extent.bounds.tolist()}
    }
    if made.board is not None:
        content[EXTENT_KEY] |= {"unit": "metre", "board": made.board.paper}
    if made.test:
        content["test_filenames"] = sorted(made.test)
    reduced = shrink_images(frames, scene, size, longest_edge)
    cameras = [camera_keys(frame.camera, size, reduced) for frame in frames]
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
    shown = None if made.points is None else (made.points @ turn.T - world.origin) / world.unit
    draw_cameras(scene / "cameras.png", poses, intrinsics, size, extent.bounds, points=shown)
    return frames, extent


def _shows_room(frame: Frame, scene: Path) -> bool:
    """Tell whether an image is neither transparent anywhere nor on one colour."""
    pixels = torch.from_numpy(read_rgba(scene / frame.file_path, opaque=True))[None]
    return is_opaque(pixels) and backdrop_of(pixels) is None


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
