"""Paired differences for the page of a report: a forest plot over all pairs, and a heat map by scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator

from gridreg.ablation.comparison import Row, Section


@dataclass(frozen=True)
class Forest:
    """A forest plot: each composition's paired difference to the baseline, its 95 % interval, and every pair.

    Args:
        rows: the compositions that have a difference.
        across: the place of a difference (dB) on the axis, percent of its length; what lies beyond is at its end.
        ticks: differences to mark, dB.
    """

    rows: tuple[Row, ...]
    across: Callable[[float], float]
    ticks: tuple[float, ...]


def forest_plot(section: Section) -> Forest | None:
    """The forest plot of a section; None where nothing can be compared."""
    rows = [row for row in section.rows if row.difference is not None and row.difference.estimate is not None]
    found = [row.difference.estimate for row in rows if row.difference and row.difference.estimate]
    pairs = [value for row in rows if row.difference for value in row.difference.pairs.values()]
    if not rows:
        return None
    # Two pairs have a very wide interval; it is cut off before it makes everything else a point.
    reach = 2.5 * max(0.2, *(abs(value) for value in pairs))
    ends = [end for e in found if e.half_width is not None for end in (e.low, e.high)]
    values = np.clip([0.0, *pairs, *ends], -reach, reach)
    margin = 0.05 * max(float(np.ptp(values)), 0.1)
    low, high = float(values.min()) - margin, float(values.max()) + margin

    def across(value: float) -> float:
        return round(float(np.clip(100 * (value - low) / (high - low), 0, 100)), 2)

    marks = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low, high)
    return Forest(tuple(rows), across, tuple(float(mark) for mark in marks if low <= mark <= high))


def heat_map(section: Section) -> tuple[list[Row], float]:
    """Rows of a map of PSNR differences by scene, and the largest difference in it, dB.

    With one scene there are no rows: the map would repeat the table.
    """
    rows = [row for row in section.rows if row.is_baseline or row.scene_differences]
    found = [d.estimate.mean for row in rows for d in row.scene_differences.values() if d.estimate]
    shown = len(section.scenes) > 1 and len(rows) > 1
    return rows if shown else [], max([0.1, *(abs(value) for value in found)])
