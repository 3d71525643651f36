"""One HTML file that shows what a study found, with nothing beside it and nothing from a network."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from gridreg.ablation.charts import Histories, curves, over_views, styles
from gridreg.ablation.comparison import Row, Section, compare
from gridreg.ablation.forest_plot import forest_plot, heat_map
from gridreg.ablation.mask_images import colour_scale, mask_schedules
from gridreg.ablation.records import RunResult, Study
from gridreg.ablation.tables import (
    LEGEND,
    SIGNS,
    columns_of,
    difference_text,
    duration,
    further_metrics,
    latex,
    markdown,
    mean_text,
    notes_of,
    signed,
)
from gridreg.ablation.templates import render
from gridreg.ablation.wipes import first_choice, wipe_data
from gridreg.errors import InputError
from gridreg.scenes.protocols import get_protocol
from gridreg.training.files import write_bytes

IMAGE_BYTES = 6_000_000
"""Default bound on what images add to the page."""

_FIGURES = (columns_of, further_metrics, signed, mean_text, difference_text, duration, notes_of)
_VERSIONS = ("gridreg", "torch", "numpy", "numba", "python")
_MACHINE = ("cpu", "instructions", "cores", "threads")


class HasResults(Protocol):
    """The part of a store that a report needs."""

    def results(self, study: Study) -> list[RunResult]:
        """Results of the runs of a study, finished or not."""


def _reader(problems: list[str]) -> Histories:
    """Read each run's history once; one that cannot be read is empty, and told in ``problems``."""
    known: dict[Path, list[dict[str, Any]]] = {}

    def rows_of(result: RunResult) -> Sequence[Mapping[str, object]]:
        if result.folder not in known:
            known[result.folder] = []
            try:
                known[result.folder] += [r for r in result.history() if isinstance(r, dict) and "step" in r]
            except InputError as error:
                problems.append(str(error))
        return known[result.folder]

    return rows_of


def write_report(
    store: HasResults, study: Study, path: str | os.PathLike[str], *, image_bytes: int = IMAGE_BYTES
) -> Path:
    """Write the report of a study, and its tables as Markdown and LaTeX beside it.

    The same results make the same bytes. A study that is not finished yet is reported as far as it is.

    Args:
        store: gives the results of the study.
        study: what was asked.
        path: of the HTML file; the tables have its name with the endings ``.md`` and ``.tex``.
        image_bytes: bound on what the images of the slider add to the file.

    Returns:
        The path.

    Raises:
        InputError: the name does not end in ``.html``, or the place is not writable; what stood there stays.
    """
    place = Path(path)
    if place.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{place}: found the ending {place.suffix!r}, expected .html")
    results = store.results(study)
    sections = compare(study, results)
    for ending, text in (
        (".md", markdown(study.title, sections)),
        (".tex", latex(study.title, sections)),
        (place.suffix, _page(study, results, sections, image_bytes)),
    ):
        # Names of files that are not UTF-8 hold lone surrogates, which UTF-8 cannot write.
        write_bytes(place.with_suffix(ending), text.encode("utf-8", "backslashreplace"))
    return place


def _page(study: Study, results: Sequence[RunResult], sections: Sequence[Section], image_bytes: int) -> str:
    problems: list[str] = []
    histories = _reader(problems)
    images = wipe_data(sections, image_bytes)
    source = study.source.encode("utf-8", "backslashreplace")
    return render(
        "report.html",
        title=study.title,
        study=study,
        source_name=study.name if study.name.endswith(".csv") else f"{study.name}.yaml",
        done=sum(result.status == "done" for result in results),
        views=over_views(sections),
        sections=[
            {
                "section": section,
                "styles": styles(section.rows),
                "findings": findings(section),
                "forest": forest_plot(section),
                "heat": heat_map(section),
                "curves": curves(section, histories),
                "choice": first_choice(section, own) if own else None,
            }
            for section, own in zip(sections, images, strict=True)
        ],
        masks=mask_schedules(results, histories),
        scale=colour_scale(),
        failed=[result for result in results if result.status == "failed"],
        problems=problems,
        provenance=provenance(study, results),
        download="data:text/yaml;base64," + base64.b64encode(source).decode(),
        images=images,
        legend=LEGEND,
        signs=SIGNS,
        tone=lambda outcome: {"higher": "up", "lower": "down"}.get(outcome, "noise"),
        styles=styles,
        **{function.__name__: function for function in _FIGURES},
    )


def findings(section: Section) -> dict[str, list[str]]:
    """Names of rows, with a remark, under ``better``, ``worse``, ``within noise`` and ``cannot be told``."""
    groups: dict[str, list[str]] = {"better": [], "worse": [], "within noise": [], "cannot be told": []}
    for row in section.rows:
        if row.is_baseline:
            continue
        kind, remark = _finding(row)
        groups[kind].append(f"{row.name} ({remark})" if remark else row.name)
    return {title: names for title, names in groups.items() if names}


def _finding(row: Row) -> tuple[str, str]:
    outcome, found = row.outcome, row.difference.estimate if row.difference else None
    if outcome in ("higher", "lower") and found is not None:
        return "better" if outcome == "higher" else "worse", f"{signed(found.mean)} dB"
    if outcome == "within noise":
        return outcome, ""
    if outcome.endswith("uncorrected"):
        return "within noise", "a finding by itself, not among so many rows"
    return "cannot be told", outcome


def provenance(study: Study, results: Sequence[RunResult]) -> list[tuple[str, str]]:
    """Origin of the figures: protocols with their views, conventions of the metrics, versions and machines."""
    done = [result for result in results if result.status == "done" and result.metrics is not None]
    entries: list[tuple[str, str]] = []
    for protocol in dict.fromkeys(spec.protocol for spec in study.runs):
        entries.append((f"protocol {protocol}", _protocol(protocol, done)))
    conventions: dict[str, str] = {}
    for result in done:
        conventions.update((result.metrics or {}).get("conventions", {}))
    entries += sorted(conventions.items())
    for keys, title in ((_VERSIONS, "versions"), (_MACHINE, "machine")):
        found = dict.fromkeys(_versions(result, keys, with_name=title == "machine") for result in done)
        entries += [
            (title if len(found) == 1 else f"{title} {n}", text) for n, text in enumerate(found, 1) if text
        ]
    total = sum(result.seconds for result in done)
    return [*entries, ("runs", f"{len(done)} finished, {duration(total)} in all")]


def _protocol(name: str, done: Sequence[RunResult]) -> str:
    own: list[dict[str, Any]] = [r.metrics or {} for r in done if r.spec.protocol == name]
    parts = []
    try:
        parts.append(f"background {get_protocol(name).background}")
    except InputError:
        parts.append("not known here")
    trained = dict.fromkeys(tuple(metrics.get("train_views", ())) for metrics in own)
    if len(trained) == 1:
        views = next(iter(trained))
        shown = " ".join(views[:12]) + (" ..." if len(views) > 12 else "")
        parts.append(f"trained on {len(views)} views: {shown}")
    tested = sorted({int(metrics["test_views"]) for metrics in own if "test_views" in metrics})
    if tested:
        parts.append(f"scored on {' or '.join(map(str, tested))} test views of each scene")
    return "; ".join(parts)


def _versions(result: RunResult, keys: Sequence[str], *, with_name: bool) -> str:
    versions = (result.metrics or {}).get("versions", {})
    parts = [f"{key} {versions[key]}" for key in keys if key in versions]
    return ", ".join([result.machine] * (with_name and bool(result.machine)) + parts)
