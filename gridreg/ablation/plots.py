"""Line charts as HTML and SVG that stretch with the page while strokes and text keep their size."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["Series", "line_chart", "series_class", "ticks"]

HUES = 6
_DASHES = 3
_LABEL_GAP = 14.0
_LONGEST_LABEL = 21


@dataclass(frozen=True)
class Series:
    """One line.

    Args:
        name: beside its end.
        style: class of `series_class`.
        points: (x, y) in the order they are joined; not joined with fewer than two.
        marks: (x, y) of dots.
    """

    name: str
    style: str
    points: Sequence[tuple[float, float]]
    marks: Sequence[tuple[float, float]] = ()


def series_class(index: int, *, is_baseline: bool = False) -> str:
    """CSS class of a series: a colour that colour-blind readers can tell, and a dash when the colours are used up.

    Args:
        index: number of the series, the baseline not counted.
        is_baseline: which is grey.

    >>> series_class(0), series_class(7), series_class(0, is_baseline=True)
    ('s1', 's2 d1', 's0')
    """
    if is_baseline:
        return "s0"
    dash = index // HUES % _DASHES
    return f"s{index % HUES + 1}" + (f" d{dash}" if dash else "")


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers in a range, about ``count`` of them: multiples of 1, 2 or 5 times a power of ten.

    >>> ticks(19.3, 26.1)
    [20.0, 22.0, 24.0, 26.0]
    """
    raw = max(high - low, 1e-9) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12) + 0.0 for number in range(first, last + 1)]


def line_chart(
    title: str,
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    y_span: float = 12.0,
    x_ticks: Sequence[float] = (),
    log_x: bool = False,
) -> str:
    """A chart of lines with their names at their ends.

    Args:
        title: above it.
        series: the lines; without any point there is no chart.
        x_label: below, with the unit.
        y_label: above the axis, with the unit.
        y_span: the vertical axis shows at most so much below the highest point.
        x_ticks: numbers; default: round ones.
        log_x: whether the horizontal axis is logarithmic.

    Returns:
        A ``<figure>``, or ``""``.
    """
    places = [place for line in series for place in (*line.points, *line.marks)]
    if not places:
        return ""

    def along(x: float) -> float:
        return math.log(x) if log_x else x

    xs = [along(x) for x, _ in places]
    left, right = (min(xs), max(xs)) if log_x else (0.0, max(xs))
    top = max(y for _, y in places)
    bottom = max(min(y for _, y in places), top - y_span)
    room = 0.06 * max(top - bottom, 0.5)
    bottom, top = bottom - room, top + room
    height = max(220.0, _LABEL_GAP * len(series) + 20)

    def across(x: float) -> float:
        return 100 * (along(x) - left) / max(right - left, 1e-9)

    def down(y: float) -> float:
        return height * (top - y) / (top - bottom)

    parts = []
    for value in ticks(bottom, top):
        y = down(value)
        parts.append(f'<line class="grid" x1="0" x2="100%" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="-7" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in x_ticks or ticks(left, right, 4):
        parts.append(
            f'<text class="tick" x="{across(value):.2f}%" y="{height + 17:.0f}" text-anchor="middle">{value:g}</text>'
        )
    parts.append(f'<line class="axis" x1="0" x2="100%" y1="{height:.0f}" y2="{height:.0f}"/>')
    lines = []
    for line in series:
        if len(line.points) > 1:
            path = " ".join(f"{10 * across(x):.1f},{down(y):.1f}" for x, y in line.points)
            lines.append(f'<polyline class="{line.style}" data-series="{_text(line.name)}" points="{path}"/>')
    # Stretched sideways only: lines keep their width, text stays outside.
    parts.append(
        f'<svg class="lines" viewBox="0 0 1000 {height:.0f}" width="100%" height="{height:.0f}" '
        f'preserveAspectRatio="none">{"".join(lines)}</svg>'
    )
    for line in series:
        # One point makes no line: it is drawn as a smaller dot.
        alone = [(place, "2.5") for place in line.points] if len(line.points) == 1 else []
        for (x, y), radius in [*alone, *((place, "4") for place in line.marks)]:
            if y >= bottom:
                parts.append(
                    f'<circle class="{line.style}" data-series="{_text(line.name)}" cx="{across(x):.2f}%" '
                    f'cy="{down(y):.1f}" r="{radius}"/>'
                )
    parts += _end_labels(series, down, height)
    return (
        f'<figure class="plot"><figcaption><b>{_text(title)}</b> <span>{_text(y_label)}</span></figcaption>'
        f'<svg class="frame" role="img" aria-label="{_text(f"{title}: {y_label} over {x_label}")}" '
        f'height="{height + 22:.0f}">{"".join(parts)}</svg><p class="x-label">{_text(x_label)}</p></figure>'
    )


def _end_labels(series: Sequence[Series], down: Callable[[float], float], height: float) -> list[str]:
    """Names at the right, moved apart where lines end close together."""
    drawn = [line for line in series if line.points or line.marks]
    ends = [(min(down((*line.points, *line.marks)[-1][1]), height), line) for line in drawn]
    ends.sort(key=lambda end: end[0])
    places = _apart([y for y, _ in ends], _LABEL_GAP, height)
    parts = []
    for y, (_, line) in zip(places, ends, strict=True):
        short = line.name if len(line.name) <= _LONGEST_LABEL else f"{line.name[: _LONGEST_LABEL - 1]}…"
        parts.append(
            f'<text class="end {line.style}" data-series="{_text(line.name)}" x="100%" dx="10" y="{y + 4:.1f}">'
            f"{_text(short)}<title>{_text(line.name)}</title></text>"
        )
    return parts


def _apart(places: Sequence[float], gap: float, height: float) -> list[float]:
    """Sorted places moved down, then up from the lower end, until they are at least a gap apart."""
    moved: list[float] = []
    for place in places:
        moved.append(max(place, moved[-1] + gap) if moved else place)
    limit = height
    for index in range(len(moved) - 1, -1, -1):
        moved[index] = min(moved[index], limit)
        limit = moved[index] - gap
    return moved


def _text(text: str) -> str:
    return html.escape(text, quote=True)
