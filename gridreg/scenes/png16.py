"""A decoder for PNGs of 16 bits per channel, which Pillow would reduce to 8."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

__all__ = ["decode_png16", "is_png16"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {2: 3, 6: 4}


def is_png16(data: bytes) -> bool:
    """Tell whether ``data`` opens as a 16-bit RGB or RGBA PNG without interlacing."""
    if len(data) < 29 or not data.startswith(_SIGNATURE) or data[12:16] != b"IHDR":
        return False
    depth, colour_type, _, _, interlace = data[24:29]
    return depth == 16 and colour_type in _CHANNELS and interlace == 0


def decode_png16(data: bytes) -> NDArray[np.float32]:
    """Decode a PNG that :func:`is_png16` accepts.

    Returns:
        ``(H, W, 3)`` or ``(H, W, 4)`` float32 in [0, 1].

    Raises:
        ValueError: when the file is cut short or damaged.

    Source: PNG specification (W3C, third edition), sections 5, 9 and 10.
    """
    width, height = struct.unpack(">II", data[16:24])
    channels = _CHANNELS[data[25]]
    stride = width * channels * 2
    stream = zlib.decompressobj()
    raw = stream.decompress(_image_data(data), height * (stride + 1))
    if width < 1 or height < 1 or len(raw) != height * (stride + 1):
        raise ValueError("image data ends early")
    rows = np.frombuffer(raw, dtype=np.uint8).reshape(height, stride + 1)
    if rows[:, 0].max() > 4:
        raise ValueError(f"unknown row filter {rows[:, 0].max()}")
    pixels = _unfilter(rows[:, 0], rows[:, 1:].reshape(height, width, channels * 2))
    values = np.ascontiguousarray(pixels).view(">u2").reshape(height, width, channels)
    scaled: NDArray[np.float32] = np.divide(values, 65535, dtype=np.float32)
    return scaled


def _image_data(data: bytes) -> bytes:
    """Join the IDAT chunks, with their checksums verified."""
    parts: list[bytes] = []
    position = len(_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        body = data[position + 8 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if len(checksum) < 4 or zlib.crc32(kind + body) != int.from_bytes(checksum, "big"):
            raise ValueError(f"damaged chunk {kind!r}")
        if kind == b"IDAT":
            parts.append(body)
        if kind == b"IEND":
            return b"".join(parts)
        position += 12 + length
    raise ValueError("file ends early")


def _unfilter(filters: NDArray[np.uint8], coded: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Undo the row filters of ``(H, W, bytes per pixel)``.

    A pixel depends on its left, upper and upper-left neighbours only, so all pixels of one anti-diagonal are
    computed at once: H + W array steps instead of H * W scalar ones.
    """
    height, width, _ = coded.shape
    # One row and column of zeros stand for the neighbours outside the image.
    decoded = np.zeros((height + 1, width + 1, coded.shape[2]), dtype=np.int16)
    for diagonal in range(height + width - 1):
        rows = np.arange(max(0, diagonal - width + 1), min(height, diagonal + 1))
        columns = diagonal - rows
        left = decoded[rows + 1, columns]
        up = decoded[rows, columns + 1]
        corner = decoded[rows, columns]
        estimate = left + up - corner
        to_left, to_up, to_corner = abs(estimate - left), abs(estimate - up), abs(estimate - corner)
        paeth = np.where(
            (to_left <= to_up) & (to_left <= to_corner), left, np.where(to_up <= to_corner, up, corner)
        )
        kind = filters[rows][:, None]
        predicted = np.select(
            [kind == 1, kind == 2, kind == 3, kind == 4], [left, up, (left + up) // 2, paeth], 0
        )
        decoded[rows + 1, columns + 1] = (coded[rows, columns] + predicted) % 256
    return decoded[1:, 1:].astype(np.uint8)
