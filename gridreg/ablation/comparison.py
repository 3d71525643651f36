"""Results of a study, sorted into tables: what may stand side by side, and what each row comes to.

One table holds what was trained and scored on the same views. The built-in scene has tables of its own: it is no
published benchmark, and a mean over both would mean nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from gridreg.ablation.records import RunResult, RunSpec, Study
from gridreg.ablation.statistics import Cell, Difference, Estimate, estimate, holm, paired_differences
from gridreg.errors import InputError

__all__ = ["LEVEL", "Row", "Section", "Setting", "compare", "figure_of"]

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
        preset: where the configuration started from.
        backbone: name of the field.
        is_baseline: whether others are compared with it.
        done, failed, expected: numbers of runs.
        uses_alpha: whether any run starts from the alpha masks of its views (carving).
        metrics: mean and interval by metric (``psnr``, ``ssim_gaussian``, ...) over scenes and seeds.
        seconds: of training; None when nothing is finished.
        difference: in PSNR to the baseline, dB; None for the baseline, and where the table has none to compare with.
        adjusted_p: Holm's p-value over all rows of the table; None below two pairs.
        scenes: PSNR over seeds by scene, dB.
        scene_differences: to the baseline by scene, dB.
    """

    name: str
    label: str
    preset: str
    backbone: str
    is_baseline: bool
    done: int
    failed: int
    expected: int
    uses_alpha: bool
    metrics: Mapping[str, Estimate]
    seconds: Estimate | None
    difference: Difference | None
    adjusted_p: float | None
    scenes: Mapping[str, Estimate]
    scene_differences: Mapping[str, Difference]

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
        results: its finished runs by the row's name.
    """

    setting: Setting
    baseline: str
    scenes: tuple[str, ...]
    rows: tuple[Row, ...]
    results: Mapping[str, tuple[RunResult, ...]]

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
    found = _by_place(results)
    # Its folder may be given like any other scene's: then only finished runs know what it is.
    builtin = {r.spec.scene_name for r in found.values() if (r.metrics or {}).get("builtin", False)}
    sections: dict[Setting, list[RunSpec]] = {}
    for spec in study.runs:
        own = spec.scene is None or spec.scene_name in builtin
        setting = Setting(own, spec.protocol, spec.views, spec.size or 0)
        sections.setdefault(setting, []).append(spec)
    published_first = sorted(sections, key=lambda setting: setting.builtin)
    return [_section(setting, study, sections[setting], found) for setting in published_first]


def _cell(spec: RunSpec) -> Cell:
    return Cell(
        spec.scene_name, spec.protocol, spec.views, spec.seed, spec.preset, spec.backbone, spec.size or 0
    )


def _by_place(results: Iterable[RunResult]) -> dict[tuple[str, Cell], RunResult]:
    found: dict[tuple[str, Cell], RunResult] = {}
    for result in results:
        place = (result.spec.label, _cell(result.spec))
        if place in found and found[place].spec.hash != result.spec.hash:
            raise InputError(
                f"study: two different runs are called {result.spec.describe()!r}; expected one label for each "
                "composition"
            )
        found[place] = result
    return found


def _section(
    setting: Setting, study: Study, specs: Sequence[RunSpec], found: Mapping[tuple[str, Cell], RunResult]
) -> Section:
    kinds: dict[tuple[str, str, str], list[RunSpec]] = {}
    for spec in specs:
        kinds.setdefault((spec.label, spec.preset, spec.backbone), []).append(spec)
    names = _names(list(kinds))
    results = {
        names[kind]: tuple(found[place] for s in kinds[kind] if (place := (s.label, _cell(s))) in found)
        for kind in kinds
    }
    differences = _differences(kinds, results, names, study.baseline)
    tested = [name for name, d in differences.items() if d.p_value is not None]
    adjusted = dict(zip(tested, holm([differences[name].p_value or 0.0 for name in tested]), strict=True))
    rows = []
    for (label, preset, backbone), asked in kinds.items():
        name = names[(label, preset, backbone)]
        own = results[name]
        done = [result for result in own if result.status == "done"]
        difference = differences.get(name)
        rows.append(
            Row(
                name=name,
                label=label,
                preset=preset,
                backbone=backbone,
                is_baseline=_is_baseline(label, study.baseline),
                done=len(done),
                failed=sum(result.status == "failed" for result in own),
                expected=len(asked),
                uses_alpha=any((result.metrics or {}).get("uses_alpha", False) for result in done),
                metrics=_estimates(done),
                seconds=_estimate(done, "seconds"),
                difference=difference,
                adjusted_p=adjusted.get(name),
                scenes=_by_scene(done),
                scene_differences=_split_by_scene(difference),
            )
        )
    scenes = tuple(dict.fromkeys(spec.scene_name for spec in specs))
    finished = {name: tuple(r for r in own if r.status == "done") for name, own in results.items()}
    return Section(setting, study.baseline, scenes, tuple(rows), finished)


def _names(kinds: Sequence[tuple[str, str, str]]) -> dict[tuple[str, str, str], str]:
    """The label is the name, unless one label has several presets or backbones in this table."""
    labels = [label for label, _, _ in kinds]
    return {
        (label, preset, backbone): label if labels.count(label) == 1 else f"{label} ({preset}, {backbone})"
        for label, preset, backbone in kinds
    }


def _is_baseline(label: str, baseline: str) -> bool:
    """Whether a row is the baseline; a study of several presets has one for each, ``label [preset]``."""
    stem, bracket, _ = baseline.partition(" [")
    return label == baseline or (bool(bracket) and label.startswith(f"{stem} ["))


def _differences(
    kinds: Mapping[tuple[str, str, str], Sequence[RunSpec]],
    results: Mapping[str, Sequence[RunResult]],
    names: Mapping[tuple[str, str, str], str],
    baseline: str,
) -> dict[str, Difference]:
    values: dict[str, dict[Cell, float]] = {baseline: {}}
    for kind in kinds:
        # The cell holds preset and backbone, so every row finds the baseline of its own.
        row = values.setdefault(baseline if _is_baseline(kind[0], baseline) else names[kind], {})
        for result in results[names[kind]]:
            value = figure_of(result, "psnr")
            if value is not None:
                row[_cell(result.spec)] = value
    every = paired_differences(values, baseline)
    return {name: difference for name, difference in every.items() if difference.pairs}


def _estimate(results: Iterable[RunResult], metric: str) -> Estimate | None:
    values = [value for result in results if (value := figure_of(result, metric)) is not None]
    return estimate(values) if values else None


def _estimates(results: Sequence[RunResult]) -> dict[str, Estimate]:
    metrics = dict.fromkeys(metric for result in results for metric in (result.metrics or {}).get("mean", {}))
    found = {metric: _estimate(results, metric) for metric in metrics}
    return {metric: value for metric, value in found.items() if value is not None}


def _by_scene(results: Sequence[RunResult]) -> dict[str, Estimate]:
    scenes: dict[str, list[RunResult]] = {}
    for result in results:
        scenes.setdefault(result.spec.scene_name, []).append(result)
    found = {scene: _estimate(own, "psnr") for scene, own in scenes.items()}
    return {scene: value for scene, value in found.items() if value is not None}


def _split_by_scene(difference: Difference | None) -> dict[str, Difference]:
    scenes: dict[str, dict[Cell, float]] = {}
    for cell, value in (difference.pairs if difference else {}).items():
        scenes.setdefault(cell.scene, {})[cell] = value
    return {scene: Difference(pairs, estimate(pairs.values()), None) for scene, pairs in scenes.items()}
