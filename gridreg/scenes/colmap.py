"""Reader for scenes whose cameras COLMAP found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.colmap_model import ColmapCamera, ColmapImage, ColmapModel, read_model
from gridreg.scenes.files import read_text
from gridreg.scenes.frames import Frame, SceneFiles, StatedIntrinsics
from gridreg.scenes.gate import check_pose
from gridreg.scenes.lens import LensDistortion

__all__ = ["camera_to_world", "find_models", "frames_of_model", "mask_of", "read_colmap"]

_PLACES = ("sparse", "colmap/sparse", ".")


def find_models(folder: Path) -> list[Path]:
    """Return the folders that hold COLMAP models: ``sparse``, ``sparse/0`` and so on."""
    models = []
    for place in _PLACES:
        base = folder / place
        inner = (
            sorted(path for path in base.iterdir() if path.is_dir()) if base.is_dir() and place != "." else []
        )
        models += [path for path in [base, *inner] if _is_model(path)]
    return models


def _is_model(folder: Path) -> bool:
    return any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap(folder: Path) -> SceneFiles:
    """Read a COLMAP model beside ``images/`` (and, if there, ``masks/``) without opening an image.

    World coordinates are those of the model. The images that ``test.txt`` names in the model's folder are for
    testing (as 3D Gaussian splatting has it), else every eighth by name. A mask is called like its image,
    with the same extension or ``.png``, or like its image with ``.png`` appended.

    Raises:
        InputError: when there is more than one model, or it or its images cannot be read.
    """
    models = find_models(folder)
    if len(models) != 1:
        found = ", ".join(str(model.relative_to(folder)) for model in models) or "none"
        raise InputError(f"{folder}: expected one COLMAP model, found {found}; leave only the one to use")
    model = read_model(models[0])
    images = next((name for name in ("images", "input") if (folder / name).is_dir()), None)
    if images is None:
        raise InputError(f"{folder}: folder images/ with the images of the COLMAP model not found")
    frames = frames_of_model(model, folder, images, str(models[0]))
    split, test = models[0] / "test.txt", set[str]()
    if split.is_file():
        names = {name.strip() for name in read_text(split).splitlines()}
        test = {frame.file_path for frame in frames if frame.file_path.removeprefix(f"{images}/") in names}
    return SceneFiles.held_out(
        folder,
        frames,
        models[0],
        test=test,
        notes=(f"{split}: {len(test)} test frames",) if test else (),
        opaque=True,
        as_stored=True,
        points=model.points if len(model.points) else None,
    )


def frames_of_model(model: ColmapModel, folder: Path, images: str, where: str) -> list[Frame]:
    """Turn a model's images into frames whose paths start with ``images``.

    Raises:
        InputError: for a rotation that is none, or a mask that is missing where others are there.
    """
    masks = folder / "masks"
    return [
        Frame(
            file_path=f"{images}/{image.name}",
            pose=camera_to_world(image, f"{where}: image {image.name}"),
            camera=_to_camera(model.cameras[image.camera_id]),
            where=f"{where}: image {image.name}",
            mask_path=f"masks/{mask_of(masks, image.name)}" if masks.is_dir() else None,
        )
        for image in model.images
    ]


def camera_to_world(image: ColmapImage, where: str) -> NDArray[np.float64]:
    """Return the ``(4, 4)`` camera-to-world matrix, camera looking along -z with y up.

    Raises:
        InputError: for numbers that are not finite or a quaternion of length 0.
    """
    quaternion = np.array(image.quaternion)
    length = np.linalg.norm(quaternion)
    if not np.isfinite(length) or length < 1e-9:
        raise InputError(f"{where}: rotation {image.quaternion} is no quaternion")
    if not np.isfinite(image.translation).all():
        raise InputError(f"{where}: translation {image.translation} is not finite")
    w, x, y, z = quaternion / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * [1, -1, -1]
    pose[:3, 3] = -rotation.T @ image.translation
    return check_pose(pose, where)


def _to_camera(camera: ColmapCamera) -> StatedIntrinsics:
    values = camera.parameters
    fx = values.get("fx", values.get("f"))
    lens = {key: value for key, value in values.items() if key[0] in "kp"}
    return StatedIntrinsics(
        fx=fx,
        fy=values.get("fy", fx),
        cx=values["cx"],
        cy=values["cy"],
        width=camera.width,
        height=camera.height,
        distortion=LensDistortion(**lens),
    )


def mask_of(masks: Path, name: str) -> str:
    """Return the name of the mask in a folder that belongs to the image ``name``.

    Raises:
        InputError: when there is none.
    """
    for candidate in (name, f"{name}.png", str(Path(name).with_suffix(".png"))):
        if (masks / candidate).is_file():
            return candidate
    raise InputError(f"{masks}: no mask for image {name}, expected {name}.png")
