"""`memory`: the most memory that a run holds, and when."""

from __future__ import annotations

import argparse

from . import common, schedule, whole_run
from .common import Record

HELP = "peak memory of a run, by what it has done so far"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    whole_run.add_shortened_arguments(parser, steps=150)


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    return whole_run.run_apart(arguments), schedule.label(arguments)


_LABELS = {
    "imports": "all modules imported",
    "scene": "scene read",
    "training": "training done",
    "scoring": "test views scored, pictures written",
}


def show(record: Record) -> str:
    peaks = record["peak_bytes"]
    rows = [[_LABELS[name], f"{peaks[name] / 1e6:.0f}"] for name in _LABELS]
    grid = "x".join(map(str, record["spans"][-1]["resolution"])) or "none"
    return (
        f"{record['scene']}, {record['preset']}, {record['steps']} iterations, grid at the end {grid}.\n\n"
        + common.markdown(["after", "peak so far (MB)"], rows)
    )
