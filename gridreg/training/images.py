"""Arrays as images: colour scales with a legend, labels, and panels side by side.

Images are ``(H, W, 3)`` uint8 arrays throughout.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from functools import lru_cache

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from gridreg.errors import InputError
from gridreg.training.files import write_bytes

ImageArray = NDArray[np.uint8]

DEPTH_COLOURS = "turbo"
"""Colour map of depths wherever they are shown: near is dark blue, far dark red."""

_TEXT = 13
_STRIP = 20


def to_uint8(image: Tensor) -> ImageArray:
    """An image ``(H, W, 3)`` in [0, 1], clamped, as an array of bytes; NaN becomes 0.

    Raises:
        InputError: for another shape.

    Example:
        >>> import torch
        >>> to_uint8(torch.full((1, 1, 3), 0.5)).tolist()
        [[[128, 128, 128]]]
    """
    if image.ndim != 3 or image.shape[-1] != 3:
        raise InputError(f"image: shape {tuple(image.shape)}; expected (H, W, 3)")
    values = image.detach().double().nan_to_num(0).clamp(0, 1).cpu().numpy()
    array: ImageArray = np.round(values * 255).astype(np.uint8)
    return array


def coloured(values: NDArray[np.floating], low: float, high: float, colours: str = "inferno") -> ImageArray:
    """Numbers ``(H, W)`` as colours of a perceptually uniform scale; NaN gets the colour of ``high``.

    Args:
        values: the numbers.
        low: gets the first colour, and so does everything below.
        high: gets the last colour, and so does everything above.
        colours: name of a matplotlib colour map.
    """
    share = np.clip((np.nan_to_num(values, nan=high) - low) / max(high - low, 1e-12), 0, 1)
    image: ImageArray = _table(colours)[np.round(share * 255).astype(np.intp)]
    return image


def scale_bar(height: int, low: float, high: float, colours: str = "inferno", unit: str = "") -> ImageArray:
    """The legend of ``coloured``: ``low`` below, ``high`` above, with figures and the unit.

    Args:
        height: pixels.
        low: the figure at the lower end.
        high: the figure at the upper end.
        colours: as given to ``coloured``.
        unit: written at the top, where there is room.
    """
    width = 64
    margin = min(_TEXT, height // 6)
    top = margin + (_STRIP if unit and height > 8 * _TEXT else 0)
    inner = max(height - margin - top, 2)
    bar: ImageArray = np.full((height, width, 3), 255, np.uint8)
    ramp = np.linspace(high, low, inner)[:, None].repeat(12, axis=1)
    bar[top : top + inner, 4:16] = coloured(ramp, low, high, colours)[: height - top]
    image = Image.fromarray(bar)
    draw = ImageDraw.Draw(image)
    for share in np.linspace(0, 1, max(2, min(5, inner // 40))):
        y = top + round((1 - share) * (inner - 1))
        draw.text((20, y), f"{low + share * (high - low):.3g}", fill="black", font=_font(), anchor="lm")
    if top > margin:
        draw.text((4, 3), unit, fill="black", font=_font())
    return np.asarray(image)


def depth_limits(seen: Tensor) -> tuple[float, float]:
    """Ends of a scale for depths ``(N,)``: their 1st and 99th percentile and a little more; (0, 1) for none."""
    values = seen.detach().double().cpu().numpy()
    if not values.size:
        return 0.0, 1.0
    near, far = (float(v) for v in np.quantile(values, [0.01, 0.99]))
    # One flat wall would leave no range to spread colours over.
    margin = max(0.05 * (far - near), 1e-3 * abs(far), 1e-6)
    return near - margin, far + margin


def fading_into_white(image: ImageArray, opacity: Tensor) -> ImageArray:
    """The image ``(H, W, 3)`` blended with white where the opacity ``(H, W)`` is below 1; NaN counts as 0."""
    share = opacity.detach().double().nan_to_num(0).clamp(0, 1).cpu().numpy()[..., None]
    blended: ImageArray = np.round(image * share + 255 * (1 - share)).astype(np.uint8)
    return blended


def labelled(image: ImageArray, text: str) -> ImageArray:
    """The image below a white strip with a text, cut off where the image ends."""
    strip = Image.new("RGB", (image.shape[1], _STRIP), "white")
    ImageDraw.Draw(strip).text((3, 3), text, fill="black", font=_font())
    return np.concatenate([np.asarray(strip), image])


def row(images: Sequence[ImageArray], gap: int = 4) -> ImageArray:
    """Images from left to right on white, aligned at the top."""
    height = max(image.shape[0] for image in images)
    width = sum(image.shape[1] for image in images) + gap * (len(images) - 1)
    result: ImageArray = np.full((height, width, 3), 255, np.uint8)
    left = 0
    for image in images:
        result[: image.shape[0], left : left + image.shape[1]] = image
        left += image.shape[1] + gap
    return result


def thumbnail(image: ImageArray, size: int) -> ImageArray:
    """The image scaled so that its longer side is ``size`` pixels; small images keep sharp pixels."""
    height, width = image.shape[:2]
    scale = size / max(height, width)
    filter_ = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.BOX
    shape = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(Image.fromarray(image).resize(shape, filter_))


def save_png(path: str | os.PathLike[str], image: ImageArray) -> None:
    """Write a PNG, whole or not at all.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    write_bytes(path, buffer.getvalue())


@lru_cache(maxsize=8)
def _table(colours: str) -> ImageArray:
    """The 256 colours of a map, ``(256, 3)``."""
    scale = matplotlib.colormaps[colours](np.linspace(0, 1, 256))[:, :3]
    table: ImageArray = np.round(scale * 255).astype(np.uint8)
    return table


@lru_cache(maxsize=1)
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(_TEXT)
