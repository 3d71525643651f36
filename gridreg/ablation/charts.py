"""PSNR over time, and over the number of training views: the line charts of a report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from markupsafe import Markup

from gridreg.ablation.comparison import Row, Section, figure_of
from gridreg.ablation.records import RunResult
from gridreg.export.line_chart import DASHES, HUES, Series, line_chart

Histories = Callable[[RunResult], Sequence[Mapping[str, object]]]
"""Gives the rows of a run's history."""

_LOOKS = ("validation_psnr", "test_psnr")


def styles(rows: Sequence[Row]) -> dict[str, tuple[int, int]]:
    """Hue (0: the baseline's grey) and dash of each row's line, by the row's name.

    Six hues that colour-blind readers can tell; where they are used up, dashes.
    """
    found, index = {}, 0
    for row in rows:
        found[row.name] = (0, 0) if row.is_baseline else (index % HUES + 1, index // HUES % len(DASHES))
        index += not row.is_baseline
    return found


def curves(section: Section, histories: Histories) -> dict[str, object] | None:
    """PSNR over time, one chart for each scene, the mean over seeds; None where no run has a history.

    Held-out PSNR over seconds of training, where runs looked at it on the way; else that of the training batches over
    iterations.

    Returns:
        ``held_out``, ``y_label`` and ``charts``: pairs of a scene and its chart.
    """
    style = styles(section.rows)
    every = [line for row in section.rows for run in row.finished for line in histories(run)]
    held_out = any(name in line for line in every for name in _LOOKS)
    x_label = "training (s)" if held_out else "iteration"
    y_label = "held-out PSNR (dB)" if held_out else "PSNR of training batches (dB)"
    charts = []
    for scene in section.scenes:
        series = []
        for row in section.rows:
            runs = [run for run in row.finished if run.spec.scene_name == scene]
            points = _mean_curve([histories(run) for run in runs], held_out)
            final = [(figure_of(run, "seconds"), figure_of(run, "psnr")) for run in runs]
            known = [(x, y) for x, y in final if x is not None and y is not None] if held_out else []
            end = [tuple(np.mean(known, axis=0).tolist())] if known else []
            series.append(Series(row.name, style[row.name], points, [(x, y) for x, y in end]))
        charts.append((scene, line_chart(scene, series, x_label=x_label, y_label=y_label)))
    if not any(chart for _, chart in charts):
        return None
    return {"held_out": held_out, "y_label": y_label, "charts": [pair for pair in charts if pair[1]]}


def _mean_curve(
    histories: Sequence[Sequence[Mapping[str, object]]], held_out: bool
) -> list[tuple[float, float]]:
    steps: dict[int, list[tuple[float, float]]] = {}
    for rows in histories:
        for row in rows:
            step = int(str(row["step"]))
            name = next((name for name in _LOOKS if name in row), None) if held_out else "psnr"
            if name is not None and name in row:
                x = float(str(row.get("seconds", step))) if held_out else float(step)
                y = float(str(row[name]))
                if np.isfinite(y):
                    steps.setdefault(step, []).append((x, y))
    curve = [np.mean(steps[step], axis=0).tolist() for step in sorted(steps)]
    return [(x, y) for x, y in curve]


def over_views(sections: Sequence[Section]) -> list[tuple[str, Section, Markup]]:
    """PSNR over the number of training views, where a study has several: title, a section of these rows, chart.

    Published and built-in scenes stand apart.
    """
    charts = []
    for builtin in (False, True):
        own = [s for s in sections if s.setting.builtin is builtin and s.setting.views > 0]
        own.sort(key=lambda section: section.setting.views)
        counts = sorted({section.setting.views for section in own})
        if len(counts) < 2 or len({s.setting for s in own}) != len(counts):
            continue
        series = []
        for name, style in styles(own[0].rows).items():
            rows = [(s.setting.views, row) for s in own for row in s.rows if row.name == name]
            points = [(float(n), row.metrics["psnr"].mean) for n, row in rows if "psnr" in row.metrics]
            series.append(Series(name, style, points, points))
        title, ticks = "Built-in scene" if builtin else "All scenes", [float(count) for count in counts]
        labels = {"x_label": "training views (logarithmic)", "y_label": "PSNR (dB)"}
        chart = line_chart(title, series, **labels, y_span=30.0, x_ticks=ticks)
        charts.append((title, own[0], chart))
    return charts
