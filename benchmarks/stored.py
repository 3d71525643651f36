"""Stored figures: one file of JSON lines a study in benchmarks/results, one named record a line."""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gridreg.errors import InputError
from gridreg.training.files import check_output_folder, write_text

RESULTS = Path(__file__).parent / "results"
SCENES = Path(__file__).parents[1] / "outputs" / "benchmarks"
"""Folder of the built-in scene: not in a folder for temporary files that anybody could have made first."""
Record = dict[str, Any]


def load(study: str, results: Path = RESULTS) -> list[Record]:
    """Return the records of a study in the order of their names; none where nothing is stored.

    Raises:
        InputError: for a line that is not a record.
    """
    path = results / f"{study}.jsonl"
    lines = path.read_text(encoding="utf-8").split("\n") if path.is_file() else []
    found = []
    for number, line in enumerate(lines, start=1):
        if line:
            try:
                record = json.loads(line)
                record["name"]
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{path}:{number}: found no record, expected a JSON object with a name"
                ) from None
            found.append(record)
    return found


def find(study: str, name: str, results: Path = RESULTS) -> Record | None:
    """Return the record of a name, or None."""
    return next((record for record in load(study, results) if record["name"] == name), None)


def save(study: str, name: str, record: Record, results: Path = RESULTS) -> None:
    """Store a record, in place of one of the same name; several programs may do so at the same time.

    Raises:
        InputError: if the place is not writable.
    """
    check_output_folder(results)
    with _alone(results):
        kept = {one["name"]: one for one in load(study, results)} | {name: {"name": name, **record}}
        lines = [json.dumps(kept[key], ensure_ascii=False, allow_nan=False) for key in sorted(kept)]
        write_text(results / f"{study}.jsonl", "".join(f"{line}\n" for line in lines))


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Wait until no other program writes to the folder; the lock ends with the program that holds it."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        os.close(opened)


def parser_of(about: str | None, *, threads: bool = False) -> argparse.ArgumentParser:
    """Return a parser for a program with this docstring, with the options that programs here have in common."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if threads:
        parser.add_argument("--threads", type=int, help="processor threads; default: all cores")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the stored figures")
    return parser


def command_line(program: str) -> list[str]:
    """Return the words of this command line, with places on this machine as ``DIR``.

    Args:
        program: such as ``benchmarks/bodies.py``.
    """
    return [program, *("DIR" if Path(word).is_absolute() else word for word in sys.argv[1:])]
