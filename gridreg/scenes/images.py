"""Reading images into straight-alpha RGBA and masks as other tools mean them; copying and reducing images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from gridreg.errors import InputError
from gridreg.scenes.decoding import SIDEWAYS, decode, exif_orientation, exif_turn, open_image
from gridreg.scenes.files import read_bytes

__all__ = ["area_mean", "copy_upright", "fit_mask", "read_mask", "read_rgba"]

# Brightness above which a grey mask is white somewhere, and what JPEG leaves of black and white.
_WHITE, _NOISE = 0.97, 0.03
# Fraction of an image that flat areas of in-between values may cover: soft edges have none, labels are made
# of them.
_MOST_FLAT = 0.02


def read_rgba(
    path: Path, *, opaque: bool = False, stated: tuple[float, float] | None = None, as_stored: bool = False
) -> NDArray[np.float32]:
    """Read an image as float RGBA, see :func:`decode`.

    Args:
        path: the file.
        opaque: give images without alpha an alpha of 1 instead of refusing them.
        stated: see :func:`decode`.
        as_stored: see :func:`decode`.

    Returns:
        ``(H, W, 4)`` float32 in [0, 1] with straight alpha.

    Raises:
        InputError: as :func:`decode`, and when the image has no alpha channel.
    """
    pixels = decode(path, stated=stated, as_stored=as_stored).pixels
    if pixels.shape[-1] == 4:
        return pixels
    if not opaque:
        raise InputError(f"{path}: image has no alpha channel, expected RGBA")
    return np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)


def read_mask(path: Path, *, as_stored: bool = False) -> NDArray[np.float32]:
    """Read a mask: white (or opaque, where alpha varies) is kept, black is background.

    A mask of two values, one of them black, keeps the other, whatever it is (0 and 1, a palette, a colour).
    Grey edges are kept as they are.

    Args:
        path: the file.
        as_stored: see :func:`gridreg.scenes.decoding.decode`.

    Returns:
        ``(H, W)`` float32 in [0, 1].

    Raises:
        InputError: when the file is missing or cannot be decoded, or holds labels or colours that could mean
            anything.
    """
    return _meaning(decode(path, as_stored=as_stored).pixels, path)


def fit_mask(
    path: Path, size: tuple[int, int], turn: Image.Transpose | None, *, as_stored: bool
) -> NDArray[np.float32]:
    """Read the mask of an image, turned as its image was.

    Args:
        path: the mask's file.
        size: width and height of the image.
        turn: how the image was turned from what is stored.
        as_stored: whether the image's EXIF orientation was left aside.

    Returns:
        ``(H, W)`` float32 in [0, 1], of the image's size.

    Raises:
        InputError: as :func:`read_mask`; when the mask has another shape, or nothing says whether to turn it.
    """
    pixels, own = decode(path, as_stored=as_stored)
    height, width = pixels.shape[:2]
    if turn is not None and own is None:
        if turn in SIDEWAYS and (width, height) == size[::-1] and width != height:
            stored = Image.fromarray(np.rint(255 * _meaning(pixels, path)).astype(np.uint8))
            return np.asarray(np.asarray(stored.transpose(turn)) / 255, dtype=np.float32)
        if not (turn in SIDEWAYS and width != height):
            raise InputError(
                f"{path}: its image is stored turned (EXIF), and nothing says whether the mask is; save the image anew"
            )
    if (width, height) != size:
        raise InputError(f"{path}: mask is {width}x{height}, expected {size[0]}x{size[1]} as its image")
    return _meaning(pixels, path)


def _meaning(pixels: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """Return what a mask's pixels, ``(H, W, 3)`` or ``(H, W, 4)``, keep."""
    alpha = pixels[..., 3:]
    if alpha.size and alpha.min() < alpha.max():
        return np.asarray(alpha[..., 0])
    if alpha.size and alpha.max() < 1:
        raise InputError(f"{path}: mask is transparent everywhere, expected white where the object is")
    colours = pixels[..., :3]
    brightest = colours.max(axis=-1)
    kept = brightest > 0
    # A sole colour beside black (or alone) is what is kept, however dark it is: programs write 0 and 1.
    if not kept.any() or (colours[kept] == colours[kept][0]).all():
        return np.asarray(kept.astype(np.float32))
    if (brightest - colours.min(axis=-1)).max() > _NOISE:
        raise InputError(
            f"{path}: mask has several colours, expected white where the object is and black elsewhere"
        )
    if brightest.max() < _WHITE or _flat(brightest) > _MOST_FLAT:
        values = np.unique(np.rint(255 * brightest)).astype(int).tolist()
        raise InputError(
            f"{path}: mask holds the values {', '.join(map(str, values[:6]))}{', ...' * (len(values) > 6)} (labels?), "
            "expected white where the object is and black elsewhere"
        )
    return np.asarray(brightest)


def _flat(values: NDArray[np.float32]) -> float:
    """Return the fraction of pixels that lie, with their eight neighbours, in one value between black and
    white."""
    if min(values.shape) < 3:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(values, (3, 3))
    middle = windows[..., 1, 1]
    between = (middle > 0) & (middle < _WHITE)
    return float((between & (windows == middle[..., None, None]).all(axis=(2, 3))).mean())


def copy_upright(
    path: Path,
    target: Path,
    *,
    stated: tuple[float, float] | None = None,
    as_stored: bool = False,
) -> tuple[Path, tuple[int, int], Image.Transpose | None]:
    """Copy an image to where nothing but its pixels says which way is up.

    Bytes are copied where they can be. A PNG or JPEG that is stored turned is encoded anew (at quality 95),
    and so is what is neither PNG nor JPEG, as ``.jpg``, or ``.png`` if it has alpha; what tells the focal
    length is kept of EXIF data.

    Args:
        path: the image.
        target: where to write it; its extension may be replaced.
        stated: see :func:`decode`.
        as_stored: see :func:`decode`.

    Returns:
        The file written, its width and height, and how it was turned.

    Raises:
        InputError: when the image cannot be read.
    """
    with open_image(path) as image:
        image.load()
        turn = exif_turn(image, path, stated, as_stored)
        oriented = exif_orientation(image, path) != 1
        if image.format in ("PNG", "JPEG") and not oriented:
            target.write_bytes(read_bytes(path, "image"))
            return target, image.size, None
        exif = _lens_notes(image)
        upright = image if turn is None else image.transpose(turn)
        upright.info.clear()
        if image.format not in ("PNG", "JPEG", "MPO"):
            kind = "RGBA" if image.has_transparency_data else "RGB"
            upright = upright.convert(kind)
            target = target.with_name(target.name + (".png" if kind == "RGBA" else ".jpg"))
        upright.save(target, quality=95, exif=exif)
        return target, upright.size, turn


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
    height, width, _ = image.shape
    if factor < 1 or height % factor or width % factor:
        raise InputError(f"downscale: {factor} does not divide the image size {width}x{height}")
    if factor == 1:
        return image
    blocks = image.reshape(height // factor, factor, width // factor, factor, -1)
    reduced: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return reduced
