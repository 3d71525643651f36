"""Arrays as pictures: colour scales with a legend, labels, and panels side by side.

Pictures are ``(H, W, 3)`` uint8 arrays throughout.
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

__all__ = [
    "Picture",
    "coloured",
    "depth_limits",
    "fading_into_white",
    "labelled",
    "row",
    "save_png",
    "scale_bar",
    "thumbnail",
    "to_picture",
]

Picture = NDArray[np.uint8]

_TEXT = 13
_STRIP = 20


def to_picture(image: Tensor) -> Picture:
    """An image ``(H, W, 3)`` in [0, 1], clamped, as a picture; NaN becomes 0.

    Raises:
        InputError: for another shape.

    Example:
        >>> import torch
        >>> to_picture(torch.full((1, 1, 3), 0.5)).tolist()
        [[[128, 128, 128]]]
    """
    if image.ndim != 3 or image.shape[-1] != 3:
        raise InputError(f"image: shape {tuple(image.shape)}; expected (H, W, 3)")
    values = image.detach().double().nan_to_num(0).clamp(0, 1).cpu().numpy()
    picture: Picture = np.round(values * 255).astype(np.uint8)
    return picture


def coloured(values: NDArray[np.floating], low: float, high: float, colours: str = "inferno") -> Picture:
    """Numbers ``(H, W)`` as colours of a perceptually uniform scale; NaN gets the colour of ``high``.

    Args:
        values: the numbers.
        low: gets the first colour, and so does everything below.
        high: gets the last colour, and so does everything above.
        colours: name of a matplotlib colour map.
    """
    share = np.clip((np.nan_to_num(values, nan=high) - low) / max(high - low, 1e-12), 0, 1)
    picture: Picture = _table(colours)[np.round(share * 255).astype(np.intp)]
    return picture


def scale_bar(height: int, low: float, high: float, colours: str = "inferno", unit: str = "") -> Picture:
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
    bar: Picture = np.full((height, width, 3), 255, np.uint8)
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


def fading_into_white(picture: Picture, opacity: Tensor) -> Picture:
    """The picture ``(H, W, 3)`` blended with white where the opacity ``(H, W)`` is below 1; NaN counts as 0."""
    share = opacity.detach().double().nan_to_num(0).clamp(0, 1).cpu().numpy()[..., None]
    blended: Picture = np.round(picture * share + 255 * (1 - share)).astype(np.uint8)
    return blended


def labelled(picture: Picture, text: str) -> Picture:
    """The picture below a white strip with a text, cut off where the picture ends."""
    strip = Image.new("RGB", (picture.shape[1], _STRIP), "white")
    ImageDraw.Draw(strip).text((3, 3), text, fill="black", font=_font())
    return np.concatenate([np.asarray(strip), picture])


def row(pictures: Sequence[Picture], gap: int = 4) -> Picture:
    """Pictures from left to right on white, aligned at the top."""
    height = max(picture.shape[0] for picture in pictures)
    width = sum(picture.shape[1] for picture in pictures) + gap * (len(pictures) - 1)
    result: Picture = np.full((height, width, 3), 255, np.uint8)
    left = 0
    for picture in pictures:
        result[: picture.shape[0], left : left + picture.shape[1]] = picture
        left += picture.shape[1] + gap
    return result


def thumbnail(picture: Picture, size: int) -> Picture:
    """The picture scaled so that its longer side is ``size`` pixels; small pictures keep sharp pixels."""
    height, width = picture.shape[:2]
    scale = size / max(height, width)
    filter_ = Image.Resampling.NEAREST if scale >= 1 else Image.Resampling.BOX
    shape = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(Image.fromarray(picture).resize(shape, filter_))


def save_png(path: str | os.PathLike[str], picture: Picture) -> None:
    """Write a PNG, whole or not at all.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG")
    write_bytes(path, buffer.getvalue())


@lru_cache(maxsize=8)
def _table(colours: str) -> Picture:
    """The 256 colours of a map, ``(256, 3)``."""
    scale = matplotlib.colormaps[colours](np.linspace(0, 1, 256))[:, :3]
    table: Picture = np.round(scale * 255).astype(np.uint8)
    return table


@lru_cache(maxsize=1)
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(_TEXT)
