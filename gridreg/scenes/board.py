"""The sheet: a page of fiducial markers around a free middle, on which an object is photographed.

Lengths are metres; the origin is the middle of the free area, x to the right on the page, y up the page, z out
of it. What is printed and what the built-in photographs show is one drawing.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError, near_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BOARDS", "Board", "board_image", "draw_board", "get_board"]

Array = NDArray[np.float64]

# The bits of the first markers of OpenCV's DICT_4X4_100, row by row, white is 1: four digits each.
_BITS = bytes.fromhex(
    "b5320f9a332d9946549e79cd9e2ec4f2fedacf56f99111a70eb72a0f24b1263e466566006c5e76af868bb02bccd5dd82"
    "fe479471ace4a5542123346f441557b29ecff0cb08ae0929187504ff0df61c5a17182a28328c38b224e82eeb2d3f4b64"
    "502e5013519455685d415f9768016867612461e96b126fe567df7e1b80a083448ba2937a846c852a859c9c899fa1bb7c"
)
_MODULES = 6
_EDGE, _FOOT = 0.009, 0.030
"""Margins that printers leave white, and the strip below for ruler and text, metres."""
_ABOUT = (
    "1. Print at 100 % (not \u201cfit to page\u201d) and measure: the line below must be 100 mm long.",
    "2. Lay the sheet flat, stand the object in the free middle, and move neither any more.",
    "3. Take 8 or more sharp photographs from all around, low and high, each with the object whole and many markers.",
)


@dataclass(frozen=True)
class Board:
    """A sheet of one paper.

    Attributes:
        paper: its name.
        width, height: of the page.
        first: number of its first marker; papers share none, so photographs tell which was used.
        across, along: markers of a row and of a column of the ring.
        side: edge of a marker.
    """

    paper: str
    width: float
    height: float
    first: int
    across: int = 6
    along: int = 8
    side: float = 0.024

    @property
    def middle(self) -> tuple[float, float]:
        """The origin on the page, from its lower left corner."""
        return self.width / 2, (self.height - _EDGE + _FOOT) / 2

    @property
    def ring(self) -> tuple[float, float]:
        """Width and height of the ring of markers, from outer edge to outer edge."""
        return self.width - 2 * _EDGE, self.height - _EDGE - _FOOT

    @property
    def free(self) -> tuple[float, float]:
        """Width and height of the free middle."""
        return self.ring[0] - 2 * self.side, self.ring[1] - 2 * self.side

    @cached_property
    def corners(self) -> dict[int, Array]:
        """``(4, 2)`` corners of every marker by number: upper left, and on clockwise, as OpenCV has them."""
        x, y = (
            np.linspace(-0.5, 0.5, n) * (size - self.side)
            for n, size in zip((self.across, self.along), self.ring, strict=True)
        )
        places = [(a, y[-1]) for a in x] + [(x[-1], b) for b in y[-2:0:-1]]
        places += [(-a, -b) for a, b in places]
        square = 0.5 * self.side * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
        return {self.first + k: np.array(place) + square for k, place in enumerate(places)}


BOARDS = {
    board.paper: board
    for board in (
        Board("a4", 0.210, 0.297, 0),
        Board("letter", 0.2159, 0.2794, 24),
        Board("a3", 0.297, 0.420, 48, side=0.034),
    )
}
"""The sheets by the name of their paper."""


def get_board(paper: str) -> Board:
    """Return the sheet of a paper.

    Raises:
        InputError: for a paper that there is no sheet for.
    """
    if paper.lower() not in BOARDS:
        raise InputError(f"paper: found {paper!r}, expected {', '.join(BOARDS)}{near_names(paper, BOARDS)}")
    return BOARDS[paper.lower()]


def marker_bits(number: int) -> NDArray[np.bool_]:
    """Return the ``(4, 4)`` inner modules of a marker, true is white."""
    pair = np.frombuffer(_BITS[2 * number : 2 * number + 2], dtype=np.uint8)
    return np.unpackbits(pair).reshape(4, 4).astype(bool)


def draw_board(path: str | Path, paper: str = "a4") -> Board:
    """Write the sheet as a PDF of the paper's size, in vectors.

    Raises:
        InputError: for an unknown paper, or a file that cannot be written.
    """
    board = get_board(paper)
    try:
        # Without a date, so that the same sheet is the same file.
        _figure(board).savefig(path, format="pdf", metadata={"CreationDate": None})
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return board


def board_image(board: Board, dots: int = 8) -> NDArray[np.uint8]:
    """Return the sheet as it is printed, ``(H, W)`` grey, upper row first.

    Args:
        board: the sheet.
        dots: pixels a millimetre.
    """
    with io.BytesIO() as file:
        _figure(board).savefig(file, format="png", dpi=25.4 * dots)
        return np.asarray(Image.open(file).convert("L"))


def _figure(board: Board) -> Figure:
    """Return the drawing, one unit of its axes a millimetre of the page."""
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(board.width / 0.0254, board.height / 0.0254))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 1e3 * board.width), ylim=(0, 1e3 * board.height))
    axes.axis("off")
    black = []
    module = 1e3 * board.side / _MODULES
    for number, corners in board.corners.items():
        left, top = 1e3 * (corners[0] + board.middle)
        ink = np.pad(~marker_bits(number), 1, constant_values=True)
        # Runs of rows and of columns overlap: no hairline of white between neighbours.
        for k in range(_MODULES):
            for a, b in _runs(ink[k]):
                black.append(Rectangle((left + a * module, top - (k + 1) * module), (b - a) * module, module))
            for a, b in _runs(ink[:, k]):
                black.append(Rectangle((left + k * module, top - b * module), module, (b - a) * module))
    foot, x = 1e3 * _FOOT, 1e3 * _EDGE
    ruler = foot - 21
    black += [Rectangle((x + 10 * k, ruler), 0.2, 1.5 if k % 5 else 3) for k in range(11)]
    black.append(Rectangle((x, ruler), 100.2, 0.2))
    axes.add_collection(PatchCollection(black, facecolor="black", linewidth=0, snap=False))
    font: dict[str, Any] = {"family": "DejaVu Sans", "size": 7.5, "va": "bottom"}
    for k, line in enumerate(_ABOUT):
        axes.text(x, foot - 8 - 3.5 * k, line, **font)
    note = f"0 to 100 mm \u00b7 {board.paper.upper()} \u00b7 then: gridreg reconstruct PHOTOS OUT"
    axes.text(x + 103, ruler - 0.4, note, **font)
    return figure


def _runs(values: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return where runs of true values begin and end."""
    edges = np.flatnonzero(np.diff(np.pad(values, 1).astype(int))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
