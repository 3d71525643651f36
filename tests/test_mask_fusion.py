"""Parts of the fusion of masks: smoothing along edges, outlines, and what others know of a pixel's ray."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from gridreg.export.cameras import look_at
from gridreg.scenes.board import get_board
from gridreg.scenes.lens import LensDistortion
from gridreg.scenes.mask_fusion import _bins, _flood, _guided, _histogram, _median, _outline, normalised
from gridreg.scenes.photo_hull import carve
from gridreg.scenes.sheet_views import SheetView


def view_around(azimuth: float, elevation: float = 30.0) -> SheetView:
    """120 by 160 pixels of what stands on the sheet."""
    a, e = np.radians([azimuth, elevation])
    place = 0.4 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    pose = look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])).double().numpy()
    return SheetView(
        np.full((120, 160, 3), 128, np.uint8), pose, (150.0, 150.0, 80.0, 60.0), LensDistortion(k1=0.02)
    )


def test_parts_and_reduced_images_show_points_where_the_photograph_does() -> None:
    view = view_around(20.0)
    points = np.random.default_rng(0).uniform(-0.04, 0.04, (50, 3))
    whole, seen = view.positions(points)
    part, _ = view.cropped(slice(20, 100), slice(30, 130)).positions(points)
    half, _ = view.reduced(80).positions(points)
    assert seen.all()
    np.testing.assert_allclose(part, whole - [20, 30], atol=1e-9)
    np.testing.assert_allclose(half, whole / 2, atol=1e-9)
    assert view.cropped(slice(20, 100), slice(30, 130)).inner
    assert not view.cropped(slice(20, 120), slice(30, 130)).inner
    assert not view.inner


def test_the_guided_filter_smooths_up_to_an_edge_of_its_guide() -> None:
    rng = np.random.default_rng(0)
    guide = np.zeros((20, 40, 3), np.float32)
    guide[:, 20:] = 1
    values = np.where(guide[..., 0] > 0, 2.0, -2.0) + rng.normal(size=(20, 40))
    found = _guided(values, guide)
    assert found[:, 15:20].max() < 0 < found[:, 20:25].min()
    assert np.abs(np.abs(found) - 2).mean() < 0.3 * np.abs(np.abs(values) - 2).mean()
    np.testing.assert_allclose(_guided(np.full((9, 9), 3.0), np.zeros((9, 9, 3), np.float32)), 3.0)


def test_lower_medians_of_what_is_there() -> None:
    values = np.array([[5.0, 1.0], [np.inf, 2.0], [1.0, 9.0], [3.0, 4.0]], np.float32)
    assert _median(values, np.array([3, 4])).tolist() == [3.0, 2.0]
    deep = np.stack([values, values + 1], axis=-1)
    assert _median(deep, np.array([3, 4])).tolist() == [[3.0, 4.0], [2.0, 3.0]]


def test_densities_of_colours_sum_to_one() -> None:
    colours = np.random.default_rng(0).uniform(0.2, 1.0, (500, 3)).astype(np.float32)
    density = _histogram(colours)
    assert abs(density.sum() * (1.3 / 24) ** 3 - 1) < 1e-6
    assert density[_bins(colours)].min() > density[_bins(np.full((1, 3), 1.25, np.float32))][0]


def test_white_paper_is_one() -> None:
    rgb = np.full((2, 2, 3), 180, np.uint8)
    np.testing.assert_allclose(normalised(rgb, (np.array([180, 180, 180]) / 255) ** 2.2), 1.0, atol=1e-6)


def test_what_is_undecided_ends_at_an_edge() -> None:
    colours = np.zeros((20, 40, 3), np.float32)
    colours[:, 22:] = 0.8
    evidence = np.zeros((20, 40))
    evidence[:, :5], evidence[:, 35:] = -3, 3
    found = _flood(evidence, colours)
    assert not found[:, :21].any()
    assert found[:, 23:].all()
    assert (_flood(np.full((4, 4), -0.5), colours[:4, :4]) == 0).all()


def test_mixed_pixels_belong_to_the_larger_share() -> None:
    colours = np.zeros((20, 20, 3), np.float32)
    colours[:, 10:] = 1.0
    colours[:, 9], colours[:, 10] = 0.3, 0.7
    for first in (9, 10, 11):
        mask = np.zeros((20, 20), bool)
        mask[:, first:] = True
        assert (_outline(mask, colours) == (np.arange(20) >= 10)).all(), first


def test_others_tell_where_matter_may_be_and_whether_its_colour_is_theirs() -> None:
    # A ball of 3 cm, red for all, but for one photograph that sees it blue.
    views = [view_around(45.0 * k, 25.0 + 10 * (k % 2)) for k in range(8)]
    middle, evidence = np.array([0.0, 0.0, 0.04]), []
    inside = []
    for k, view in enumerate(views):
        rows, columns = np.meshgrid(np.arange(120) + 0.5, np.arange(160) + 0.5, indexing="ij")
        at = view.positions(middle[None])[0][0]
        disc = np.hypot(rows - at[0], columns - at[1]) < 0.015 * 150 / np.linalg.norm(
            view.pose[:3, 3] - middle
        )
        inside.append(disc)
        evidence.append(np.where(disc, 4.0, -4.0))
        view.colours = np.full((120, 160, 3), 0.5, np.float32)
        view.colours[disc] = (0.1, 0.1, 0.8) if k == 3 else (0.8, 0.1, 0.1)
    hulls, agreeing = carve(views, evidence, get_board("a4"), 2e-3, (4.0, 0.5))
    for k, (hull, agree, disc) in enumerate(zip(hulls, agreeing, inside, strict=True)):
        assert (hull[disc] == 3.5).all()
        grown = ndimage.binary_dilation(disc, np.ones((11, 11)))
        assert (hull[~grown] <= 0).all()
        # Along outlines its colour may be the mixed one of the seventh.
        assert np.median(agree[disc]) == (0 if k == 3 else 6)
    # One that errs does not carve it away, but its own pixels are told of it.
    evidence[0] = np.full((120, 160), -4.0)
    hulls, _ = carve(views, evidence, get_board("a4"), 2e-3, (3.0, 1.0))
    assert (hulls[0][inside[0]] == 7.0).all()
    assert (hulls[1][inside[1]] == 3.0).all()
