"""The object of the built-in scene: a lighthouse on a floating island, as a union of convex solids.

It has what few-view reconstruction finds hard: slender parts (railing, fence, flagpole, spire), fine
texture (bricks, tiles, spiral bands), parts that hide each other, and glossy ones (lantern, buoy)
whose look changes with the view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gridreg.scenes.builtin.materials import (
    Colour,
    Material,
    bricks,
    checker,
    plain,
    speckle,
    spiral,
    strata,
)
from gridreg.scenes.builtin.solids import Ball, Cuboid, Frustum, Solid, rotate

__all__ = ["BOUNDS", "Part", "lighthouse"]

Array = NDArray[np.float64]

BOUNDS = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
"""Box that holds the object, world units."""

_WHITE: Colour = (0.93, 0.92, 0.88)
_RED: Colour = (0.80, 0.13, 0.12)
_DARK: Colour = (0.16, 0.15, 0.18)
_WOOD: Colour = (0.48, 0.30, 0.16)
_IRON = Material(plain((0.25, 0.27, 0.32)))
_TIMBER = Material(plain(_WOOD))


@dataclass(frozen=True)
class Part:
    """A solid in its place.

    Attributes:
        solid: the body, in its own frame.
        origin: ``(3,)`` where the frame's origin lies in the world.
        axes: ``(3, 3)`` rotation, columns are the frame's axes in the world.
        material: what it looks like.
    """

    solid: Solid
    origin: Array
    axes: Array
    material: Material

    def local(self, points: Array) -> Array:
        """Return ``(N, 3)`` world points in the part's frame."""
        return rotate(points - self.origin, self.axes)

    def world(self, points: Array) -> Array:
        """Return ``(N, 3)`` points of the part's frame in the world."""
        return rotate(points, self.axes.T) + self.origin


@cache
def lighthouse() -> tuple[Part, ...]:
    """Return the parts; the object is their union."""
    return (*_island(), *_tower(), *_house(), *_fence(), *_small_things())


def _at(solid: Solid, place: Sequence[float] | Array, material: Material, *, turn: float = 0.0) -> Part:
    """Place a solid upright, turned about z by ``turn`` radians."""
    return Part(solid, np.array(place, dtype=np.float64), _about_z(turn), material)


def _about_z(angle: float) -> Array:
    """Return the rotation about z by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _up(place: Array, rise: float) -> Array:
    return np.asarray(place + np.array([0.0, 0.0, rise]))


def _rod(start: Array, end: Array, radius: float, material: Material) -> Part:
    """Place a cylinder between two points."""
    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length
    helper = np.eye(3)[np.abs(z).argmin()]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return Part(Frustum(radius, radius, length), start, np.stack([x, np.cross(z, x), z], axis=-1), material)


def _ring(count: int, radius: float, x: float, y: float, z: float, first: float = 0.0) -> Array:
    """Return ``(count, 3)`` points on a level circle."""
    angle = first + 2 * np.pi * np.arange(count) / count
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(count, z)], axis=-1)


def _island() -> Iterator[Part]:
    rock = Material(strata((0.56, 0.48, 0.42), (0.82, 0.75, 0.66), thickness=0.11))
    grass = Material(speckle((0.22, 0.42, 0.16), (0.45, 0.62, 0.24), grain=0.055))
    yield _at(Frustum(0.98, 0.95, 0.10), (0, 0, -0.60), grass)
    # Solids overlap rather than touch: faces that coincide would count as surface from both sides.
    yield _at(Frustum(0.66, 0.94, 0.26), (0, 0, -0.84), rock)
    yield _at(Frustum(0.10, 0.66, 0.42), (0, 0, -1.24), rock)
    for x, y, z, radius in (
        (0.62, 0.55, -0.46, 0.13),
        (0.47, 0.66, -0.49, 0.08),
        (-0.70, -0.42, -0.48, 0.10),
    ):
        yield _at(Ball(radius), (x, y, z), rock)


def _tower() -> Iterator[Part]:
    x, y = -0.22, 0.14
    yield _at(Frustum(0.31, 0.18, 0.98), (x, y, -0.52), Material(spiral(_WHITE, _RED, pitch=0.52)))
    yield _at(Cuboid((0.07, 0.03, 0.12)), (x, y - 0.285, -0.40), Material(checker(_WOOD, _DARK, 0.035)))
    for level, turn in ((-0.02, 0.3), (0.18, 2.2), (0.02, 4.1)):
        radius = 0.31 - 0.13 * (level + 0.52) / 0.98
        window = _ring(1, radius - 0.01, x, y, level, turn)[0]
        yield _at(Cuboid((0.03, 0.035, 0.05)), window, Material(plain(_DARK), gloss=0.5), turn=turn)
    yield _at(Frustum(0.20, 0.34, 0.06), (x, y, 0.42), Material(plain(_WHITE)))
    feet, heads = _ring(12, 0.32, x, y, 0.47), _ring(12, 0.32, x, y, 0.62)
    middles = (feet + heads) / 2
    for k in range(12):
        yield _rod(feet[k], heads[k], 0.011, _IRON)
        yield _rod(heads[k - 1], heads[k], 0.012, _IRON)
        yield _rod(middles[k - 1], middles[k], 0.008, _IRON)
    yield _at(
        Frustum(0.13, 0.13, 0.27), (x, y, 0.47), Material(plain((0.95, 0.78, 0.28)), gloss=0.9, sharpness=25)
    )
    for foot, head in zip(_ring(6, 0.145, x, y, 0.47), _ring(6, 0.145, x, y, 0.76), strict=True):
        yield _rod(foot, head, 0.010, _IRON)
    yield _at(
        Frustum(0.21, 0.02, 0.24),
        (x, y, 0.73),
        Material(spiral(_RED, (0.55, 0.08, 0.09), pitch=9.0, starts=8)),
    )
    yield _at(Ball(0.035), (x, y, 0.985), Material(plain((0.85, 0.66, 0.25)), gloss=0.8))
    yield _rod(np.array([x, y, 1.0]), np.array([x, y, 1.22]), 0.009, _IRON)


def _house() -> Iterator[Part]:
    x, y, turn = 0.45, -0.18, 0.5
    wall = Material(bricks((0.70, 0.42, 0.30), (0.86, 0.82, 0.76), length=0.085, height=0.042))
    tiles = Material(checker((0.22, 0.30, 0.46), (0.34, 0.44, 0.60), 0.045))
    yield _at(Cuboid((0.24, 0.17, 0.14)), (x, y, -0.37), wall, turn=turn)
    # A box on its edge, sunk into the walls, is the gabled roof.
    upright = _about_z(turn)
    h = np.sqrt(0.5)
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, h, -h], [0.0, h, h]])
    yield Part(Cuboid((0.27, 0.135, 0.135)), np.array([x, y, -0.235]), upright @ tilted, tiles)
    yield _at(Cuboid((0.035, 0.035, 0.10)), np.array([x, y, -0.05]) + 0.14 * upright[:, 0], wall, turn=turn)
    door = np.array([x, y, -0.42]) + upright @ np.array([0.05, -0.165, 0.0])
    yield _at(Cuboid((0.045, 0.02, 0.09)), door, Material(plain((0.20, 0.45, 0.42))), turn=turn)
    pane = np.array([x, y, -0.36]) + upright @ np.array([-0.11, -0.165, 0.0])
    yield _at(Cuboid((0.04, 0.015, 0.04)), pane, Material(plain(_DARK), gloss=0.6), turn=turn)


def _fence() -> Iterator[Part]:
    angles = np.linspace(np.pi * 1.12, np.pi * 1.78, 9)
    feet = np.stack([0.86 * np.cos(angles), 0.86 * np.sin(angles), np.full(9, -0.51)], axis=-1)
    for k, foot in enumerate(feet):
        yield _rod(foot, _up(foot, 0.17), 0.014, _TIMBER)
        if k:
            for level in (0.08, 0.14):
                yield _rod(_up(feet[k - 1], level), _up(foot, level), 0.009, _TIMBER)


def _small_things() -> Iterator[Part]:
    # A bench: a seat that hides what is under it.
    yield _at(Cuboid((0.15, 0.055, 0.012)), (-0.05, -0.58, -0.41), _TIMBER, turn=0.15)
    for dx, dy in ((-0.12, -0.035), (-0.12, 0.035), (0.12, -0.035), (0.12, 0.035)):
        yield _at(Frustum(0.010, 0.010, 0.10), (-0.05 + dx, -0.58 + dy + 0.15 * dx, -0.51), _IRON)
    # A glossy buoy with a band.
    yield _at(Ball(0.14), (0.30, 0.52, -0.38), Material(plain((0.90, 0.35, 0.08)), gloss=0.9, sharpness=60))
    yield _at(Frustum(0.143, 0.143, 0.05), (0.30, 0.52, -0.405), Material(plain(_WHITE), gloss=0.5))
    # A flag of three stripes on a slender pole.
    pole = np.array([-0.66, 0.36, -0.51])
    yield _rod(pole, _up(pole, 0.75), 0.010, _TIMBER)
    yield _at(Ball(0.02), _up(pole, 0.76), Material(plain((0.85, 0.66, 0.25)), gloss=0.8))
    flag = Material(checker((0.12, 0.28, 0.62), (0.95, 0.85, 0.30), 0.06))
    yield _at(Cuboid((0.13, 0.006, 0.08)), pole + np.array([-0.09, 0.10, 0.65]), flag, turn=2.3)
    # A fir: cones stacked on a trunk.
    leaf = Material(speckle((0.10, 0.30, 0.18), (0.20, 0.46, 0.24), grain=0.04))
    yield _at(Frustum(0.03, 0.03, 0.15), (0.02, 0.72, -0.52), _TIMBER)
    for level, radius in ((-0.40, 0.16), (-0.28, 0.13), (-0.16, 0.10)):
        yield _at(Frustum(radius, 0.02, 0.18), (0.02, 0.72, level), leaf)
