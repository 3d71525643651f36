"""Small charts as SVG text: lines and areas over axes, and ridges of masks over time.

Their words and axes stand in docs/diagrams.yaml.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from skimage.measure import approximate_polygon

WIDTH = 340
_DOCS = Path(__file__).parents[1]
LAYOUTS: dict[str, dict[str, Any]] = yaml.safe_load((_DOCS / "diagrams.yaml").read_text(encoding="utf-8"))


class Line(NamedTuple):
    """A curve, or with ``low`` the area between the two.

    Args:
        x, y: of its points.
        series: its colour, from 1 to 5.
        dashed: how it is drawn.
        low: where the area begins.
    """

    x: ArrayLike
    y: ArrayLike
    series: int = 1
    dashed: bool = False
    low: ArrayLike | None = None


class Note(NamedTuple):
    """Text at a point; in the ink's colour unless it has that of a series; ``anchor``: which end of it is there."""

    x: float
    y: float
    text: str
    series: int | None = None
    anchor: str = "start"


class Ridges(NamedTuple):
    """Masks over time: one strip for each channel, filled as high as the channel is open.

    Args:
        values: ``(channels, steps)`` in [0, 1].
        steps: ``(steps,)`` places on the horizontal axis.
        series: colour of each channel.
        labels: text of each channel; by default the first and the last number.
    """

    values: NDArray[np.float64]
    steps: NDArray[np.float64]
    series: Sequence[int] | None = None
    labels: Sequence[str] | None = None


def drawn(name: str, content: Ridges | Iterable[Line | Note]) -> str:
    """The diagram of a name as SVG text, with the words that it has in ``diagrams.yaml``."""
    layout = LAYOUTS[name]
    if isinstance(content, Ridges):
        return _ridges(layout, content)
    panel = Panel(layout)
    for part in [*content, *(Note(*note) for note in layout.get("notes", ()))]:
        if isinstance(part, Note):
            panel.note(*part)
        elif part.low is not None:
            panel.area(part.x, part.low, part.y, part.series)
        else:
            panel.line(part.x, part.y, part.series, part.dashed)
    return document(panel.parts, panel.height)


def standalone_style() -> str:
    """The stylesheet for a file by itself, which follows the viewer's preference for light or dark."""
    text = (_DOCS / "diagrams.css").read_text(encoding="utf-8")
    rules = re.sub(r"/\*.*?\*/\s*", "", text, flags=re.S)
    slate = re.compile(r'\[data-md-color-scheme="slate"\] (\.gr \{.*?\})')
    return slate.sub(r"@media (prefers-color-scheme: dark) { \1 }", rules).strip()


def number(value: float) -> str:
    """A coordinate in pixels, to a tenth."""
    return f"{round(value, 1) + 0.0:g}"


def simplified(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fewest points of a polyline ``(N, 2)`` that stay within 0.06 pixels of it (Douglas-Peucker)."""
    # Two points may be equally far away. Rounded, they are so on every processor, and the first of them is kept.
    return np.asarray(approximate_polygon(points.round(3), 0.06))


class Panel:
    """One chart: its parts as SVG text.

    Args:
        layout: its words and axes, see ``diagrams.yaml``.
        left: room for the labels of the vertical axis, pixels.
    """

    def __init__(self, layout: dict[str, Any], left: int = 44) -> None:
        ticks = {
            axis: [(t[0], t[1]) if isinstance(t, list) else (t, f"{t:g}") for t in layout[axis]]
            for axis in "xy"
        }
        self.x_range, self.y_range = (
            layout.get(f"{axis}_range") or (own[0][0], own[-1][0]) for axis, own in ticks.items()
        )
        self.log_y, self.height = layout.get("log_y", False), layout.get("height", 210)
        self.left, self.right, self.top, self.bottom = left, WIDTH - 10, 26, self.height - 36
        self.parts = [_text(8, 15, layout["title"], "title")]
        for value, text in ticks["y"]:
            row = self.at([self.x_range[0]], [value])[0, 1]
            self.parts.append(f'<path class="hair" d="M{self.left} {number(row)}H{self.right}"/>')
            self.parts.append(_text(self.left - 5, row + 4, text, anchor="end"))
        for value, text in ticks["x"]:
            column = self.at([value], [self.y_range[0]])[0, 0]
            self.parts.append(f'<path class="axis" d="M{number(column)} {self.bottom}v4"/>')
            self.parts.append(_text(column, self.bottom + 15, text, anchor="middle"))
        self.parts.append(f'<path class="axis" d="M{self.left} {self.top}V{self.bottom}H{self.right}"/>')
        across, up = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        if layout.get("x_label"):
            self.parts.append(_text(across, self.height - 6, layout["x_label"], anchor="middle"))
        if layout.get("y_label"):
            turned = f"rotate(-90 11 {number(up)})"
            self.parts.append(_text(11, up, layout["y_label"], anchor="middle", transform=turned))

    def at(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Pixels ``(N, 2)`` of points."""
        low, high = self.y_range
        values = np.asarray(y, dtype=np.float64)
        if self.log_y:
            values, low, high = np.log(values), np.log(low), np.log(high)
        across = (np.asarray(x, dtype=np.float64) - self.x_range[0]) / (self.x_range[1] - self.x_range[0])
        up = (values - low) / (high - low)
        columns = self.left + across * (self.right - self.left)
        rows = self.bottom - up * (self.bottom - self.top)
        return np.stack(np.broadcast_arrays(columns, rows), axis=-1).reshape(-1, 2)

    def line(self, x: ArrayLike, y: ArrayLike, series: int, dashed: bool) -> None:
        """A curve."""
        name = f"line c{series}" + (" dashed" if dashed else "")
        self.parts.append(f'<path class="{name}" d="{_path(simplified(self.at(x, y)))}"/>')

    def area(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, series: int, look: str = "soft") -> None:
        """Fill what lies between two curves."""
        upper, lower = (simplified(self.at(x, y)) for y in (high, low))
        outline = _path(np.concatenate([upper, lower[::-1]]))
        self.parts.append(f'<path class="{look} f{series}" d="{outline}Z"/>')

    def note(self, x: float, y: float, text: str, series: int | None = None, anchor: str = "start") -> None:
        """Text at a point."""
        (column, row) = self.at([x], [y])[0]
        style = "" if series is None else f"fill: var(--s{series})"
        self.parts.append(_text(column, row, text, anchor=anchor, style=style))


def _ridges(layout: dict[str, Any], masks: Ridges) -> str:
    values, steps, count = masks.values, masks.steps, len(masks.values)
    names = masks.labels or [str(i) if i in (0, count - 1) else "" for i in range(count)]
    axes = {"x": np.linspace(steps[0], steps[-1], 6).round(6).tolist(), "y": [], "y_range": (count, 0)}
    words = {"x_label": "fraction of the run", "y_label": "channel", **layout}
    height = round(count * layout.get("row", 10)) + 62
    panel = Panel(
        {**words, **axes, "x_range": (steps[0], steps[-1]), "height": height},
        12 + 7 * max(4, *map(len, names)),
    )
    for i, (channel, name) in enumerate(zip(values, names, strict=True)):
        low, high = np.full(len(steps), i + 1.0), i + 1 - 0.86 * channel
        panel.area(steps, low, high, masks.series[i] if masks.series else 1, "area")
        if name:
            panel.note(steps[0], i + 0.85, f"{name} ", anchor="end")
    return document(panel.parts, panel.height)


def document(parts: Sequence[str], height: int) -> str:
    """An SVG file."""
    box = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" class="gr" {box}><style>{standalone_style()}</style>\n'
    return head + "\n".join(parts) + "\n</svg>\n"


def _text(x: float, y: float, text: str, name: str = "", **given: str) -> str:
    names = {"class": name, "text-anchor": given.pop("anchor", ""), **given}
    extras = "".join(f' {key}="{value}"' for key, value in names.items() if value)
    return f'<text x="{number(x)}" y="{number(y)}"{extras}>{html.escape(text)}</text>'


def _path(points: NDArray[np.float64]) -> str:
    return "M" + "L".join(f"{number(x)} {number(y)}" for x, y in points)
