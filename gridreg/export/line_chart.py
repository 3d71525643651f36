"""Line charts by matplotlib, as SVG for a page.

Colours in the SVG are variables of the page's style sheet, so that charts follow the reader's light or dark
preference; text is text.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

HUES, DASHES = 6, ("solid", (0, (4, 2)), (0, (1, 1.5)))
"""Colours beside the baseline's grey, and dashes."""

# Pixels: the whole, room for ticks at the left, for names at the right, for ticks and label below, between two names.
_WIDTH, _LEFT, _RIGHT, _BELOW, _LABEL_GAP = 600.0, 38.0, 156.0, 40.0, 14.0
_LONGEST_LABEL = 20
# Colours that stand for variables of the style sheet until the SVG is made.
_VARIABLES = {f"#0001{index:02}": f"var(--s{index})" for index in range(HUES + 1)}
_SOFT, _RULE, _CARD = "#000200", "#000201", "#000202"
_VARIABLES |= {_SOFT: "var(--soft)", _RULE: "var(--rule)", _CARD: "var(--card)"}


@dataclass(frozen=True)
class Series:
    """One line.

    Args:
        name: beside its end.
        style: hue and dash, up to `HUES` (0: grey) and to the number of `DASHES`.
        points: (x, y) in the order they are joined; not joined with fewer than two.
        marks: (x, y) of dots.
    """

    name: str
    style: tuple[int, int]
    points: Sequence[tuple[float, float]]
    marks: Sequence[tuple[float, float]] = ()


def line_chart(
    title: str,
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    y_span: float = 12.0,
    x_ticks: Sequence[float] = (),
) -> Markup:
    """A chart of lines with their names at their ends.

    Args:
        title: read out where the chart is not seen.
        series: the lines; without any point there is no chart.
        x_label: below, with the unit.
        y_label: of the vertical axis, with the unit.
        y_span: the vertical axis shows at most so much below the highest point.
        x_ticks: numbers on a logarithmic axis; default: a linear one from 0.

    Returns:
        An ``<svg>`` element, or nothing.
    """
    drawn = [line for line in series if line.points or line.marks]
    if not drawn:
        return Markup("")
    values = [y for line in drawn for _, y in (*line.points, *line.marks)]
    top, bottom = max(values), max(min(values), max(values) - y_span)
    margin = 0.06 * max(top - bottom, 0.5)
    top, bottom = top + margin, bottom - margin
    height = max(220.0, _LABEL_GAP * len(drawn) + 20)
    whole = height + _BELOW + 8
    width = _WIDTH - _LEFT - _RIGHT
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "gridreg", "font.size": 12}):
        figure = Figure(figsize=(_WIDTH / 72, whole / 72), dpi=72, frameon=False)
        axes = figure.add_axes(
            (_LEFT / _WIDTH, _BELOW / whole, width / _WIDTH, height / whole), frameon=False
        )
        for number, line in enumerate(drawn):
            colour, dash = f"#0001{line.style[0]:02}", DASHES[line.style[1]]
            if len(line.points) > 1:
                axes.plot(
                    *zip(*line.points, strict=True), color=colour, ls=dash, lw=2, gid=f"series-{number}"
                )
            # One point makes no line: it is drawn as a smaller dot.
            for places, size in ((line.points if len(line.points) == 1 else (), 5), (line.marks, 8)):
                for x, y in (place for place in places if place[1] >= bottom):
                    dot = {"mfc": colour, "mec": _CARD, "mew": 1.5, "gid": f"series-{number}"}
                    axes.plot([x], [y], "o", ms=size, clip_on=False, **dot)  # type: ignore[arg-type]
        for number, place in _end_labels(drawn, bottom, top, height):
            name = drawn[number].name
            short = name if len(name) <= _LONGEST_LABEL else f"{name[: _LONGEST_LABEL - 1]}…"
            label = axes.text(
                1 + 10 / width, place / height, short, transform=axes.transAxes, va="center", parse_math=False
            )
            label.set(color=f"#0001{drawn[number].style[0]:02}", gid=f"series-{number}")
        axes.set_ylim(bottom, top)
        axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        if x_ticks:
            axes.set_xscale("log")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xticks(x_ticks, [f"{tick:g}" for tick in x_ticks])
        else:
            axes.set_xlim(left=0)
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axes.set_xlabel(x_label, color=_SOFT, fontsize=12)
        axes.tick_params(left=False, bottom=False, labelcolor=_SOFT)
        axes.grid(axis="y", color=_RULE, lw=1)
        axes.axhline(bottom, color=_SOFT, lw=1.6)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _slim(buffer.getvalue(), f"{title}: {y_label} over {x_label}", [line.name for line in drawn])


def _end_labels(
    series: Sequence[Series], bottom: float, top: float, height: float
) -> list[tuple[int, float]]:
    """Number and place (pixels from below) of each series' name, moved apart where lines end close together."""
    ends = [(*line.points, *line.marks)[-1][1] for line in series]
    places = [height * max(0.0, (end - bottom) / (top - bottom)) for end in ends]
    order = sorted(range(len(series)), key=places.__getitem__)
    moved: list[float] = []
    for number in order:
        moved.append(max(places[number], moved[-1] + _LABEL_GAP) if moved else places[number])
    limit = height
    for index in reversed(range(len(moved))):
        moved[index] = min(moved[index], limit)
        limit = moved[index] - _LABEL_GAP
    return list(zip(order, moved, strict=True))


def _slim(svg: str, label: str, names: Sequence[str]) -> Markup:
    """The SVG as an element of a page: no prologue, no unused names, colours by variables, two digits."""
    svg = re.sub(r"<metadata>.*?</metadata>|<defs>\s*<style.*?</defs>", "", svg, flags=re.S)
    used = set(re.findall(r"#([^)\"]+)[)\"]", svg))

    def short(tag: str) -> str:
        tag = re.sub(r' id="([^"]*)"', lambda m: m[0] if m[1] in used or m[1][:7] == "series-" else "", tag)
        tag = re.sub(r' transform="rotate\(-?0 [^"]*"|font-family:[^;"]*; ?', "", tag)
        tag = re.sub(r"#000[12]\d\d", lambda m: _VARIABLES[m[0]], tag)
        return re.sub(r"-?\d+\.\d+", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), tag)

    box = re.search(r'viewBox="[^"]*"', svg)
    body = re.sub(r"<[^>]+>", lambda m: short(m[0]), svg[svg.index(">", svg.index("<svg")) + 1 :])
    body = re.sub(r">\s+<", "><", re.sub(r"\s+", " ", body)).strip()
    for number, name in enumerate(names):
        text = escape(name)
        body = body.replace(f'<g id="series-{number}">', f'<g data-series="{text}"><title>{text}</title>')
    return Markup(f'<svg role="img" aria-label="{escape(label)}" {box[0] if box else ""}>{body}')
