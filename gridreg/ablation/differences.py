"""Paired differences as pictures: a forest plot over all pairs, and a heat map by scene."""

from __future__ import annotations

import html
from collections.abc import Callable

import numpy as np

from gridreg.ablation.comparison import Row, Section
from gridreg.ablation.plots import ticks
from gridreg.ablation.tables import SIGNS, mean_text, signed

__all__ = ["forest_plot", "heat_map", "tone"]

_SHARE_AT_FULL = 55


def forest_plot(section: Section) -> str:
    """Each composition's paired difference to the baseline: mean, 95 % interval, and every pair as a dot."""
    rows = [row for row in section.rows if row.difference is not None and row.difference.estimate is not None]
    values = [0.0]
    for row in rows:
        assert row.difference is not None
        assert row.difference.estimate is not None
        found = row.difference.estimate
        values += [*row.difference.pairs.values(), found.mean]
        values += [found.low, found.high] if found.half_width is not None else []
    if not rows:
        return ""
    # Two pairs have a very wide interval; it is cut off before it makes everything else a point.
    pairs = [v for row in rows if row.difference for v in row.difference.pairs.values()]
    reach = 2.5 * max(0.2, *(abs(v) for v in pairs))
    low, high = max(min(values), -reach), min(max(values), reach)
    room = 0.05 * max(high - low, 0.1)
    low, high = low - room, high + room

    def across(value: float) -> float:
        return float(np.clip(100 * (value - low) / (high - low), 0, 100))

    marks = ticks(low, high, 4)
    grid = "".join(
        f'<line class="grid" x1="{across(v):.2f}%" x2="{across(v):.2f}%" y1="0" y2="100%"/>' for v in marks
    )
    zero = f'<line class="zero" x1="{across(0):.2f}%" x2="{across(0):.2f}%" y1="0" y2="100%"/>'
    lines = [_forest_line(row, across, grid + zero) for row in rows]
    axis = "".join(
        f'<text class="tick" x="{across(v):.2f}%" y="14" text-anchor="middle">{_short(v)}</text>'
        for v in marks
    )
    return (
        '<div class="forest" role="list">'
        + "".join(lines)
        + f'<div class="f-row f-axis" aria-hidden="true"><span></span><svg height="20">{axis}</svg><span></span></div>'
        + f'<p class="x-label">PSNR difference to {_text(section.baseline)} (dB); right is better</p></div>'
    )


def _forest_line(row: Row, across: Callable[[float], float], background: str) -> str:
    assert row.difference is not None
    assert row.difference.estimate is not None
    found, parts = row.difference.estimate, [background]
    for value in row.difference.pairs.values():
        parts.append(f'<circle class="pair" cx="{across(value):.2f}%" cy="27" r="2.5"/>')
    if found.half_width is not None:
        parts.append(
            f'<line class="interval" x1="{across(found.low):.2f}%" x2="{across(found.high):.2f}%" y1="15" y2="15"/>'
        )
        # An arrow says that the interval goes on beyond the picture.
        for end, arrow in ((found.low, "M8-5 0 0 8 5"), (found.high, "M-8-5 0 0-8 5")):
            if (x := across(end)) in (0.0, 100.0):
                parts.append(f'<svg x="{x:.0f}%" y="15" class="only"><path class="arrow" d="{arrow}"/></svg>')
        parts.append(f'<circle class="mean" cx="{across(found.mean):.2f}%" cy="15" r="5"/>')
        text = f"{signed(found.mean)} [{signed(found.low)}, {signed(found.high)}]"
    else:
        parts.append(
            f'<svg x="{across(found.mean):.2f}%" y="15" class="only"><path class="mean" d="M0-6 6 0 0 6-6 0Z"/></svg>'
        )
        text = f"{signed(found.mean)}, one pair: no interval"
    sign = SIGNS.get(row.outcome, "") if found.half_width is not None else ""
    count = f"n = {found.count}" if found.count > 1 else ""
    return (
        f'<div class="f-row {tone(row.outcome)}" role="listitem"><span class="f-name">{_text(row.name)}</span>'
        f'<svg height="38" aria-hidden="true">{"".join(parts)}</svg>'
        f'<span class="f-text">{text} <span class="sign">{sign}</span>'
        f'<span class="count">{count}</span></span></div>'
    )


def heat_map(section: Section) -> str:
    """PSNR differences to the baseline by scene, as a table of colours and numbers; the baseline's row is PSNR itself.

    With one scene there is no heat map: it would repeat the table.
    """
    rows = [row for row in section.rows if row.is_baseline or row.scene_differences]
    if len(section.scenes) < 2 or len(rows) < 2:
        return ""
    found = [d.estimate.mean for row in rows for d in row.scene_differences.values() if d.estimate]
    largest = max([0.1, *(abs(value) for value in found)])
    head = "".join(f'<th scope="col">{_text(scene)}</th>' for scene in section.scenes)
    body = []
    for row in rows:
        cells = "".join(_heat_cell(row, scene, largest) for scene in section.scenes)
        body.append(f'<tr><th scope="row">{_text(row.name)}</th>{cells}</tr>')
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Differences by scene"><table class="heat">'
        f'<thead><tr><th scope="col">Δ PSNR (dB)</th>{head}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'
    )


def _heat_cell(row: Row, scene: str, largest: float) -> str:
    if row.is_baseline:
        return f'<td class="base">{mean_text(row.scenes.get(scene))}</td>'
    difference = row.scene_differences.get(scene)
    if difference is None or difference.estimate is None:
        return '<td class="none">–</td>'
    value = difference.estimate.mean
    share = round(_SHARE_AT_FULL * min(1.0, abs(value) / largest))
    sign = SIGNS.get(difference.verdict, "")
    return f'<td class="{"up" if value > 0 else "down"}" style="--share:{share}%">{signed(value)} {sign}</td>'


def tone(outcome: str) -> str:
    """CSS class of an outcome: ``up``, ``down``, or ``noise`` for all that is no finding."""
    return {"higher": "up", "lower": "down"}.get(outcome, "noise")


def _short(value: float) -> str:
    return signed(value).rstrip("0").rstrip(".") if value else "0"


def _text(text: str) -> str:
    return html.escape(text, quote=True)
