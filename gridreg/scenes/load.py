"""`load_scene`: a folder and a protocol in, a scene out; only the selected frames are opened."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.blender import read_blender
from gridreg.scenes.colmap import find_models, read_colmap
from gridreg.scenes.extent import Extent, blender_extent, check_box, points_extent
from gridreg.scenes.frames import SceneFiles
from gridreg.scenes.llff import read_llff
from gridreg.scenes.protocols import VALIDATION_VIEWS, Protocol, get_protocol
from gridreg.scenes.reader import ViewReader
from gridreg.scenes.transforms import read_transforms
from gridreg.scenes.views import Scene, Views, background_colour

__all__ = ["BUILTIN_MARKER", "NotASceneError", "default_protocol", "load_scene", "read_folder"]

BUILTIN_MARKER = "builtin.json"
"""File that marks a folder as the built-in scene."""


def load_scene(
    folder: str | Path,
    protocol: str | Protocol = "dietnerf8",
    *,
    size: int | None = None,
    test: Sequence[int] | None = None,
    validation: int | Sequence[int] | None = None,
    background: str | Sequence[float] | Tensor | None = None,
    near: float | None = None,
    far: float | None = None,
    bounds: Sequence[Sequence[float]] | Tensor | None = None,
    opaque: bool = False,
) -> Scene:
    """Read a scene under a protocol.

    Args:
        folder: the scene folder: Blender's ``transforms_train.json`` and ``transforms_test.json``; or one
            list of frames, every eighth of which is held out and makes the test views: ``transforms.json``
            (nerfstudio, instant-ngp), a COLMAP model in ``sparse/0`` beside ``images/``, or LLFF's
            ``poses_bounds.npy``.
        protocol: a name (see :func:`get_protocol`) or a protocol of one's own.
        size: width of the images in pixels; it must divide what is stored, and replaces the protocol's rule.
        test: indices into the test frames instead of the protocol's; an empty one reads none.
        validation: indices into the training frames, or how many to take, evenly spread, of those that the
            protocol does not train on.
        background: instead of the protocol's, and of the one colour that opaque images may have along their edges.
        near: world units, instead of what the format or the cameras say.
        far: likewise.
        bounds: ``(2, 3)`` lower and upper corner, likewise.
        opaque: accept images without alpha as opaque.

    Raises:
        InputError: one line that names the file or argument, what was found and what is expected.
    """
    folder = Path(folder)
    protocol = get_protocol(protocol) if isinstance(protocol, str) else protocol
    files = read_folder(folder)
    positions = np.stack([frame.pose[:3, 3] for frame in files.train])
    train_ids = _checked(protocol.train.select(positions), files, "train", f"protocol {protocol.name}")
    scored = files.test
    if test is None and protocol.validates:
        scored, test_ids = (
            files.train,
            _free_ids(VALIDATION_VIEWS, train_ids, files, f"protocol {protocol.name}"),
        )
    elif test is None and files.split_here:
        # The held-out frames are the test views; a protocol's rule would thin them out a second time.
        test_ids = tuple(range(len(files.test)))
    elif test is None:
        test_positions = np.stack([frame.pose[:3, 3] for frame in files.test])
        test_ids = _checked(protocol.test.select(test_positions), files, "test", f"protocol {protocol.name}")
    else:
        test_ids = _checked(tuple(test), files, "test", "test")
    validation_ids = _validation_ids(validation, train_ids, files)

    reader = ViewReader(files, protocol, size, opaque)
    train, fingerprint = reader.read(files.train, train_ids)
    test_views, _ = reader.read(scored, test_ids)
    validation_views = None if validation is None else reader.read(files.train, validation_ids)[0]
    extent = _extent(files, train)
    if background is None:
        background = protocol.background if train.backdrop is None else train.backdrop
    scene = Scene(
        name=folder.resolve().name,
        protocol=protocol.name,
        train=train,
        test=test_views,
        near=extent.near if near is None else near,
        far=extent.far if far is None else far,
        bounds=_bounds(extent.bounds if bounds is None else bounds),
        background=background_colour(background),
        fingerprint=fingerprint,
        builtin=(folder / BUILTIN_MARKER).is_file(),
        validation=validation_views,
        ndc=files.ndc,
    )
    check_box(scene, files.points if bounds is not None else None)
    return scene


def default_protocol(folder: str | Path) -> str:
    """The protocol that a folder is loaded under when none is named, by its format.

    ``builtin8`` for the built-in scene, ``dietnerf8`` for Blender's two lists of frames, and ``holdout8`` for one list,
    of which every eighth is held out.
    """
    if (Path(folder) / BUILTIN_MARKER).is_file():
        return "builtin8"
    one_list = not (Path(folder) / "transforms_train.json").is_file() and Path(folder).is_dir()
    return "holdout8" if one_list else "dietnerf8"


class NotASceneError(InputError):
    """A folder that is in none of the known formats."""


def read_folder(folder: Path) -> SceneFiles:
    """Recognise the format of a scene folder and read its frame lists, without opening an image.

    Raises:
        InputError: when it is none of the known formats, or its files are wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such scene folder")
    if (folder / "transforms_train.json").is_file():
        return read_blender(folder)
    if (folder / "transforms.json").is_file():
        return read_transforms(folder)
    if (folder / "poses_bounds.npy").is_file():
        return read_llff(folder)
    if find_models(folder):
        return read_colmap(folder)
    raise NotASceneError(
        f"{folder}: not a scene, expected transforms_train.json and transforms_test.json, transforms.json, "
        "poses_bounds.npy or a COLMAP model in sparse/0"
    )


def _extent(files: SceneFiles, train: Views) -> Extent:
    if files.extent is not None:
        return files.extent
    poses, size = train.poses.numpy().astype(np.float64), (train.width, train.height)
    if files.points is not None and not any(frame.mask_path for frame in files.train):
        return points_extent(poses, files.points)
    return blender_extent(poses, train.intrinsics.numpy().astype(np.float64), size)


def _checked(ids: tuple[int, ...], files: SceneFiles, split: str, by: str) -> tuple[int, ...]:
    count = len(files.train if split == "train" else files.test)
    for i in ids:
        if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < count:
            raise InputError(
                f"{by}: view {i!r} is not in {files.sources[split]}, which lists frames 0 to {count - 1}"
            )
    if len(set(ids)) != len(ids):
        raise InputError(f"{by}: a view is listed twice in {list(ids)}")
    return ids


def _validation_ids(
    wanted: int | Sequence[int] | None, train_ids: tuple[int, ...], files: SceneFiles
) -> tuple[int, ...]:
    if wanted is None:
        return ()
    if isinstance(wanted, int):
        return _free_ids(wanted, train_ids, files, "validation")
    ids = _checked(tuple(wanted), files, "train", "validation")
    shared = sorted(set(ids) & set(train_ids))
    if shared:
        raise InputError(f"validation: views {shared} are training views")
    return ids


def _free_ids(wanted: int, train_ids: tuple[int, ...], files: SceneFiles, by: str) -> tuple[int, ...]:
    """Training frames that are not trained on, evenly spread."""
    free = [i for i in range(len(files.train)) if i not in set(train_ids)]
    if not 0 < wanted <= len(free):
        raise InputError(f"{by}: found {wanted}, expected 1 to {len(free)} views outside the training views")
    return tuple(free[(2 * k + 1) * len(free) // (2 * wanted)] for k in range(wanted))


def _bounds(bounds: Sequence[Sequence[float]] | Tensor | NDArray[np.float64]) -> Tensor:
    try:
        return torch.as_tensor(np.asarray(bounds), dtype=torch.float32)
    except (TypeError, ValueError):
        raise InputError(f"bounds: found {bounds!r}, expected (2, 3) numbers") from None
