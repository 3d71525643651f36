"""Reading images into straight-alpha RGBA, and reducing them by area means."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes.png16 import decode_png16, is_png16

__all__ = ["area_mean", "read_rgba"]

_DECODER_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


def read_rgba(path: Path, *, opaque: bool = False) -> NDArray[np.float32]:
    """Read a PNG or JPEG (or anything else Pillow knows) as float RGBA.

    Args:
        path: the file.
        opaque: give images without alpha an alpha of 1 instead of refusing them.

    Returns:
        ``(H, W, 4)`` float32 in [0, 1] with straight alpha.

    Raises:
        InputError: when the file is missing, cannot be decoded or has no alpha channel.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: image not found") from None
    except OSError as error:
        raise InputError(f"{path}: image cannot be read ({error.strerror})") from None
    try:
        rgba = decode_png16(data) if is_png16(data) else _decode(data)
    except _DECODER_ERRORS as error:
        reason = " ".join(str(error).replace(str(path), "").split()) or type(error).__name__
        raise InputError(f"{path}: not a whole image ({reason})") from None
    if rgba.shape[-1] == 3:
        if not opaque:
            raise InputError(f"{path}: image has no alpha channel, expected RGBA")
        rgba = np.concatenate([rgba, np.ones_like(rgba[..., :1])], axis=-1)
    return rgba


def _decode(data: bytes) -> NDArray[np.float32]:
    """Decode to ``(H, W, 3)`` or ``(H, W, 4)``, whichever the file holds."""
    with Image.open(io.BytesIO(data)) as image:
        if image.mode.startswith("I;16"):
            grey: NDArray[np.float32] = np.divide(np.asarray(image), 65535, dtype=np.float32)
            return np.repeat(grey[..., None], 3, axis=-1)
        mode = "RGBA" if image.has_transparency_data else "RGB"
        pixels: NDArray[np.float32] = np.divide(np.asarray(image.convert(mode)), 255, dtype=np.float32)
        return pixels


def area_mean(image: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Reduce ``(H, W, C)`` by the mean over ``factor x factor`` blocks, every channel by itself.

    For RGBA this is the reduction of the published few-view protocols: straight alpha, before compositing.

    Raises:
        InputError: when ``factor`` does not divide the size.
    """
    height, width, channels = image.shape
    if factor < 1 or height % factor or width % factor:
        raise InputError(f"downscale: {factor} does not divide the image size {width}x{height}")
    if factor == 1:
        return image
    blocks = image.reshape(height // factor, factor, width // factor, factor, channels)
    reduced: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return reduced
