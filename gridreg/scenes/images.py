"""Reading images into straight-alpha RGBA, and reducing them by area means."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from gridreg.errors import InputError
from gridreg.scenes.png16 import decode_png16, is_png16

__all__ = ["area_mean", "copy_upright", "read_mask", "read_rgba", "upright"]

_DECODER_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
_ORIENTATION = 274
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def read_rgba(
    path: Path, *, opaque: bool = False, stated: tuple[int, int] | None = None, as_stored: bool = False
) -> NDArray[np.float32]:
    """Read a PNG or JPEG (or anything else Pillow knows) as float RGBA, turned upright as its EXIF data say.

    Args:
        path: the file.
        opaque: give images without alpha an alpha of 1 instead of refusing them.
        stated: width and height of the camera: where EXIF would swap the two, they say whether to turn.
        as_stored: do not turn the image where the size does not tell.

    Returns:
        ``(H, W, 4)`` float32 in [0, 1] with straight alpha.

    Raises:
        InputError: when the file is missing, cannot be decoded, has no alpha channel or broken EXIF data.
    """
    data = _read_bytes(path)
    try:
        rgba = decode_png16(data) if is_png16(data) else _decode(data, path, stated, as_stored)
    except _DECODER_ERRORS as error:
        raise _not_whole(path, error) from None
    if rgba.shape[-1] == 3:
        if not opaque:
            raise InputError(f"{path}: image has no alpha channel, expected RGBA")
        rgba = np.concatenate([rgba, np.ones_like(rgba[..., :1])], axis=-1)
    return rgba


def read_mask(path: Path) -> NDArray[np.float32]:
    """Read a mask: white (or opaque, where it has alpha) is kept, black is background.

    Returns:
        ``(H, W)`` float32 in [0, 1].

    Raises:
        InputError: when the file is missing or cannot be decoded.
    """
    data = _read_bytes(path)
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.has_transparency_data:
                grey = image.convert("RGBA").getchannel("A")
            elif image.mode.startswith("I;16"):
                grey = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
            else:
                grey = image.convert("L")
            mask: NDArray[np.float32] = np.divide(np.asarray(grey), 255, dtype=np.float32)
            return mask
    except _DECODER_ERRORS as error:
        raise _not_whole(path, error) from None


def upright(image: Image.Image, path: Path) -> int:
    """Return the EXIF orientation of an opened image: 1 is upright, 5 to 8 swap width and height.

    Raises:
        InputError: for EXIF data that cannot be read.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # Read anew, because opening a JPEG has tried already and keeps silent about damage.
            Image.Exif().load(image.info.get("exif", b""))
            orientation = image.getexif().get(_ORIENTATION, 1)
    except (*_DECODER_ERRORS, Warning) as error:
        raise InputError(
            f"{path}: EXIF data cannot be read ({_one_line(error, path)}), save it anew"
        ) from None
    if orientation not in range(1, 9):
        raise InputError(f"{path}: EXIF orientation is {orientation!r}, expected 1 to 8")
    return int(orientation)


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: image not found") from None
    except OSError as error:
        raise InputError(f"{path}: image cannot be read ({error.strerror})") from None


def _not_whole(path: Path, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{path}: not a whole image ({_one_line(error, path)})")


def _one_line(error: Exception, path: Path) -> str:
    return " ".join(str(error).replace(str(path), "").split()) or type(error).__name__


def _open(data: bytes) -> Image.Image:
    """Open an image without Pillow's own words on broken EXIF data: `upright` refuses them in one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Image.open(io.BytesIO(data))


def _decode(data: bytes, path: Path, stated: tuple[int, int] | None, as_stored: bool) -> NDArray[np.float32]:
    """Decode to ``(H, W, 3)`` or ``(H, W, 4)``, whichever the file holds."""
    with _open(data) as opened:
        image, _ = _turned(opened, path, stated, as_stored)
        if image.mode.startswith("I;16"):
            grey: NDArray[np.float32] = np.divide(np.asarray(image), 65535, dtype=np.float32)
            return np.repeat(grey[..., None], 3, axis=-1)
        mode = "RGBA" if opened.has_transparency_data else "RGB"
        pixels: NDArray[np.float32] = np.divide(np.asarray(image.convert(mode)), 255, dtype=np.float32)
        return pixels


def _turned(
    opened: Image.Image, path: Path, stated: tuple[int, int] | None, as_stored: bool
) -> tuple[Image.Image, bool]:
    """Return an opened image as its camera saw it, and whether its EXIF data say that it is stored turned."""
    # Pillow reads a PNG to its end to find EXIF data: a cut image has to fail before.
    opened.load()
    orientation = upright(opened, path)
    if orientation == 1:
        return opened, False
    sideways = orientation >= 5 and opened.width != opened.height
    keep = opened.size == stated if sideways and stated is not None else as_stored
    return (opened if keep else opened.transpose(_TURNS[orientation])), True


def copy_upright(
    path: Path, target: Path, *, stated: tuple[int, int] | None = None, as_stored: bool = False
) -> tuple[int, int]:
    """Copy an image to where nothing but its pixels says which way is up, and return its width and height.

    Bytes are copied where they can be; a JPEG that is stored turned is encoded anew at quality 95, and keeps of its
    EXIF data what tells the focal length.

    Args:
        path: the image.
        target: where to write it, with the same extension.
        stated: see :func:`read_rgba`.
        as_stored: see :func:`read_rgba`.

    Raises:
        InputError: when the image cannot be read.
    """
    data = _read_bytes(path)
    try:
        with _open(data) as opened:
            image, anew = _turned(opened, path, stated, as_stored)
            size = image.size
            exif = _lens_notes(opened) if anew else Image.Exif()
            if anew:
                image.info.clear()
    except _DECODER_ERRORS as error:
        raise _not_whole(path, error) from None
    if anew:
        image.save(target, quality=95, exif=exif)
    else:
        target.write_bytes(data)
    return size


def _lens_notes(image: Image.Image) -> Image.Exif:
    """Return the part of the EXIF data that tells the focal length: structure from motion starts from it."""
    old, new = image.getexif(), Image.Exif()
    new.update({tag: old[tag] for tag in (ExifTags.Base.Make, ExifTags.Base.Model) if tag in old})
    noted = old.get_ifd(ExifTags.IFD.Exif)
    lens = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
    kept = {tag: noted[tag] for tag in lens if tag in noted}
    if kept:
        new[ExifTags.IFD.Exif] = kept
    return new


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
