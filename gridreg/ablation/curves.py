"""PSNR over time, and over the number of training views."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gridreg.ablation.comparison import Row, Section, figure_of
from gridreg.ablation.plots import Series, line_chart, series_class
from gridreg.ablation.records import RunResult

__all__ = ["Histories", "curves", "over_views", "styles"]

Histories = Callable[[RunResult], Sequence[Mapping[str, object]]]
"""Gives the rows of a run's history."""

_LOOKS = ("validation_psnr", "test_psnr")


def styles(rows: Sequence[Row]) -> dict[str, str]:
    """The CSS class of each row's line, by the row's name."""
    found, index = {}, 0
    for row in rows:
        found[row.name] = series_class(index, is_baseline=row.is_baseline)
        index += not row.is_baseline
    return found


def curves(section: Section, histories: Histories) -> str:
    """PSNR over time, one chart for each scene, the mean over seeds.

    Held-out PSNR over seconds of training, where runs looked at it on the way; else that of the training batches over
    iterations.
    """
    style = styles(section.rows)
    held_out = any(
        name in row
        for runs in section.results.values()
        for run in runs
        for row in histories(run)
        for name in _LOOKS
    )
    charts = []
    for scene in section.scenes:
        series = []
        for row in section.rows:
            runs = [run for run in section.results[row.name] if run.spec.scene_name == scene]
            points = _mean_curve([histories(run) for run in runs], held_out)
            final = [
                (seconds, psnr)
                for run in runs
                if (seconds := figure_of(run, "seconds")) is not None
                and (psnr := figure_of(run, "psnr")) is not None
            ]
            end = (
                [(float(np.mean([x for x, _ in final])), float(np.mean([y for _, y in final])))]
                if final
                else []
            )
            series.append(Series(row.name, style[row.name], points, end if held_out else ()))
        unit = "training (s)" if held_out else "iteration"
        what = "held-out PSNR (dB)" if held_out else "PSNR of training batches (dB)"
        charts.append(line_chart(scene, series, x_label=unit, y_label=what))
    if not any(charts):
        return ""
    note = (
        "Lines: views looked at on the way; dots: the final score over all test views. Means over seeds."
        if held_out
        else "Of the training batches, which says how well a run fits what it sees. Means over seeds."
    )
    return f'{_legend(section.rows)}<div class="plots">{"".join(charts)}</div><p class="note">{note}</p>'


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
    curve = [tuple(np.mean(steps[step], axis=0).tolist()) for step in sorted(steps)]
    return [(x, y) for x, y in curve]


def over_views(sections: Sequence[Section]) -> str:
    """PSNR over the number of training views, where a study has several; published and built-in scenes apart."""
    charts = []
    for builtin in (False, True):
        own = [s for s in sections if s.setting.builtin is builtin and s.setting.views > 0]
        counts = sorted({section.setting.views for section in own})
        if len(counts) < 2 or len({s.setting for s in own}) != len(counts):
            continue
        own.sort(key=lambda section: section.setting.views)
        style = styles(own[0].rows)
        series = []
        for name, css in style.items():
            rows = [(s.setting.views, row) for s in own for row in s.rows if row.name == name]
            points = [
                (float(views), row.metrics["psnr"].mean) for views, row in rows if "psnr" in row.metrics
            ]
            series.append(Series(name, css, points, points))
        title = "Built-in scene" if builtin else "All scenes"
        ends = {"x_ticks": [float(count) for count in counts], "log_x": True, "y_span": 30.0}
        chart = line_chart(title, series, x_label="training views (logarithmic)", y_label="PSNR (dB)", **ends)  # type: ignore[arg-type]
        charts.append(_legend(own[0].rows) + chart)
    return "".join(charts)


def _legend(rows: Sequence[Row]) -> str:
    style = styles(rows)
    items = "".join(
        f'<li data-series="{_text(name)}"><svg width="26" height="10" aria-hidden="true">'
        f'<line class="{css}" x1="0" x2="26" y1="5" y2="5"/></svg>{_text(name)}</li>'
        for name, css in style.items()
    )
    return f'<ul class="legend">{items}</ul>'


def _text(text: str) -> str:
    return html.escape(text, quote=True)
