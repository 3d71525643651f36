"""Masks for photographs that come without any: from the sheet, or by a network that the user brings."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from gridreg.errors import InputError
from gridreg.scenes.board import Board
from gridreg.scenes.frames import Frame
from gridreg.scenes.images import read_rgba
from gridreg.scenes.sheet_masks import cut_from_sheet
from gridreg.scenes.sheet_views import SheetView

__all__ = ["MASKS", "Network", "check_masks", "cut_masks", "draw_masks"]

MASKS = ("auto", "none", "rembg")
"""Words that stand for masks instead of a folder of them."""

Mask = NDArray[np.bool_]

_EDGE = 1600
"""Longer edge of the images that are cut, pixels."""
_CELL, _COLUMNS = 360, 4
# Mean and deviation of the channels that networks of rembg were trained with: ImageNet's, but for those called isnet.
_USUAL, _ISNET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)), ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0))


def check_masks(masks: str | Path, model: str | Path | None) -> Network | None:
    """Return the network that masks are to be cut with, if any; say before minutes of work what does not go together.

    Args:
        masks: one of `MASKS`, or a folder of masks.
        model: network of ``rembg``, an ONNX file that the user brings.

    Raises:
        InputError: for ``rembg`` without a model file or onnxruntime, a model without ``rembg``, or no such folder.
    """
    if str(masks) not in MASKS and not Path(masks).is_dir():
        raise InputError(f"masks: found {str(masks)!r}, expected a folder of masks, or {', '.join(MASKS)}")
    if (model is not None) != (str(masks) == "rembg"):
        raise InputError("masks: rembg takes a model file, an .onnx of rembg's, and nothing else does")
    return None if model is None else Network(Path(model))


def cut_masks(
    scene: Path,
    frames: Sequence[Frame],
    board: Board | None = None,
    network: Network | None = None,
) -> tuple[list[Frame], str]:
    """Cut the object out of the images of a scene, where a way to do so is known.

    Writes ``masks/NAME.png``, white is the object, and the contact sheet ``masks.jpg``: what is cut away is dark there.
    A mask that is wrong is mended by putting another one in its place. Images stay as they are that have masks or
    transparent pixels, and, without a network, that show no sheet.

    Args:
        scene: folder that the frames' paths start from.
        frames: cameras in metres above the sheet, if there is one.
        board: the sheet that they show.
        network: cuts each image by itself, instead of the sheet.

    Returns:
        The frames, with masks if there are any now, and a line about how it was done.

    Raises:
        InputError: without OpenCV where the sheet is to be used, or if an image cannot be read.
    """
    frames = list(frames)
    if any(frame.mask_path for frame in frames):
        return frames, ""
    images = [_read(scene / frame.file_path) for frame in frames]
    if network is not None:
        masks: list[Mask] | None = [network(image) for image in images]
        said = f"masks by {network.name}"
    elif board is None or len(frames) < 3 or any(image.shape[2] == 4 for image in images):
        return frames, ""
    else:
        masks = cut_from_sheet([_view(*pair) for pair in zip(frames, images, strict=True)], board)
        said = "masks from the sheet"
    if masks is None:
        return frames, "no masks: nothing is seen to stand on the sheet"
    (scene / "masks").mkdir(exist_ok=True)
    made = []
    for frame, mask in zip(frames, masks, strict=True):
        place = f"masks/{Path(frame.file_path).name}.png"
        with Image.open(scene / frame.file_path) as image:
            size = image.size
        grown = Image.fromarray(255 * mask.astype(np.uint8)).resize(size, Image.Resampling.BILINEAR)
        grown.point(lambda value: 255 * (value > 127)).save(scene / place)
        made.append(replace(frame, mask_path=place))
    draw_masks(scene / "masks.jpg", [Path(frame.file_path).name for frame in frames], images, masks)
    kept = 100 * float(np.mean([mask.mean() for mask in masks]))
    return (
        made,
        f"{said} ({kept:.1f} % of the images): look at masks.jpg; wrong ones can be replaced in masks/",
    )


def draw_masks(
    path: Path, names: Sequence[str], images: Sequence[NDArray[np.uint8]], masks: Sequence[Mask]
) -> None:
    """Write all images small on one JPEG, with their names: what masks cut away is dark, the outline is drawn."""
    rows = -(-len(images) // _COLUMNS)
    sheet = Image.new("RGB", (_COLUMNS * _CELL, rows * (_CELL + 16)), "white")
    for k, (name, image, mask) in enumerate(zip(names, images, masks, strict=True)):
        shown = np.where(mask[..., None], image[..., :3], image[..., :3] // 4)
        padded = np.pad(mask, 1)
        inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        shown[mask & ~inner] = (255, 0, 255)
        small = Image.fromarray(shown.astype(np.uint8))
        small.thumbnail((_CELL - 8, _CELL - 8))
        left, top = k % _COLUMNS * _CELL, k // _COLUMNS * (_CELL + 16)
        sheet.paste(small, (left, top + 16))
        ImageDraw.Draw(sheet).text((left + 2, top + 2), name, fill="black")
    sheet.save(path, quality=90)


def _read(path: Path) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)``, of four channels if it is transparent somewhere, at most `_EDGE` pixels."""
    rgba = np.rint(255 * read_rgba(path, opaque=True)).astype(np.uint8)
    image = Image.fromarray(rgba if rgba[..., 3].min() < 255 else rgba[..., :3])
    if max(image.size) > _EDGE:
        factor = _EDGE / max(image.size)
        size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image)


def _view(frame: Frame, image: NDArray[np.uint8]) -> SheetView:
    height, width = image.shape[:2]
    stated = frame.camera.size or (width, height)
    fx, fy, cx, cy = frame.camera.intrinsics(round(stated[0]), round(stated[1]))
    x, y = width / stated[0], height / stated[1]
    return SheetView(image, frame.pose, (fx * x, fy * y, cx * x, cy * y), frame.camera.distortion)


def _need(package: str, extra: str, purpose: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError:
        advice = f"pip install {extra}" if extra == package else f"pip install 'gridreg[{extra}]'"
        raise InputError(f"{purpose}: {package} is not installed, expected: {advice}") from None


class Network:
    """A network of rembg's (U2-Net, ISNet and their like) in an ONNX file; nothing is downloaded."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path}: no such model file, expected an .onnx of rembg's")
        runtime = _need("onnxruntime", "onnxruntime", "masks by rembg")
        try:
            self._session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
            self._input = self._session.get_inputs()[0]
            self._size = tuple(int(length) for length in self._input.shape[2:4])
        # The runtime raises what its parts raise.
        except Exception as error:
            reason = (str(error).splitlines() or [""])[0]
            raise InputError(f"{path}: cannot be read as a network of rembg: {reason}") from None
        self.name = path.name
        self._mean, self._deviation = _ISNET if "isnet" in path.name else _USUAL

    def __call__(self, image: NDArray[np.uint8]) -> Mask:
        """The object in an image ``(H, W, 3)``."""
        height, width = self._size
        small = Image.fromarray(image[..., :3]).resize((width, height), Image.Resampling.LANCZOS)
        values = np.asarray(small, dtype=np.float32) / max(1, int(np.asarray(small).max()))
        values = ((values - self._mean) / self._deviation).astype(np.float32).transpose(2, 0, 1)[None]
        found = np.asarray(self._session.run(None, {self._input.name: values})[0])[0, 0]
        found = (found - found.min()) / max(float(np.ptp(found)), 1e-6)
        grown = Image.fromarray(np.rint(255 * found).astype(np.uint8))
        return np.asarray(grown.resize(image.shape[1::-1], Image.Resampling.LANCZOS)) > 127
