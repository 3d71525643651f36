"""Small charts as SVG text: axes, lines, areas, and ridges of masks over time."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Range = tuple[float, float]

WIDTH = 340
_STYLESHEET = Path(__file__).parent.parent / "diagrams.css"


def standalone_style() -> str:
    """The stylesheet for a file by itself, which follows the viewer's preference for light or dark."""
    rules = re.sub(r"/\*.*?\*/\s*", "", _STYLESHEET.read_text(encoding="utf-8"), flags=re.S)
    slate = re.compile(r'\[data-md-color-scheme="slate"\] (\.gr \{.*?\})')
    return slate.sub(r"@media (prefers-color-scheme: dark) { \1 }", rules).strip()


def number(value: float) -> str:
    """A coordinate in pixels, to a tenth."""
    return f"{round(value, 1) + 0.0:g}"


def label(value: float) -> str:
    """A tick's number."""
    return f"{value:g}"


def simplified(points: NDArray[np.float64], tolerance: float = 0.06) -> NDArray[np.float64]:
    """Fewest points of a polyline ``(N, 2)`` that stay within a tolerance of it, pixels (Douglas-Peucker)."""
    # Two points may be equally far away. Rounded, they are so on every processor, and the first of them is kept.
    points = points.round(3)
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    spans = [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        (start, chord), inner = (points[first], points[last] - points[first]), points[first + 1 : last]
        # Distance to the segment, not to its line: curves may turn back.
        along = ((inner - start) @ chord / max(float(chord @ chord), 1e-12)).clip(0, 1)
        away = np.linalg.norm(inner - start - along[:, None] * chord, axis=1)
        if away.max() > tolerance:
            middle = first + 1 + int(away.argmax())
            keep[middle] = True
            spans += [(first, middle), (middle, last)]
    return points[keep]


class Panel:
    """One chart.

    Args:
        title: above it.
        x, y: ranges of the axes.
        x_label, y_label: what the axes show, with the unit.
        x_ticks, y_ticks: numbers, or (number, text).
        height: of the diagram, pixels.
        log_y: whether the vertical axis is logarithmic.
        left: room for the labels of the vertical axis, pixels.
    """

    def __init__(
        self,
        title: str,
        *,
        x: Range,
        y: Range,
        x_label: str = "",
        y_label: str = "",
        x_ticks: Sequence[float | tuple[float, str]] = (),
        y_ticks: Sequence[float | tuple[float, str]] = (),
        height: int = 210,
        log_y: bool = False,
        left: int = 44,
    ) -> None:
        self.x_range, self.y_range, self.log_y, self.height = x, y, log_y, height
        self.left, self.right, self.top, self.bottom = left, WIDTH - 10, 26, height - 36
        self._parts = [self._text(8, 15, title, "title")]
        self._axes(x_ticks, y_ticks, x_label, y_label)

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

    def line(self, x: ArrayLike, y: ArrayLike, series: int = 1, dashed: bool = False) -> None:
        """A curve."""
        name = f"line c{series}" + (" dashed" if dashed else "")
        self._parts.append(f'<path class="{name}" d="{_path(self.at(x, y))}"/>')

    def area(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, series: int = 1, soft: bool = True) -> None:
        """Fill what lies between two curves."""
        upper, lower = (simplified(self.at(x, y)) for y in (high, low))
        outline = _path(np.concatenate([upper, lower[::-1]]), close=True, simplify=False)
        self._parts.append(f'<path class="{"soft" if soft else "area"} f{series}" d="{outline}"/>')

    def note(self, x: float, y: float, text: str, series: int | None = None, anchor: str = "start") -> None:
        """Text at a point."""
        (column, row) = self.at([x], [y])[0]
        style = "" if series is None else f"fill: var(--s{series})"
        self._parts.append(self._text(column, row, text, anchor=anchor, style=style))

    def svg(self) -> str:
        """The diagram."""
        return document(self._parts, self.height)

    def _axes(
        self,
        x_ticks: Sequence[float | tuple[float, str]],
        y_ticks: Sequence[float | tuple[float, str]],
        x_label: str,
        y_label: str,
    ) -> None:
        for tick in y_ticks:
            value, text = tick if isinstance(tick, tuple) else (tick, label(tick))
            row = self.at([self.x_range[0]], [value])[0, 1]
            self._parts.append(f'<path class="hair" d="M{self.left} {number(row)}H{self.right}"/>')
            self._parts.append(self._text(self.left - 5, row + 4, text, anchor="end"))
        for tick in x_ticks:
            value, text = tick if isinstance(tick, tuple) else (tick, label(tick))
            column = self.at([value], [self.y_range[0]])[0, 0]
            self._parts.append(f'<path class="axis" d="M{number(column)} {self.bottom}v4"/>')
            self._parts.append(self._text(column, self.bottom + 15, text, anchor="middle"))
        self._parts.append(f'<path class="axis" d="M{self.left} {self.top}V{self.bottom}H{self.right}"/>')
        if x_label:
            middle = (self.left + self.right) / 2
            self._parts.append(self._text(middle, self.height - 6, x_label, anchor="middle"))
        if y_label:
            middle = (self.top + self.bottom) / 2
            turned = f"rotate(-90 11 {number(middle)})"
            self._parts.append(self._text(11, middle, y_label, anchor="middle", transform=turned))

    @staticmethod
    def _text(
        x: float,
        y: float,
        text: str,
        name: str = "",
        *,
        anchor: str = "",
        style: str = "",
        transform: str = "",
    ) -> str:
        given = {"class": name, "text-anchor": anchor, "style": style, "transform": transform}
        extras = "".join(f' {key}="{value}"' for key, value in given.items() if value)
        return f'<text x="{number(x)}" y="{number(y)}"{extras}>{html.escape(text)}</text>'


def ridges(
    title: str,
    values: NDArray[np.float64],
    steps: NDArray[np.float64],
    *,
    x_label: str = "fraction of the run",
    y_label: str = "channel",
    series: Sequence[int] | None = None,
    labels: Sequence[str] | None = None,
    row: float = 10,
) -> str:
    """Masks over time: one strip for each channel, filled as high as the channel is open.

    Args:
        title: above it.
        values: ``(channels, steps)`` in [0, 1].
        steps: ``(steps,)`` places on the horizontal axis.
        x_label, y_label: what the axes show.
        series: colour of each channel.
        labels: text of each channel; by default the first and the last number.
        row: height of a strip, pixels.
    """
    count = len(values)
    names = labels or [str(i) if i in (0, count - 1) else "" for i in range(count)]
    panel = Panel(
        title,
        x=(float(steps[0]), float(steps[-1])),
        y=(count, 0),
        x_label=x_label,
        y_label=y_label,
        x_ticks=np.linspace(steps[0], steps[-1], 6).round(6).tolist(),
        height=round(count * row) + 62,
        left=12 + 7 * max(4, *map(len, names)),
    )
    for i, (channel, name) in enumerate(zip(values, names, strict=True)):
        panel.area(
            steps, np.full(len(steps), i + 1.0), i + 1 - 0.86 * channel, series[i] if series else 1, False
        )
        if name:
            panel.note(steps[0], i + 0.85, f"{name} ", anchor="end")
    return panel.svg()


def document(parts: Sequence[str], height: int) -> str:
    """An SVG file."""
    box = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    style = f"<style>{standalone_style()}</style>"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="gr" {box}>{style}\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _path(points: NDArray[np.float64], close: bool = False, simplify: bool = True) -> str:
    kept = simplified(points) if simplify else points
    return "M" + "L".join(f"{number(x)} {number(y)}" for x, y in kept) + ("Z" if close else "")
