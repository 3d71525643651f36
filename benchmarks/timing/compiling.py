"""`compile`: what a first run spends on compiling kernels, and a later one on reading them."""

from __future__ import annotations

import argparse
import os
import tempfile
from unittest import mock

from . import common, schedule, whole_run
from .common import Record

HELP = "seconds that a first run compiles, and that a later one reads what it left"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    whole_run.add_shortened_arguments(parser, steps=60)


def measure(arguments: argparse.Namespace) -> tuple[Record, str]:
    with tempfile.TemporaryDirectory() as cache, mock.patch.dict(os.environ, NUMBA_CACHE_DIR=cache):
        first, later = (whole_run.run_apart(arguments) for _ in range(2))
    kept = {key: first[key] for key in ("scene", "protocol", "preset", "steps", "seed")}
    return {**kept, "first": first["kernels"], "later": later["kernels"]}, schedule.label(arguments)


def show(record: Record) -> str:
    rows = [
        [name, str(record[name]["count"]), f"{record[name]['seconds']:.1f}"] for name in ("first", "later")
    ]
    return f"{record['scene']}, {record['preset']}, {record['steps']} iterations.\n\n" + common.markdown(
        ["run", "kernels", "compiling or reading (s)"], rows
    )
