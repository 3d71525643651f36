"""Results as a table for other programs: CSV, or Parquet through pyarrow."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gridreg.ablation.records import RunResult
from gridreg.errors import InputError
from gridreg.training.files import write_text, writing


def table_rows(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """One flat row a run: what determines it, its mean scores, seconds by phase, and where it was computed.

    Columns that only finished runs have are None in the others.
    """
    groups = {
        group: sorted({key for result in results for key in (result.metrics or {}).get(group, {})})
        for group in ("mean", "seconds")
    }
    rows = []
    for result in results:
        spec, metrics = result.spec, result.metrics or {}
        mean, seconds, versions = (metrics.get(group, {}) for group in ("mean", "seconds", "versions"))
        rows.append(
            {
                "label": spec.label,
                "scene": spec.scene_name,
                "protocol": spec.protocol,
                "views": spec.views,
                "seed": spec.seed,
                "preset": spec.preset,
                "backbone": spec.backbone,
                "status": result.status,
                **{score: _number(mean.get(score)) for score in groups["mean"]},
                "steps": metrics.get("steps"),
                "seconds": result.seconds if result.status == "done" else None,
                **{f"seconds_{phase}": _number(seconds.get(phase)) for phase in groups["seconds"]},
                "threads": versions.get("threads"),
                "machine": result.machine or None,
                "gridreg": versions.get("gridreg"),
                "torch": versions.get("torch"),
                "reason": result.reason or None,
                "hash": spec.hash,
            }
        )
    return rows


def export_results(results: Sequence[RunResult], path: Path) -> Path:
    """Write the table, whole or not at all.

    Args:
        results: the runs.
        path: ends in ``.csv`` or ``.parquet``.

    Raises:
        InputError: for another ending, an unwritable place, or Parquet without pyarrow.
    """
    rows = table_rows(results)
    if path.suffix == ".csv":
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=list(rows[0]) if rows else ["label"], lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
        write_text(path, text.getvalue())
    elif path.suffix == ".parquet":
        _write_parquet(rows, path)
    else:
        raise InputError(
            f"{path}: found the ending {path.suffix or 'of nothing'!r}, expected .csv or .parquet"
        )
    return path


def _cell(value: Any) -> Any:
    """A value for a spreadsheet, which would take text that begins like a formula for one and run it."""
    return f"'{value}" if isinstance(value, str) and value.startswith(tuple("=+-@\t\r")) else value


def _number(value: Any) -> float | None:
    # The files hold infinities as text.
    return None if value is None else float(value)


def _write_parquet(rows: Sequence[dict[str, Any]], path: Path) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            f"{path}: Parquet needs pyarrow, which is not installed; install gridreg[parquet], or export to .csv"
        ) from None
    table = pyarrow.Table.from_pylist(list(rows))
    with writing(path) as temporary:
        parquet.write_table(table, temporary)
