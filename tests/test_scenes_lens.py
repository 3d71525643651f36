"""Lens distortion and EXIF orientation: images become what an upright pinhole would have taken."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import map_coordinates

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene
from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.builtin.raycast import render_rgba
from gridreg.scenes.images import read_mask, read_rgba
from gridreg.scenes.lens import NO_DISTORTION, LensDistortion, undistort

small = st.floats(-0.08, 0.08)
lenses = st.builds(
    LensDistortion, k1=small, k2=small, p1=st.floats(-0.01, 0.01), p2=st.floats(-0.01, 0.01), k3=small
)


def opencv(lens: LensDistortion, x: float, y: float) -> tuple[float, float]:
    """Write the formula of OpenCV's manual out, term by term."""
    r = (x**2 + y**2) ** 0.5
    factor = (1 + lens.k1 * r**2 + lens.k2 * r**4 + lens.k3 * r**6) / (
        1 + lens.k4 * r**2 + lens.k5 * r**4 + lens.k6 * r**6
    )
    u = x * factor + 2 * lens.p1 * x * y + lens.p2 * (r**2 + 2 * x**2)
    v = y * factor + lens.p1 * (r**2 + 2 * y**2) + 2 * lens.p2 * x * y
    return u, v


@given(lenses, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), small, small, small)
def test_distortion_is_opencvs(
    lens: LensDistortion, x: float, y: float, k4: float, k5: float, k6: float
) -> None:
    lens = LensDistortion(lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, k4, k5, k6)
    np.testing.assert_allclose(lens.distort(np.array(x), np.array(y)), opencv(lens, x, y), atol=1e-12)


def inverse(lens: LensDistortion, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find what the lens shows at x, y by fixed-point iteration."""
    u, v = x, y
    for _ in range(60):
        du, dv = opencv(lens, u, v)
        u, v = u + x - du, v + y - dv
    np.testing.assert_allclose(opencv(lens, u, v), (x, y), atol=1e-9)
    return u, v


def test_a_pinhole_is_falsy_and_keeps_the_image() -> None:
    assert not NO_DISTORTION
    assert LensDistortion(p2=1e-9)
    image = np.random.default_rng(0).random((6, 8, 4)).astype(np.float32)
    intrinsics = np.array([9.0, 9.0, 4.0, 3.0])
    same, values = undistort(image, intrinsics, NO_DISTORTION, "here")
    np.testing.assert_allclose(same, image, atol=1e-4)
    np.testing.assert_allclose(values, intrinsics, rtol=1e-4)


@settings(max_examples=15, deadline=None)
@given(lenses)
def test_a_distorted_image_becomes_the_pinhole_image(lens: LensDistortion) -> None:
    # Smooth colours, functions of the viewing direction, so that resampling costs little.
    def colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        waves = [np.sin(5 * x + 2 * y), np.cos(4 * y - x), np.sin(3 * x * y + 1), np.ones_like(x)]
        return 0.5 + 0.5 * np.stack(waves, axis=-1)

    intrinsics, width, height = np.array([70.0, 66.0, 41.0, 28.0]), 80, 60
    rows, columns = np.mgrid[:height, :width] + 0.5
    u, v = (columns - intrinsics[2]) / intrinsics[0], (rows - intrinsics[3]) / intrinsics[1]
    image = colour(*inverse(lens, u, v)).astype(np.float32)
    flat, pinhole = undistort(image, intrinsics, lens, "here")
    assert flat.shape == image.shape
    np.testing.assert_array_equal(pinhole[2:], intrinsics[2:])
    assert pinhole[0] / intrinsics[0] == pytest.approx(pinhole[1] / intrinsics[1])
    expected = colour((columns - pinhole[2]) / pinhole[0], (rows - pinhole[3]) / pinhole[1])
    np.testing.assert_allclose(flat, expected, atol=5e-3)


@given(lenses)
@settings(max_examples=30, deadline=None)
def test_the_zoom_is_the_least_that_shows_no_edge(lens: LensDistortion) -> None:
    # An image that is its own column and row tells where each pixel was taken from.
    height, width = 40, 50
    rows, columns = np.mgrid[:height, :width] + 0.5
    image = np.stack([columns, rows, rows, np.ones_like(rows)], axis=-1).astype(np.float32)
    intrinsics = np.array([45.0, 45.0, 25.0, 20.0])
    flat, pinhole = undistort(image, intrinsics, lens, "here")
    gap = min(
        float((columns.max() - flat[..., 0]).min()),
        float((flat[..., 0] - 0.5).min()),
        float((rows.max() - flat[..., 1]).min()),
        float((flat[..., 1] - 0.5).min()),
    )
    assert gap == pytest.approx(0, abs=1e-3)
    assert 0.5 < pinhole[0] / 45 < 2


def test_too_strong_a_lens() -> None:
    with pytest.raises(InputError, match=r"frame 3: lens distortion .* is too strong to be undone"):
        undistort(
            np.zeros((9, 9, 4), np.float32), np.array([5.0, 5, 4.5, 4.5]), LensDistortion(k1=-90), "frame 3"
        )


def test_a_scene_taken_through_a_lens(tmp_path: Path) -> None:
    """The built-in object through a distorting lens, loaded, against the same object through a pinhole."""
    lens = {"k1": 0.25, "k2": -0.05, "p1": 0.004, "p2": -0.002}
    size, fine = 120, 3
    focal = 165.0
    intrinsics = np.array([focal, focal, size / 2, size / 2])
    pose = look_at_origin(30, 20)
    sharp = render_rgba(pose, intrinsics * fine, size * fine, size * fine, samples=1)
    sharp[..., :3] = sharp[..., :3] * sharp[..., 3:] + 1 - sharp[..., 3:]
    sharp[..., 3] = 1
    rows, columns = np.mgrid[: size * fine, : size * fine] + 0.5
    x, y = (columns / fine - size / 2) / focal, (rows / fine - size / 2) / focal
    u, v = inverse(LensDistortion(**lens), x, y)
    place = [(v * focal + size / 2) * fine - 0.5, (u * focal + size / 2) * fine - 0.5]
    bent = np.stack(
        [map_coordinates(sharp[..., c], place, order=1, mode="nearest") for c in range(4)], axis=-1
    )
    stored = bent.reshape(size, fine, size, fine, 4).mean(axis=(1, 3))
    (tmp_path / "images").mkdir()
    frames = []
    for k in range(2):
        Image.fromarray((stored * 255).round().astype(np.uint8)).save(tmp_path / f"images/{k}.png")
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": focal, "frames": frames, **lens}))
    views = load_scene(tmp_path, "holdout8").train
    expected = render_rgba(pose, views.intrinsics[0].numpy().astype(np.float64), size, size, samples=4)
    over_white = expected[..., :3] * expected[..., 3:] + 1 - expected[..., 3:]
    error = (views.composited("white")[0].numpy() - over_white) ** 2
    untouched = stored[..., :3]
    assert -10 * np.log10(error.mean()) > 24
    assert error.mean() < 0.25 * ((untouched - over_white) ** 2).mean()


class TestOrientation:
    """An image of 4x6 whose pixels differ, stored turned in all the ways that EXIF knows."""

    pixels = np.random.default_rng(0).integers(0, 256, (6, 4, 4), dtype=np.uint8)
    # For orientation k: how an upright array is stored (EXIF 2.3, tag 274).
    stored: ClassVar = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a),
        7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
        8: lambda a: np.rot90(a, -1),
    }

    def save(self, path: Path, orientation: int) -> None:
        exif = Image.Exif()
        exif[274] = orientation
        array = np.ascontiguousarray(self.stored[orientation](self.pixels))
        Image.fromarray(array).save(path, exif=exif)

    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_images_are_turned_upright(self, tmp_path: Path, orientation: int) -> None:
        self.save(tmp_path / "a.png", orientation)
        expected = (self.pixels / 255).astype(np.float32)
        np.testing.assert_array_equal(read_rgba(tmp_path / "a.png"), expected)
        np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", stated=(4, 6)), expected)

    @pytest.mark.parametrize("orientation", [5, 6, 7, 8])
    def test_unless_the_camera_has_the_stored_size(self, tmp_path: Path, orientation: int) -> None:
        self.save(tmp_path / "a.png", orientation)
        raw = (self.stored[orientation](self.pixels) / 255).astype(np.float32)
        np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", stated=(6, 4)), raw)

    def test_where_the_size_does_not_tell(self, tmp_path: Path) -> None:
        self.save(tmp_path / "a.png", 3)
        raw = (self.stored[3](self.pixels) / 255).astype(np.float32)
        np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", stated=(4, 6), as_stored=True), raw)
        np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", stated=(4, 6)), raw[::-1, ::-1])

    @pytest.mark.parametrize("orientation", [0, 9, 77])
    def test_unknown(self, tmp_path: Path, orientation: int) -> None:
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(self.pixels).save(tmp_path / "a.png", exif=exif)
        with pytest.raises(InputError, match=rf"a\.png: EXIF orientation is {orientation}, expected 1 to 8"):
            read_rgba(tmp_path / "a.png")

    def test_unreadable(self, tmp_path: Path) -> None:
        Image.fromarray(self.pixels[..., :3]).save(
            tmp_path / "a.jpg", exif=b"Exif\0\0garbage that is no TIFF"
        )
        with pytest.raises(
            InputError, match=r"a\.jpg: EXIF data cannot be read \(.*\), save it anew"
        ) as error:
            read_rgba(tmp_path / "a.jpg", opaque=True)
        assert "\n" not in str(error.value)


def test_masks(tmp_path: Path) -> None:
    grey = np.array([[0, 51, 255]], dtype=np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(np.dstack([grey] * 3)).save(tmp_path / "rgb.png")
    Image.fromarray(np.dstack([np.zeros_like(grey)] * 3 + [grey])).save(tmp_path / "rgba.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "grey16.png")
    for name in ("grey", "rgb", "rgba", "grey16"):
        np.testing.assert_allclose(read_mask(tmp_path / f"{name}.png"), [[0, 0.2, 1]], atol=1e-6)
    (tmp_path / "grey.png").write_bytes(b"no")
    with pytest.raises(InputError, match=r"grey\.png: not an image that can be read"):
        read_mask(tmp_path / "grey.png")


def test_turned_images_of_a_scene(tmp_path: Path) -> None:
    """Images stored sideways load as the upright ones they came from."""
    source = builtin_scene(tmp_path, size=16)
    expected = load_scene(source, "builtin8")
    turned: Any = shutil.copytree(source, tmp_path / "turned")
    exif = Image.Exif()
    exif[274] = 6
    for path in (turned / "train").iterdir():
        Image.fromarray(np.ascontiguousarray(np.rot90(np.asarray(Image.open(path))))).save(path, exif=exif)
    assert torch.equal(load_scene(turned, "builtin8").train.rgba, expected.train.rgba)
