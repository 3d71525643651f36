"""Decoding image files.

Everything that is opened as an image is opened here: in the formats that are meant, within bounds that are
asked before anything is unpacked, and with every decoder's exception turned into one line.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageFile, UnidentifiedImageError

from gridreg.errors import InputError, silenced
from gridreg.machine import check_memory
from gridreg.scenes.files import read_bytes

__all__ = ["SIDEWAYS", "Decoded", "decode", "exif_orientation", "exif_turn", "image_size", "open_image"]

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "AVIF", "HEIF")
"""Pillow's names of the formats that are opened, whatever a file is called."""

MOST_PIXELS = 2**27
"""Larger images are refused before they are unpacked; the largest telephones take 200 million pixels,
rarely."""

_MOST_SCANS = 100
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
SIDEWAYS = (_TURNS[5], _TURNS[6], _TURNS[7], _TURNS[8])
"""Turns that swap width and height."""


class Decoded(NamedTuple):
    """An image as its camera saw it.

    Attributes:
        pixels: ``(H, W, 3)`` or ``(H, W, 4)`` float32 in [0, 1], straight alpha, whichever the file holds.
        turn: how the stored pixels were turned, as EXIF data say; None: not at all.
    """

    pixels: NDArray[np.float32]
    turn: Image.Transpose | None


def decode(path: Path, *, stated: tuple[float, float] | None = None, as_stored: bool = False) -> Decoded:
    """Read a PNG, JPEG, WebP, TIFF, BMP, AVIF or (with pillow-heif) HEIC, turned upright as its EXIF data
    say.

    Args:
        path: the file.
        stated: width and height of the camera: where EXIF would swap the two, they say whether to turn.
        as_stored: do not turn the image where the size does not tell.

    Raises:
        InputError: when the file is missing, cannot be decoded, is too large, or has broken EXIF data.
    """
    with open_image(path) as image:
        low = _low_bytes(image, read_bytes(path, "image"))
        # Pillow reads a PNG to its end to find EXIF data: a cut image has to fail before.
        image.load()
        turn = exif_turn(image, path, stated, as_stored)
        if turn is not None:
            image, low = image.transpose(turn), None if low is None else low.transpose(turn)
        return Decoded(_values(image, low, path), turn)


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image; what its decoder raises, then or while the block reads pixels, becomes an `InputError`."""
    data = read_bytes(path, "image")
    try:
        # Without Pillow's own words on broken EXIF data: `exif_turn` refuses them in one line.
        with warnings.catch_warnings(), silenced("PIL"):
            warnings.simplefilter("ignore")
            _enable_heif(data, path)
            Image.init()
            image = Image.open(io.BytesIO(data), formats=[name for name in FORMATS if name in Image.OPEN])
    except InputError:
        raise
    except UnidentifiedImageError:
        known = "PNG, JPEG, WebP, TIFF, BMP, AVIF or HEIC"
        raise InputError(f"{path}: not an image that can be read, expected a whole {known}") from None
    except Exception as error:
        raise _not_whole(path, error) from None
    with image:
        if image.width * image.height > MOST_PIXELS:
            raise InputError(
                f"{path}: image is {image.width}x{image.height}, expected at most {MOST_PIXELS:,} pixels"
            )
        # Bytes, their copy as floats, and one copy more while they are turned or reduced.
        check_memory(40 * image.width * image.height, f"{path}: image is {image.width}x{image.height},")
        try:
            _check_data(data, image.format)
            # Nor their words on tags and chunks that are not needed.
            with warnings.catch_warnings(), silenced("PIL"):
                warnings.simplefilter("ignore")
                yield image
        except InputError:
            raise
        except Exception as error:
            raise _not_whole(path, error) from None


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height as stored, from the header alone.

    Raises:
        InputError: as :func:`open_image`.
    """
    with open_image(path) as image:
        return image.size


def _enable_heif(data: bytes, path: Path) -> None:
    if data[4:8] != b"ftyp" or data[8:12] in (b"avif", b"avis"):
        return
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise InputError(
            f"{path}: HEIC needs pillow-heif: pip install 'gridreg[photos]', or save it as JPEG"
        ) from None
    register_heif_opener()


def _check_data(data: bytes, kind: str | None) -> None:
    """Refuse what decoders would accept: PNG data with a wrong checksum, and JPEGs of endless scans."""
    if kind in ("JPEG", "MPO") and data.count(b"\xff\xda") > _MOST_SCANS:
        raise ValueError(f"more than {_MOST_SCANS} scans")
    position, name = 8, b""
    while kind == "PNG" and name != b"IEND":
        length, name = struct.unpack(">I4s", data[position : position + 8])
        end = position + 8 + length
        stored = data[end : end + 4]
        if len(stored) < 4 or (
            name == b"IDAT" and zlib.crc32(data[position + 4 : end]) != int.from_bytes(stored, "big")
        ):
            raise ValueError(f"damaged chunk {name!r}")
        position = end + 4


def _not_whole(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: not a whole image ({str(error) or type(error).__name__})")


def exif_turn(
    image: Image.Image, path: Path, stated: tuple[float, float] | None, as_stored: bool
) -> Image.Transpose | None:
    """Return how to turn an opened image so that it is what its camera saw."""
    orientation = exif_orientation(image, path)
    if orientation == 1:
        return None
    turn = _TURNS[orientation]
    if turn in SIDEWAYS and image.width != image.height and stated is not None:
        as_stored = all(abs(a - b) < 1 for a, b in zip(image.size, stated, strict=True))
    return None if as_stored else turn


def exif_orientation(image: Image.Image, path: Path) -> int:
    """Return the EXIF orientation of an opened image: 1 is upright, 5 to 8 swap width and height."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Read anew, because opening a JPEG has tried already and keeps silent about damage.
            Image.Exif().load(image.info.get("exif", b""))
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise InputError(f"{path}: EXIF data cannot be read ({reason}), save it anew") from None
    if orientation not in range(1, 9):
        raise InputError(f"{path}: EXIF orientation is {orientation!r}, expected 1 to 8")
    return int(orientation)


def _low_bytes(image: Image.Image, data: bytes) -> Image.Image | None:
    """Return the low bytes of a PNG of 16 bits a channel, of which Pillow decodes the high ones alone; else
    None."""
    if not isinstance(image, ImageFile.ImageFile) or image.format != "PNG" or not image.tile:
        return None
    tile = image.tile[0]
    if tile.args not in ("RGB;16B", "RGBA;16B"):
        return None
    low = Image.open(io.BytesIO(data), formats=("PNG",))
    assert isinstance(low, ImageFile.ImageFile)
    # Read as if the low byte came first, the "high" byte that Pillow keeps is the low one.
    low.tile = [tile._replace(args=f"{tile.args[:-1]}L")]
    low.load()
    return low


def _values(image: Image.Image, low: Image.Image | None, path: Path) -> NDArray[np.float32]:
    """Return the ``(H, W, 3)`` or ``(H, W, 4)`` pixels of a loaded image in [0, 1]."""
    if image.mode == "F":
        values: NDArray[np.float32] = np.asarray(image)[..., None]
        if not (values >= 0).all() or not (values <= 1).all():
            raise InputError(f"{path}: image holds floats outside of 0 to 1, expected 8 or 16 bits a channel")
        return np.repeat(values, 3, axis=-1)
    if low is None and not image.mode.startswith("I"):
        mode = "RGBA" if image.has_transparency_data else "RGB"
        return _unit(np.asarray(image.convert(mode)), 255)
    words = (
        np.asarray(image)[..., None]
        if low is None
        else np.asarray(image).astype(np.uint16) << 8 | np.asarray(low)
    )
    if image.mode == "I" and image.format != "PNG":
        raise InputError(f"{path}: image holds 32-bit integers, expected 8 or 16 bits a channel")
    key = image.info.get("transparency")
    alpha = [] if key is None else [(words != np.array(key)).any(axis=-1, keepdims=True) * np.uint16(65535)]
    words = np.concatenate([np.repeat(words, 3, axis=-1) if low is None else words, *alpha], axis=-1)
    return _unit(words, 65535)


def _unit(values: NDArray[Any], top: int) -> NDArray[np.float32]:
    scaled: NDArray[np.float32] = np.divide(values, top, dtype=np.float32)
    return scaled
