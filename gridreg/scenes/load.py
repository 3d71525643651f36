"""`load_scene`: a folder and a protocol in, a scene out; only the selected frames are opened."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.blender import read_blender
from gridreg.scenes.colmap import find_models, read_colmap
from gridreg.scenes.doubts import doubts
from gridreg.scenes.extent import Extent, blender_extent, check_box, points_extent, settled
from gridreg.scenes.focus import focus_extent, surround_focus
from gridreg.scenes.frames import Frame, SceneFiles
from gridreg.scenes.gate import check_spread
from gridreg.scenes.llff import read_llff
from gridreg.scenes.protocols import VALIDATION_VIEWS, Protocol, Selection, get_protocol
from gridreg.scenes.reader import OpenedFrames, ViewReader
from gridreg.scenes.transforms import read_transforms
from gridreg.scenes.views import IN_PLACE, Scene, World, background_colour

__all__ = [
    "BUILTIN_MARKER",
    "NotASceneError",
    "default_protocol",
    "load_scene",
    "read_folder",
    "training_views",
]

BUILTIN_MARKER = "builtin.json"
"""File that marks a folder as the built-in scene."""


# What overflows float32 is named at the gate, not by a warning of NumPy's.
@np.errstate(all="ignore")
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
    """Read a scene under a protocol (what a `DataParser` of nerfstudio does).

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
        background: instead of the protocol's, and of the one colour that opaque images may have along their
            edges.
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
    if not protocol.holds_out and files.split_here and not files.own_split:
        files = replace(files, train=[*files.train, *files.test])
    by = f"protocol {protocol.name}"
    train_ids = _checked(_selected(protocol.train, files.train), files, "train", by)
    scored = files.test
    left_out: tuple[int, ...] = ()
    if protocol.leave is not None:
        train_ids, left_out = _without(protocol.leave, train_ids, by)
    if test is None and left_out:
        scored, test_ids = files.train, left_out
    elif test is None and protocol.validates:
        scored, test_ids = files.train, _free_ids(VALIDATION_VIEWS, train_ids, files, by)
    elif test is None and files.split_here:
        # The held-out frames are the test views; a protocol's rule would choose among them a second time.
        test_ids = tuple(range(len(files.test)))
    elif test is None:
        test_ids = _checked(_selected(protocol.test, files.test), files, "test", by)
    else:
        test_ids = _checked(tuple(test), files, "test", "test")
    validation_ids = _validation_ids(validation, train_ids, files)

    chosen = [(files.train, train_ids), (scored, test_ids), (files.train, validation_ids)]
    frames = [frames[i] for frames, ids in chosen for i in ids]
    check_spread(np.array([frame.pose[:3, 3] for frame in frames]), [frame.where for frame in frames])
    reader = ViewReader(files, protocol, size, opaque)
    reader.expect(frames)
    opened = [reader.read(frames, ids) for frames, ids in chosen]
    given = None if bounds is None else _bounds(bounds)
    world, extent = _extent(files, opened[0], near, far, given)
    train, test_views, others = (each.views(world) for each in opened)
    if background is None:
        background = protocol.background if train.backdrop is None else train.backdrop
    seen = opened[0].fingerprint
    # Scenes whose worlds were moved differently are told apart.
    moved = seen if world == IN_PLACE else hashlib.sha256(f"{seen}{world}".encode()).hexdigest()
    scene = Scene(
        name=folder.resolve().name,
        protocol=protocol.name,
        train=train,
        test=test_views,
        near=extent.near,
        far=extent.far,
        bounds=torch.as_tensor(extent.bounds, dtype=torch.float32),
        background=background_colour(background),
        fingerprint=moved,
        builtin=(folder / BUILTIN_MARKER).is_file(),
        validation=None if validation is None else others,
        ndc=files.ndc,
        world=world._replace(metric=files.metric),
        notes=(*files.notes, *reader.notes, *doubts(world, train, test_views)),
    )
    check_box(scene, files.points if given is not None else None)
    return scene


def default_protocol(folder: str | Path) -> str:
    """The protocol that a folder is loaded under when none is named, by its format.

    ``builtin8`` for the built-in scene, ``dietnerf8`` for Blender's two lists of frames (or all of them,
    where they are fewer than it selects from), and ``holdout8`` for one list, of which every eighth is held
    out.

    Raises:
        InputError: when the lists of a Blender scene cannot be read.
    """
    folder = Path(folder)
    if (folder / BUILTIN_MARKER).is_file():
        return "builtin8"
    if not folder.is_dir():
        return "dietnerf8"
    files = read_folder(folder) if (folder / "transforms_train.json").is_file() else None
    if files is None or files.split_here:
        return "holdout8"
    wanted = get_protocol("dietnerf8").train.select(np.zeros((len(files.train), 3)))
    return "dietnerf8" if max(wanted) < len(files.train) else f"first{len(files.train)}"


def training_views(folder: str | Path, protocol: str) -> int:
    """Return how many views of a scene a protocol trains on, without opening an image.

    Raises:
        InputError: for an unknown protocol, or lists of frames that cannot be read or do not hold its views.
    """
    files = read_folder(Path(folder))
    ids = _selected(get_protocol(protocol).train, files.train)
    return len(_checked(ids, files, "train", f"protocol {protocol}"))


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


def _selected(selection: Selection, frames: list[Frame]) -> tuple[int, ...]:
    return selection.select(np.array([frame.pose[:3, 3] for frame in frames]).reshape(-1, 3))


def _extent(
    files: SceneFiles,
    train: OpenedFrames,
    near: float | None,
    far: float | None,
    bounds: NDArray[np.float64] | None,
) -> tuple[World, Extent]:
    """Return the scene's world, and near, far and box in it: as given, as the files state, or as cameras and
    points say."""
    if near is not None and far is not None and bounds is not None:
        derived = Extent(near, far, bounds)
    elif files.extent is not None:
        derived = files.extent
    elif not files.ndc and train.views(IN_PLACE).shows_room and surround_focus(train.poses):
        derived = focus_extent(train.poses, train.intrinsics, train.size, files.points)
    elif files.points is not None and not any(frame.mask_path for frame in files.train):
        derived = points_extent(train.poses, files.points)
    else:
        derived = blender_extent(train.poses, train.intrinsics, train.size)
    extent = Extent(
        derived.near if near is None else near,
        derived.far if far is None else far,
        derived.bounds if bounds is None else bounds,
    )
    # Who states a box, in a file or as an argument, counts in the world that it stands in; metres are large or small
    # as the object is.
    stays = files.ndc or (not files.metric and (files.extent is not None or bounds is not None))
    return (IN_PLACE, extent) if stays else settled(extent)


def _without(position: int, ids: tuple[int, ...], by: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Training views without the one at a position, and that one."""
    if not position < len(ids) > 1:
        raise InputError(f"{by}: found {len(ids)} training views, expected at least {max(2, position + 1)}")
    return ids[:position] + ids[position + 1 :], (ids[position],)


def _checked(ids: tuple[int, ...], files: SceneFiles, split: str, by: str) -> tuple[int, ...]:
    count = len(files.train if split == "train" else files.test)
    for i in ids:
        if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < count:
            fits = f"; first{count} would fit, or views{min(8, count)}" if by.startswith("protocol") else ""
            raise InputError(
                f"{by}: view {i!r} is not in {files.sources[split]}, which lists frames 0 to {count - 1}{fits}"
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


def _bounds(bounds: Sequence[Sequence[float]] | Tensor) -> NDArray[np.float64]:
    try:
        box = np.asarray(bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(
            f"bounds: found {bounds!r}, expected (2, 3) numbers with lower corner below upper"
        ) from None
    return box
