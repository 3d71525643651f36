"""Textures and shading of the built-in scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridreg.scenes.builtin.materials import (
    Material,
    Texture,
    bricks,
    checker,
    plain,
    shade,
    speckle,
    spiral,
    strata,
)

A, B = (0.1, 0.2, 0.3), (0.9, 0.7, 0.5)
TEXTURES: dict[str, Texture] = {
    "plain": plain(A),
    "checker": checker(A, B, 0.1),
    "spiral": spiral(A, B, pitch=0.5, starts=3),
    "bricks": bricks(A, B, length=0.1, height=0.05),
    "strata": strata(A, B, thickness=0.2),
    "speckle": speckle(A, B, grain=0.07),
}


def points(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, (count, 3))


@pytest.mark.parametrize("name", list(TEXTURES))
def test_colours_are_between_the_two_and_the_same_every_time(name: str) -> None:
    where = points(500)
    before = where.copy()
    colours = TEXTURES[name](where)
    assert colours.shape == (500, 3)
    # Bricks are tinted by up to 15 % besides.
    assert (colours >= 0.85 * np.array(A) - 1e-12).all()
    assert (colours <= np.array(B) + 1e-12).all()
    np.testing.assert_array_equal(colours, TEXTURES[name](where))
    np.testing.assert_array_equal(where, before)
    # A colour belongs to its point, whatever else is asked for.
    np.testing.assert_array_equal(TEXTURES[name](where[100:200]), colours[100:200])


@pytest.mark.parametrize("name", [name for name in TEXTURES if name != "plain"])
def test_both_colours_occur(name: str) -> None:
    colours = TEXTURES[name](points(4000))
    assert np.ptp(colours, axis=0).max() > 0.5


@given(st.integers(0, 1000))
def test_checker_changes_from_cell_to_cell(seed: int) -> None:
    texture = checker(A, B, 0.1)
    where = points(20, seed)
    here = texture(where)
    for axis in range(3):
        step = 0.1 * np.eye(3)[axis]
        assert (texture(where + step) != here).all()
        np.testing.assert_array_equal(texture(where + 2 * step), here)


@given(st.integers(0, 1000), st.floats(0.05, 2.0))
def test_spiral_repeats_after_a_turn_and_climbs(seed: int, pitch: float) -> None:
    texture = spiral(A, B, pitch=pitch)
    where = points(20, seed)
    # Half a pitch up is the other band; a turn by half brings it back.
    raised = where + np.array([0, 0, pitch / 2])
    assert (texture(raised) != texture(where)).all()
    np.testing.assert_array_equal(texture(raised * [-1, -1, 1]), texture(where))


def test_speckle_is_even_and_without_a_pattern() -> None:
    edge = 40
    cells = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    shade_of = speckle((0, 0, 0), (1, 1, 1), grain=1.0)(cells.astype(np.float64))[:, 0]
    assert shade_of.mean() == pytest.approx(0.5, abs=0.01)
    assert shade_of.std() == pytest.approx(12**-0.5, abs=0.01)
    volume = shade_of.reshape(edge, edge, edge)
    for axis in range(3):
        first, second = np.moveaxis(volume, axis, 0)[:-1], np.moveaxis(volume, axis, 0)[1:]
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05


def test_courses_of_bricks_are_shifted() -> None:
    texture = bricks((0.5, 0.5, 0.5), (1.0, 1.0, 1.0), length=1.0, height=1.0)
    along = np.linspace(0, 0.999, 200)

    def joints(level: float) -> np.ndarray:
        rows = np.stack([along, np.zeros(200), np.full(200, level)], axis=-1)
        return texture(rows)[:, 0] == 1.0

    assert joints(0.1).all()
    low, high = joints(0.5), joints(1.5)
    assert 0.1 < low.mean() < 0.15
    np.testing.assert_array_equal(np.roll(low, 100), high)


class TestShading:
    normals = points(300, 1) / np.linalg.norm(points(300, 1), axis=1, keepdims=True)
    views = points(300, 2) / np.linalg.norm(points(300, 2), axis=1, keepdims=True)

    def test_stays_in_range(self) -> None:
        for gloss in (0.0, 1.0):
            colours = shade(Material(TEXTURES["checker"], gloss), points(300), self.normals, self.views)
            assert colours.min() >= 0
            assert colours.max() <= 1

    def test_is_lambert_where_there_is_no_gloss(self) -> None:
        colours = shade(Material(plain((0.4, 0.4, 0.4))), points(300), self.normals, self.views)
        sun = np.array([0.45, -0.6, 0.66]) / np.linalg.norm([0.45, -0.6, 0.66])
        fill = np.array([-0.7, 0.5, 0.2]) / np.linalg.norm([-0.7, 0.5, 0.2])
        light = [
            0.42 + 0.1 * n[2] + 0.56 * max(float(n @ sun), 0) + 0.2 * max(float(n @ fill), 0)
            for n in self.normals
        ]
        np.testing.assert_allclose(colours[:, 0], 0.4 * np.array(light), rtol=1e-12)

    def test_gloss_only_adds_light_and_peaks_at_the_mirror_direction(self) -> None:
        sun = np.array([0.45, -0.6, 0.66]) / np.linalg.norm([0.45, -0.6, 0.66])
        normal = np.array([0.0, 0.0, 1.0])
        mirrored = 2 * (sun @ normal) * normal - sun
        dark = plain((0.05, 0.05, 0.05))
        around = mirrored + 0.5 * points(300, 3)
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        around = np.concatenate([mirrored[None], around[around[:, 2] > 0.4]])
        up = np.tile(normal, (len(around), 1))
        where = np.zeros((len(around), 3))
        matt = shade(Material(dark), where, up, around)
        glossy = shade(Material(dark, gloss=0.5), where, up, around)
        assert (glossy >= matt - 1e-12).all()
        assert glossy[:, 0].argmax() == 0
