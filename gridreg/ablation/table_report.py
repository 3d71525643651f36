"""The report of anybody's results, from a table with one run a line."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from gridreg.ablation.comparison import cell_of
from gridreg.ablation.records import RunResult, RunSpec, Study
from gridreg.ablation.report import write_report
from gridreg.errors import InputError, near_names
from gridreg.scenes.files import read_text

# Of a row: all that is no metric. What a store exports can be read back.
_TEXTS = ("label", "scene", "protocol", "preset", "backbone", "status", "machine", "reason")
_OTHERS = ("seed", "views", "steps", "seconds", "threads", "gridreg", "torch", "hash")
_IMAGES = ("image", "target")


@dataclass
class ReportOptions:
    """Write the report of a table of results: paired differences, forest plot, and tables as Markdown and LaTeX."""

    table: tyro.conf.Positional[Path]
    """CSV file, one run a line: label, scene, seed, and metrics, of which psnr (dB) is compared."""
    baseline: str
    """Label of the rows that the others are compared with."""
    out: Path | None = None
    """HTML file; default: that of the table, with the ending .html. Tables stand beside it as .md and .tex."""
    title: str | None = None
    """Title of the report; default: the name of the table."""


class TableResults(NamedTuple):
    """Results as a report asks for them, in the order of the table."""

    found: list[RunResult]

    def results(self, study: Study) -> list[RunResult]:
        """All of them."""
        return self.found


def run(options: ReportOptions) -> int:
    """Write the report, and print where it is; returns 0.

    Raises:
        InputError: for a table that cannot be read, a baseline that is not in it, or a place that is not writable.
    """
    text, found = read_table(options.table)
    specs = tuple(result.spec for result in found)
    name, title = options.table.name, options.title or options.table.stem
    study = Study(name, title, options.baseline, specs, text)
    if options.baseline not in study.labels:
        near = near_names(options.baseline, study.labels)
        known = ", ".join(map(repr, study.labels))
        raise InputError(f"--baseline: found {options.baseline!r}, expected one of {known}{near}")
    place = write_report(TableResults(found), study, options.out or options.table.with_suffix(".html"))
    print(f"report: {place}")
    return 0


def read_table(path: Path) -> tuple[str, list[RunResult]]:
    """The text of a table, and its runs.

    Columns ``label`` and ``psnr`` must be there; ``scene``, ``seed``, ``protocol``, ``views``, ``preset`` and
    ``backbone`` tell which runs are pairs. ``image`` and ``target`` (or ``image:VIEW`` and ``target:VIEW``) are paths
    of images, from the table's folder on. All other columns are metrics.

    Raises:
        InputError: one line that names the table, the line and the column of what is wrong.
    """
    text = read_text(path, "table")
    try:
        reader = csv.DictReader(io.StringIO(text), strict=True)
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}: not a table of comma-separated values: {error}") from error
    columns = [column.strip() for column in reader.fieldnames or ()] if rows else []
    for needed in ("label", "psnr"):
        if columns.count(needed) != 1:
            shown = ", ".join(columns) or "no row"
            raise InputError(f"{path}: found {shown}, expected one column {needed!r}, and one run a line")
    found, lines = [], dict[tuple[Any, ...], int]()
    for line, row in rows:
        if None in row or None in row.values():
            raise InputError(f"{path}:{line}: found another number of cells than of columns ({len(columns)})")
        result = _result({key.strip(): value.strip() for key, value in row.items()}, path, line)
        spec = result.spec
        place = (spec.label, cell_of(spec))
        if lines.setdefault(place, line) != line:
            raise InputError(
                f"{path}:{line}: found the same run as in line {lines[place]}: {spec.describe()}"
            )
        found.append(result)
    return text, found


def _result(row: Mapping[str, str], path: Path, line: int) -> RunResult:
    def number(column: str, kind: type[int] | type[float], default: Any) -> Any:
        text = row.get(column, "")
        try:
            value = kind(text) if text else default
        except ValueError:
            value = math.nan
        # A perfect image has an infinite PSNR; it is no figure to take a mean of.
        if value is not None and math.isnan(value):
            raise InputError(f"{path}:{line}: {column}: found {text!r}, expected a number")
        return value

    texts = {column: _unquoted(row.get(column, "")) for column in _TEXTS}
    if not texts["label"]:
        raise InputError(f"{path}:{line}: label: missing, expected the name of a row")
    spec = RunSpec(
        label=texts["label"],
        scene=texts["scene"] or "scene",
        protocol=texts["protocol"] or path.stem,
        views=number("views", int, 0),
        seed=number("seed", int, 0),
        preset=texts["preset"],
        backbone=texts["backbone"],
        config={"label": texts["label"]},
    )
    paths: dict[str, Path] = {}
    scores: dict[str, float] = {}
    for column, text in row.items():
        kind, _, view = column.partition(":")
        if not text or column in (*_TEXTS, *_OTHERS) or column.startswith("seconds_"):
            continue
        if kind in _IMAGES:
            paths["target:" * (kind == "target") + (view or "image")] = path.parent / text
        else:
            scores[column] = number(column, float, None)
    done = "psnr" in scores and texts["status"] in ("", "done")
    seconds = number("seconds", float, None)
    train = number("seconds_train", float, seconds)
    views: dict[str, Any] = {view: {} for view in paths if not view.startswith("target:")}
    metrics = {"mean": scores, "images": views, "seconds": {"train": "nan" if train is None else train}}
    reason = texts["reason"] or ("" if done else "no PSNR in the table")
    status = texts["status"] if texts["status"] in ("waiting", "running") else "failed"
    return RunResult(
        spec,
        "done" if done else status,  # type: ignore[arg-type]
        metrics if done else None,
        reason,
        path.parent,
        seconds or 0.0,
        texts["machine"],
        paths,
    )


def _unquoted(text: str) -> str:
    """Text without the apostrophe that keeps spreadsheets from running it."""
    return text[1:] if text[:1] == "'" and text[1:2] in "=+-@" else text
