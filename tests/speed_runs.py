"""Tiny sizes, and a caller, for the tests of benchmarks/speed.py."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import stored
from timing import main
from timing.work import Counts

__all__ = ["COUNTS", "SMALL", "TINY", "die", "one_thread", "run"]

TINY = ["--set", "train.rays=48", "field.density_components=4", "field.appearance_components=6"]
SMALL = ["train.voxels_start=512", "train.voxels_end=1728", "train.occupancy_resolution=12"]

COUNTS = Counts(
    rays=5,
    steps=70,
    cells=27,
    samples=11,
    coloured=4,
    density_channels=2,
    appearance_channels=3,
    density_nodes=13,
    appearance_nodes=9,
    nonzero=7,
    nonzero_nodes=8,
    features=4,
    layers=(4 * 5 + 3 * 3 + 3 * 7, 6, 3),
    encodings=((4, 2), (3, 1), (3, 3)),
    parameters=50,
    low=True,
)


@contextmanager
def one_thread() -> Iterator[None]:
    """Commands set the number of threads of the whole process."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def run(words: list[str], results: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """Run a command; what it stored and what it printed."""
    before = {record["name"] for record in stored.load("speed", results)}
    assert main.main([*words, "--threads", "1", "--results", str(results)]) == 0
    (record,) = (record for record in stored.load("speed", results) if record["name"] not in before)
    assert record["threads"] == record["versions"]["threads"] == 1
    assert record["name"].startswith(words[0])
    assert str(results) not in json.dumps(record)
    return record, capsys.readouterr().out


def die(_: object) -> None:
    """End a process as the system does when memory is short."""
    os._exit(9)
