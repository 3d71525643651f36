"""Renders beside targets, error maps, depth and contact sheets."""

from __future__ import annotations

import math

import imageio.v3 as iio
import matplotlib
import numpy as np
import pytest
import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Rendered
from gridreg.training import images as image_arrays
from gridreg.training import outputs
from gridreg.training.evaluate import Scored


def inferno(share: np.ndarray) -> np.ndarray:
    """The colour scale, written independently of the code under test."""
    return np.round(matplotlib.colormaps["inferno"](np.round(share * 255).astype(int))[..., :3] * 255)


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(30, 40, 3, generator=generator)
    return (target + 0.2 * torch.rand(30, 40, 3, generator=generator)).clamp(0, 1), target


def test_to_uint8_rounds_and_clamps():
    image = torch.tensor([[[-1.0, 0.0, 0.499 / 255], [0.501 / 255, 2.0, math.nan]]])
    assert image_arrays.to_uint8(image).tolist() == [[[0, 0, 0], [1, 255, 0]]]
    with pytest.raises(InputError, match=r"expected \(H, W, 3\)"):
        image_arrays.to_uint8(torch.zeros(3, 4))


def test_error_map_is_the_rms_over_channels(pair):
    image, target = pair
    expected = np.sqrt(((image.double() - target.double()).numpy() ** 2).mean(-1)) / outputs.MAX_ERROR
    got = outputs.error_map(image, target)
    assert got.dtype == np.uint8
    assert np.abs(got - inferno(np.clip(expected, 0, 1))).max() <= 1


def test_error_map_ends(pair):
    _, target = pair
    assert (outputs.error_map(target, target) == inferno(np.zeros(1))).all()
    assert (outputs.error_map(torch.ones(4, 4, 3), torch.zeros(4, 4, 3)) == inferno(np.ones(1))).all()
    nan = torch.full((4, 4, 3), math.nan)
    assert (outputs.error_map(nan, torch.zeros(4, 4, 3)) == inferno(np.ones(1))).all()


def test_comparison_holds_target_render_and_error_in_this_order():
    generator = torch.Generator().manual_seed(1)
    image, target = torch.rand(2, 220, 210, 3, generator=generator)
    picture = outputs.comparison(image, target, {"psnr": 20.123, "ssim_gaussian": 0.5})
    body = picture[-220:]
    assert np.array_equal(body[:, :210], image_arrays.to_uint8(target))
    assert np.array_equal(body[:, 214:424], image_arrays.to_uint8(image))
    assert np.array_equal(body[:, 428:638], outputs.error_map(image, target))
    assert picture.shape[1] > 638 + 40
    strip = picture[:-220]
    for left in (0, 214, 428):
        assert (strip[:, left : left + 210] < 128).any()


def test_small_images_are_enlarged_by_whole_pixels(pair):
    image, target = pair
    picture = outputs.comparison(image, target, {})
    body = picture[-150:]
    assert np.array_equal(body[:, :200], image_arrays.to_uint8(target).repeat(5, 0).repeat(5, 1))


def test_labels_are_cut_and_not_wrapped():
    picture = np.zeros((5, 30, 3), np.uint8)
    got = image_arrays.labelled(picture, "a label that is much wider than thirty pixels")
    assert got.shape[1:] == (30, 3)
    assert np.array_equal(got[-5:], picture)


@pytest.mark.parametrize("height", [2, 5, 20, 100, 400])
def test_scale_bar_goes_from_low_below_to_high_above(height):
    bar = image_arrays.scale_bar(height, 0.0, 2.0)
    assert bar.shape == image_arrays.scale_bar(height, 0.0, 2.0, unit="depth").shape == (height, 64, 3)
    ramp = bar[:, 10].astype(int)
    coloured = ramp[(ramp != 255).any(-1)]
    assert len(coloured) >= 2
    assert coloured[0].sum() > coloured[-1].sum()


def test_the_unit_stands_above_the_scale():
    with_unit, without = (image_arrays.scale_bar(200, 0.0, 1.0, unit=unit)[:16] for unit in ("depth", ""))
    assert (with_unit < 128).any()
    assert (without[:, :20][:8] == 255).all()


def test_rows_and_thumbnails():
    low, high = np.zeros((2, 3, 3), np.uint8), np.full((4, 1, 3), 7, np.uint8)
    got = image_arrays.row([low, high], gap=2)
    assert got.shape == (4, 6, 3)
    assert (got[:2, :3] == 0).all()
    assert (got[2:, :3] == 255).all()
    assert (got[:, 3:5] == 255).all()
    assert (got[:, 5] == 7).all()
    assert image_arrays.thumbnail(np.zeros((100, 50, 3), np.uint8), 10).shape == (10, 5, 3)
    assert image_arrays.thumbnail(np.zeros((1, 1000, 3), np.uint8), 10).shape == (1, 10, 3)


def test_depth_is_the_mean_distance_near_is_blue_and_nothing_is_white():
    distance = torch.linspace(2, 6, 300)[None, :].expand(240, 300)
    opacity = torch.full((240, 300), 0.8)
    opacity[:120] = 0
    picture = outputs.depth_image(distance * opacity, opacity)[:, :300].astype(int)
    assert (picture[:120] == 255).all()
    redness = picture[200, :, 0] - picture[200, :, 2]
    assert redness[5] < redness[150] < redness[294]
    scale = matplotlib.colormaps["turbo"]
    # 4 world units stand in the middle of the scale, blended with white by the opacity.
    expected = 0.8 * np.array(scale(0.5)[:3]) * 255 + 0.2 * 255
    assert np.abs(picture[200, 150] - expected).max() <= 4


@pytest.mark.parametrize("opacity", [0.0, 1.0, math.nan])
def test_depth_of_nothing_and_of_a_flat_wall(opacity):
    opacities = torch.full((20, 20), opacity)
    picture = outputs.depth_image(3 * opacities, opacities)
    assert picture.shape[0] == 200
    white = (picture[:, :200] == 255).all()
    assert white == (opacity != 1.0)


def scored(image: Tensor, target: Tensor, psnr: float = 20.0, name: str = "r_0") -> Scored:
    depth = torch.ones(image.shape[:2])
    return Scored(name, Rendered(image, depth, depth), target, {"psnr": psnr})


def test_a_scored_view_is_three_pictures(tmp_path, pair):
    outputs.save_scored(tmp_path, scored(*pair, psnr=math.inf))
    image, target = pair
    assert sorted(p.name for p in tmp_path.iterdir()) == ["r_0.png", "r_0_compare.png", "r_0_depth.png"]
    assert np.array_equal(iio.imread(tmp_path / "r_0.png"), image_arrays.to_uint8(image))
    assert np.array_equal(iio.imread(tmp_path / "r_0_compare.png")[-150:, :200], picture_of(target))


def picture_of(image: Tensor) -> np.ndarray:
    return image_arrays.to_uint8(image).repeat(5, 0).repeat(5, 1)


@pytest.mark.parametrize("count", [1, 4, 7])
def test_contact_sheet_holds_every_pair(tmp_path, count):
    images = [torch.full((20, 20, 3), (i + 1) / 10) for i in range(count)]
    targets = [torch.full((20, 20, 3), (i + 1) / 20) for i in range(count)]
    path = tmp_path / "sheet.png"
    outputs.save_contact_sheet(path, [scored(*pair) for pair in zip(images, targets, strict=True)])
    sheet = iio.imread(path)
    for index in range(count):
        line, column = divmod(index, 5)
        y, x = line * (160 + 20 + 8) + 20 + 20, column * (321 + 8) + 20
        assert (sheet[y, x] == image_arrays.to_uint8(targets[index])[0, 0]).all()
        assert (sheet[y, x + 161] == image_arrays.to_uint8(images[index])[0, 0]).all()


def test_shapes_that_do_not_fit(pair):
    image, target = pair
    with pytest.raises(InputError, match="expected equal shapes"):
        outputs.comparison(image[:-1], target, {})
    with pytest.raises(InputError, match=r"expected \(H, W\) both"):
        outputs.depth_image(torch.zeros(3, 3), torch.zeros(3, 4))


def test_an_unwritable_place_is_one_line(tmp_path, pair):
    with pytest.raises(InputError, match=r"none/r_0\.png: cannot write here") as caught:
        outputs.save_scored(tmp_path / "none", scored(*pair))
    assert "\n" not in str(caught.value)
