"""Results of a study, sorted into tables: what may stand side by side, and what each row comes to.

One table holds what was trained and scored on the same views. The built-in scene has tables of its own: it is no
published benchmark, and a mean over both would mean nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from gridreg.ablation.records import RunResult, RunSpec, Study
from gridreg.ablation.statistics import Cell, Difference, Estimate, estimate, holm, paired_differences
from gridreg.errors import InputError

LEVEL = 0.05
"""Chance of a false finding that intervals (95 %) and tests allow."""


@dataclass(frozen=True, order=True)
class Setting:
    """Properties that the runs of one table have in common.

    Args:
        builtin: whether they are of the built-in scene.
        protocol: name.
        views: number of training views; 0 where the scene alone knows it.
        size: width of the images in pixels; 0: the protocol's.
    """

    builtin: bool
    protocol: str
    views: int
    size: int = 0

    @property
    def title(self) -> str:
        """In a line, for a heading.

        >>> Setting(False, "dietnerf8", 8).title
        'dietnerf8, 8 training views'
        """
        parts = [self.protocol] + [f"{self.views} training views"] * (self.views > 0)
        if self.size:
            parts.append(f"{self.size} pixels wide")
        return ", ".join(parts) + (" (built-in scene, not a published benchmark)" if self.builtin else "")


@dataclass(frozen=True)
class Row:
    """One composition on one setting.

    Args:
        name: for people; the label, with preset and backbone where the table has several.
        label: of the study.
        is_baseline: whether others are compared with it.
        expected: number of its runs.
        runs: those that have a result.
        difference: in PSNR to the baseline, dB; None for the baseline, and where the table has none to compare with.
        adjusted_p: Holm's p-value over all rows of the table; None below two pairs.
    """

    name: str
    label: str
    is_baseline: bool
    expected: int
    runs: tuple[RunResult, ...]
    difference: Difference | None
    adjusted_p: float | None

    @cached_property
    def finished(self) -> tuple[RunResult, ...]:
        """Its finished runs."""
        return tuple(run for run in self.runs if run.status == "done")

    @property
    def done(self) -> int:
        """Number of finished runs."""
        return len(self.finished)

    @property
    def failed(self) -> int:
        """Number of failed runs."""
        return sum(run.status == "failed" for run in self.runs)

    @property
    def uses_alpha(self) -> bool:
        """Whether any run starts from the alpha masks of its views (carving)."""
        return any((run.metrics or {}).get("uses_alpha", False) for run in self.finished)

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Mean and interval by metric (``psnr``, ``ssim_gaussian``, ...) over scenes and seeds."""
        names = dict.fromkeys(name for run in self.finished for name in (run.metrics or {}).get("mean", {}))
        return _means({name: [figure_of(run, name) for run in self.finished] for name in names})

    @property
    def seconds(self) -> Estimate | None:
        """Seconds of training; None when nothing is finished."""
        return _means({"": [figure_of(run, "seconds") for run in self.finished]}).get("")

    @cached_property
    def scenes(self) -> dict[str, Estimate]:
        """PSNR over seeds by scene, dB."""
        found: dict[str, list[float | None]] = {}
        for run in self.finished:
            found.setdefault(run.spec.scene_name, []).append(figure_of(run, "psnr"))
        return _means(found)

    @cached_property
    def scene_differences(self) -> dict[str, Difference]:
        """Differences to the baseline by scene, dB."""
        found: dict[str, dict[Cell, float]] = {}
        for cell, value in (self.difference.pairs if self.difference else {}).items():
            found.setdefault(cell.scene, {})[cell] = value
        return {scene: Difference(pairs, estimate(pairs.values()), None) for scene, pairs in found.items()}

    @property
    def outcome(self) -> str:
        """``baseline``, ``no result``, or the verdict of the difference.

        ``higher`` and ``lower`` become ``higher, uncorrected`` and so on where Holm's correction for the number of
        rows leaves nothing of the finding.
        """
        if self.is_baseline:
            return "baseline"
        if self.difference is None:
            return "no pair" if self.done else "no result"
        verdict = self.difference.verdict
        lost = verdict in ("higher", "lower") and (self.adjusted_p or 0.0) > LEVEL
        return f"{verdict}, uncorrected" if lost else verdict


@dataclass(frozen=True)
class Section:
    """One table.

    Args:
        setting: what its runs have in common.
        baseline: label of the row that the others are compared with.
        scenes: their names, in the order of the study.
        rows: in the order of the study.
    """

    setting: Setting
    baseline: str
    scenes: tuple[str, ...]
    rows: tuple[Row, ...]

    @property
    def results(self) -> dict[str, tuple[RunResult, ...]]:
        """Finished runs by the row's name."""
        return {row.name: row.finished for row in self.rows}

    @property
    def extent(self) -> str:
        """Scenes and seeds in a line, such as ``lego, chair; seeds 0, 1, 2``."""
        seeds = sorted({result.spec.seed for own in self.results.values() for result in own})
        text = ", ".join(self.scenes)
        return f"{text}; seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}" if seeds else text


def figure_of(result: RunResult, metric: str) -> float | None:
    """A figure of a finished run: a mean over test views, or ``seconds`` of training; None if it has no finite one."""
    if result.status != "done" or result.metrics is None:
        return None
    if metric == "seconds":
        value = result.metrics.get("seconds", {}).get("train", result.seconds)
    else:
        value = result.metrics.get("mean", {}).get(metric)
    # What JSON has no number for is kept as text.
    return None if value is None or not math.isfinite(float(value)) else float(value)


def compare(study: Study, results: Iterable[RunResult]) -> list[Section]:
    """Sort results into tables, published benchmarks first.

    Args:
        study: gives the order of rows, the baseline, and how many runs there should be.
        results: of its runs, in any order.

    Raises:
        InputError: two results for the same place in the same row.
    """
    found: dict[tuple[str, Cell], RunResult] = {}
    for result in results:
        place = (result.spec.label, cell_of(result.spec))
        if found.setdefault(place, result).spec.hash != result.spec.hash:
            raise InputError(
                f"study: two different runs are called {result.spec.describe()!r}; expected one label for each "
                "composition"
            )
    # Its folder may be given like any other scene's: then only finished runs know what it is.
    builtin = {r.spec.scene_name for r in found.values() if (r.metrics or {}).get("builtin", False)}
    sections: dict[Setting, list[RunSpec]] = {}
    for spec in study.runs:
        own = spec.scene is None or spec.scene_name in builtin
        setting = Setting(own, spec.protocol, spec.views, spec.size or 0)
        sections.setdefault(setting, []).append(spec)
    published_first = sorted(sections, key=lambda setting: setting.builtin)
    return [_section(setting, study, sections[setting], found) for setting in published_first]


def cell_of(spec: RunSpec) -> Cell:
    """All that a run has in common with those that it is compared with."""
    size = spec.size or 0
    return Cell(spec.scene_name, spec.protocol, spec.views, spec.seed, spec.preset, spec.backbone, size)


def _section(
    setting: Setting, study: Study, specs: Sequence[RunSpec], found: Mapping[tuple[str, Cell], RunResult]
) -> Section:
    kinds: dict[tuple[str, str, str], list[RunSpec]] = {}
    for spec in specs:
        kinds.setdefault((spec.label, spec.preset, spec.backbone), []).append(spec)
    labels = [label for label, _, _ in kinds]
    rows: list[Row] = []
    values: dict[str, dict[Cell, float]] = {study.baseline: {}}
    for (label, preset, backbone), asked in kinds.items():
        # One label may have several presets or backbones in this table.
        name = label if labels.count(label) == 1 else f"{label} ({preset}, {backbone})"
        runs = tuple(found[place] for spec in asked if (place := (label, cell_of(spec))) in found)
        rows.append(Row(name, label, _is_baseline(label, study.baseline), len(asked), runs, None, None))
        # The cell holds preset and backbone, so every row finds the baseline of its own.
        own = values.setdefault(study.baseline if rows[-1].is_baseline else name, {})
        own |= {cell_of(run.spec): psnr for run in runs if (psnr := figure_of(run, "psnr")) is not None}
    every = paired_differences(values, study.baseline)
    differences = {name: difference for name, difference in every.items() if difference.pairs}
    p_values = {name: d.p_value for name, d in differences.items() if d.p_value is not None}
    adjusted = dict(zip(p_values, holm(list(p_values.values())), strict=True))
    compared = [
        replace(row, difference=differences.get(row.name), adjusted_p=adjusted.get(row.name)) for row in rows
    ]
    scenes = tuple(dict.fromkeys(spec.scene_name for spec in specs))
    return Section(setting, study.baseline, scenes, tuple(compared))


def _is_baseline(label: str, baseline: str) -> bool:
    """Whether a row is the baseline; a study of several presets has one for each, ``label [preset]``."""
    stem, bracket, _ = baseline.partition(" [")
    return label == baseline or (bool(bracket) and label.startswith(f"{stem} ["))


def _means(figures: Mapping[str, Iterable[float | None]]) -> dict[str, Estimate]:
    """Mean and interval of the figures that are known, by name; none where there are none."""
    known = {name: [value for value in own if value is not None] for name, own in figures.items()}
    return {name: estimate(own) for name, own in known.items() if own}
