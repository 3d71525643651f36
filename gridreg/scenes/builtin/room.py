"""The room of the built-in photographs: the lighthouse on the sheet, on a table, among clutter.

Units are the lighthouse's; one is `METRES` long, and the table stands where the lighthouse's foot is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter  # type: ignore[import-untyped]

from gridreg.scenes.board import board_image, get_board
from gridreg.scenes.builtin.lighthouse import Part
from gridreg.scenes.builtin.materials import Material, bricks, checker, plain, speckle, spiral, strata
from gridreg.scenes.builtin.raycast import cast
from gridreg.scenes.builtin.solids import Ball, Cuboid, Frustum

__all__ = ["METRES", "TABLE", "room"]

Array = NDArray[np.float64]

METRES = 0.06
"""Length of the lighthouse's unit in the built-in photographs: it stands 148 mm high."""
TABLE = -1.24
"""Height of the table in the lighthouse's world."""

_SUN = np.array([0.45, -0.6, 0.66])
_DOTS, _CELL, _REACH = 10, 0.01, 4.0


@cache
def room(paper: str) -> tuple[Part, ...]:
    """Return the parts of the room, without the lighthouse."""
    return (*_shell(paper), *_clutter())


def _at(
    solid: Cuboid | Ball | Frustum, x: float, y: float, z: float, material: Material, turn: float = 0.0
) -> Part:
    c, s = np.cos(turn), np.sin(turn)
    return Part(solid, np.array([x, y, z]), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), material)


def _shell(paper: str) -> list[Part]:
    walls = checker((0.72, 0.74, 0.70), (0.60, 0.66, 0.68), 1.9)
    floor = strata((0.42, 0.30, 0.20), (0.56, 0.42, 0.29), thickness=3.0)

    def inside(points: Array) -> Array:
        below = points[:, 2] < -21.99
        turned = points[:, [2, 1, 0]]
        return np.where(below[:, None], floor(turned), walls(points))

    top = Cuboid((13.0, 9.0, 0.25))
    leg = Material(plain((0.30, 0.24, 0.20)))
    legs = [_at(Cuboid((0.5, 0.5, 6.0)), x, y, TABLE - 6.5, leg) for x in (-12, 12) for y in (-8, 8)]
    return [
        _at(Cuboid((42.0, 36.0, 22.0)), 0, 0, TABLE - 12.5 + 22.0, Material(inside)),
        _at(top, 0, 0, TABLE - top.half[2], Material(_table_top(paper, top.half[2]))),
        *legs,
    ]


def _clutter() -> list[Part]:
    """Things on the table, low ones near the sheet and tall ones far from it, and furniture."""
    red, blue, green = (0.75, 0.16, 0.15), (0.16, 0.28, 0.62), (0.20, 0.48, 0.30)
    paper, dark, wood = (0.92, 0.90, 0.84), (0.13, 0.13, 0.16), (0.52, 0.36, 0.22)
    books = Material(strata(red, paper, thickness=0.12))
    shelf = Material(bricks(wood, dark, length=3.0, height=2.0))
    glossy = Material(plain((0.85, 0.86, 0.88)), gloss=0.5)
    on = TABLE
    return [
        _at(Cuboid((1.2, 0.8, 0.18)), -4.4, 0.6, on + 0.18, books, 0.4),
        _at(Cuboid((1.0, 0.7, 0.12)), 4.3, -1.2, on + 0.12, Material(checker(blue, paper, 0.4)), -0.3),
        _at(
            Frustum(0.07, 0.07, 2.4), 2.6, 3.6, on + 0.08, Material(spiral((0.9, 0.7, 0.1), dark, pitch=0.6))
        ),
        _at(Ball(0.32), -3.1, -3.2, on + 0.32, Material(speckle(green, (0.9, 0.9, 0.3), grain=0.12))),
        _at(Cuboid((0.5, 0.22, 0.10)), 0.6, -4.2, on + 0.10, glossy, 0.8),
        _at(Frustum(0.7, 0.8, 1.6), -9.0, 4.5, on, Material(spiral(blue, paper, pitch=0.9))),
        _at(Cuboid((1.6, 1.0, 1.2)), 9.5, 5.5, on + 1.2, Material(checker(green, paper, 0.7)), 0.5),
        _at(Frustum(0.9, 0.6, 2.6), 9.0, -5.5, on, Material(speckle(red, paper, grain=0.35))),
        _at(
            Cuboid((2.2, 0.3, 1.6)),
            -8.5,
            -5.5,
            on + 1.6,
            Material(bricks(red, paper, length=0.8, height=0.4)),
            0.9,
        ),
        _at(Cuboid((3.0, 9.0, 9.0)), -38.0, 8.0, 2.0, shelf),
        _at(Cuboid((10.0, 1.0, 7.0)), 12.0, 35.0, 4.0, Material(speckle(blue, (0.85, 0.75, 0.5), grain=1.3))),
        _at(Cuboid((8.0, 1.0, 6.0)), -8.0, -35.0, 6.0, Material(plain((1.0, 1.0, 1.0)))),
        _at(Cuboid((1.0, 7.0, 9.0)), 41.0, -6.0, 0.0, Material(strata(green, dark, thickness=2.5))),
    ]


def _table_top(paper: str, half: float) -> Callable[[Array], Array]:
    """Return the texture of the table: wood, the sheet as it is printed, and the lighthouse's shadow."""
    board = get_board(paper)
    printed = board_image(board, _DOTS)
    wood = speckle((0.50, 0.36, 0.24), (0.66, 0.50, 0.34), grain=0.22)
    light = _shadow()

    def texture(points: Array) -> Array:
        colour = wood(points * np.array([1.0, 0.12, 1.0]))
        millimetres = 1e3 * (points[:, :2] * METRES + board.middle)
        column, row = np.floor(_DOTS * millimetres).astype(int).T
        row = len(printed) - 1 - row
        on = (row >= 0) & (row < len(printed)) & (column >= 0) & (column < printed.shape[1])
        on &= points[:, 2] > half - 1e-6
        grey = printed[row[on], column[on]] / 255
        colour[on] = (0.05 + 0.88 * grey)[:, None] * np.array([1.0, 0.99, 0.97])
        place = np.floor((points[:, 1::-1] + _REACH) / _CELL).astype(int).clip(0, len(light) - 1)
        return np.asarray(colour * light[place[:, 0], place[:, 1], None])

    return texture


@cache
def _shadow() -> Array:
    """Return how much light falls on the table around the lighthouse, ``(N, N)``, rows along y."""
    lamp = np.eye(4)
    lamp[:3, 3] = 40 * _SUN
    across = np.arange(-_REACH + _CELL / 2, _REACH, _CELL)
    depth = lamp[2, 3] - TABLE
    hits = cast(
        lamp,
        np.array([1.0, 1.0, 0.0, 0.0]),
        (across - lamp[0, 3]) / depth,
        (lamp[1, 3] - across[::-1]) / depth,
    )
    shade = gaussian_filter((hits.parameter < depth).astype(float), 4)[::-1]
    near = np.exp(-(across**2 + across[:, None] ** 2) / 0.25)
    return np.asarray((1 - 0.42 * shade) * (1 - 0.35 * near))
