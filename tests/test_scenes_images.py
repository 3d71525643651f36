"""Images: decoding to straight alpha, 16 bits, area means, and what is refused."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes.decoding import decode
from gridreg.scenes.images import area_mean, read_rgba


def paeth(a: int, b: int, c: int) -> int:
    p = a + b - c
    pa, pb, pc = abs(p - a), abs(p - b), abs(p - c)
    return a if pa <= pb and pa <= pc else b if pb <= pc else c


def encode_png16(pixels: np.ndarray, filters: list[int]) -> bytes:
    """Write a 16-bit PNG byte by byte, row k with filter ``filters[k]``."""
    height, width, channels = pixels.shape
    bpp = 2 * channels
    rows = [list(row.astype(">u2").tobytes()) for row in pixels]
    coded = bytearray()
    for k, row in enumerate(rows):
        up = rows[k - 1] if k else [0] * len(row)
        coded.append(filters[k])
        for i, value in enumerate(row):
            a = row[i - bpp] if i >= bpp else 0
            c = up[i - bpp] if i >= bpp else 0
            guess = (0, a, up[i], (a + up[i]) // 2, paeth(a, up[i], c))[filters[k]]
            coded.append((value - guess) % 256)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 16, 6 if channels == 4 else 2, 0, 0, 0)
    data = zlib.compress(bytes(coded))
    cut = len(data) // 2
    # Two IDAT chunks, since writers split long data.
    parts = [
        chunk(b"IHDR", header),
        chunk(b"IDAT", data[:cut]),
        chunk(b"IDAT", data[cut:]),
        chunk(b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@st.composite
def png16_cases(draw: st.DrawFn) -> tuple[np.ndarray, list[int]]:
    height, width, channels = draw(st.integers(1, 6)), draw(st.integers(1, 6)), draw(st.sampled_from([3, 4]))
    seed = draw(st.integers(0, 2**16))
    pixels = np.random.default_rng(seed).integers(0, 2**16, (height, width, channels))
    return pixels, draw(st.lists(st.integers(0, 4), min_size=height, max_size=height))


@settings(max_examples=60)
@given(png16_cases())
def test_16_bit_png_keeps_all_its_bits(
    tmp_path_factory: pytest.TempPathFactory, case: tuple[np.ndarray, list[int]]
) -> None:
    pixels, filters = case
    data = encode_png16(pixels, filters)
    path = tmp_path_factory.mktemp("png16") / "a.png"
    path.write_bytes(data)
    np.testing.assert_array_equal(decode(path).pixels, (pixels / 65535).astype(np.float32))
    # Pillow keeps the high bytes: an independent reader of the same file.
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels >> 8)


@pytest.mark.parametrize("end", [30, 60, -20, -5])
def test_truncated_16_bit_png(tmp_path: Path, end: int) -> None:
    path = tmp_path / "a.png"
    pixels = np.random.default_rng(0).integers(0, 2**16, (8, 8, 4))
    path.write_bytes(encode_png16(pixels, [k % 5 for k in range(8)])[:end])
    with pytest.raises(InputError, match=r"a\.png: not (a whole image|an image that can be read)"):
        read_rgba(path)


def test_damaged_16_bit_png(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    data = bytearray(encode_png16(np.zeros((4, 4, 4), dtype=int), [0] * 4))
    data[60] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"a\.png: not a whole image \(damaged chunk"):
        read_rgba(path)


def test_unknown_row_filter(tmp_path: Path) -> None:
    data = encode_png16(np.zeros((1, 1, 4), dtype=int), [0])
    # The same image with the filter byte 9, built by hand.
    body = zlib.compress(bytes([9] + [0] * 8))
    start = data.index(b"IDAT") - 4
    chunk = struct.pack(">I", len(body)) + b"IDAT" + body + struct.pack(">I", zlib.crc32(b"IDAT" + body))
    end = struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
    (tmp_path / "a.png").write_bytes(data[:start] + chunk + end)
    with pytest.raises(InputError, match=r"a\.png: not a whole image"):
        read_rgba(tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["png", "webp"])
def test_eight_bit_rgba(tmp_path: Path, kind: str) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    path = tmp_path / f"a.{kind}"
    Image.fromarray(pixels).save(path, **({"lossless": True, "exact": True} if kind == "webp" else {}))
    rgba = read_rgba(path)
    assert rgba.dtype == np.float32
    np.testing.assert_array_equal(rgba, (pixels / 255).astype(np.float32))


def test_grey_with_alpha_and_palette_with_transparency(tmp_path: Path) -> None:
    grey = np.stack([np.full((2, 2), 51), np.full((2, 2), 102)], axis=-1).astype(np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_allclose(read_rgba(tmp_path / "grey.png")[0, 0], [0.2, 0.2, 0.2, 0.4], rtol=1e-6)
    palette = Image.new("P", (2, 2), 1)
    palette.putpalette([0, 0, 0, 255, 0, 0])
    palette.save(tmp_path / "palette.png", transparency=1)
    np.testing.assert_allclose(read_rgba(tmp_path / "palette.png")[0, 0], [1, 0, 0, 0])


@pytest.mark.parametrize("mode", ["RGB", "L", "I;16"])
def test_without_alpha(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "a.png"
    Image.new(mode, (4, 3), 255 if mode != "I;16" else 65535).save(path)
    with pytest.raises(InputError, match=r"a\.png: image has no alpha channel, expected RGBA"):
        read_rgba(path)
    rgba = read_rgba(path, opaque=True)
    assert rgba.shape == (3, 4, 4)
    np.testing.assert_array_equal(rgba[..., 3], 1)


def test_jpeg_is_opaque(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (10, 200, 30)).save(tmp_path / "a.jpg", quality=95)
    with pytest.raises(InputError, match="no alpha"):
        read_rgba(tmp_path / "a.jpg")
    np.testing.assert_allclose(
        read_rgba(tmp_path / "a.jpg", opaque=True)[4, 4], [0.04, 0.78, 0.12, 1], atol=0.02
    )


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 0.9])
@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_truncated(tmp_path: Path, share: float, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    pixels = np.random.default_rng(0).integers(0, 256, (40, 40, 4 if kind == "png" else 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(
        InputError, match=rf"a\.{kind}: not (a whole image|an image that can be read)"
    ) as error:
        read_rgba(path, opaque=True)
    assert "\n" not in str(error.value)


def test_missing_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"b\.png: image not found"):
        read_rgba(tmp_path / "b.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_rgba(tmp_path)


@given(st.integers(1, 4), st.integers(1, 3), st.integers(1, 3), st.integers(0, 99))
def test_area_mean_is_the_mean_of_blocks(factor: int, rows: int, columns: int, seed: int) -> None:
    image = np.random.default_rng(seed).random((rows * factor, columns * factor, 4)).astype(np.float32)
    reduced = area_mean(image, factor)
    assert reduced.shape == (rows, columns, 4)
    for r in range(rows):
        for c in range(columns):
            block = image[r * factor : (r + 1) * factor, c * factor : (c + 1) * factor].astype(np.float64)
            np.testing.assert_allclose(reduced[r, c], block.reshape(-1, 4).mean(axis=0), rtol=1e-5)


@pytest.mark.parametrize("factor", [0, -1, 2, 4])
def test_area_mean_refuses_what_does_not_divide(factor: int) -> None:
    with pytest.raises(InputError, match=f"downscale: {factor} does not divide the image size 3x9"):
        area_mean(np.zeros((9, 3, 4), dtype=np.float32), factor)
