"""The commands, and the options that all of them have."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import stored
import torch

from . import common, compiling, frame, masks, memory, roofline, scaling, schedule, step
from .common import existing_folder

COMMANDS = {
    "step": step,
    "schedule": schedule,
    "frame": frame,
    "scaling": scaling,
    "masks": masks,
    "memory": memory,
    "roofline": roofline,
    "compile": compiling,
}


def parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    top = argparse.ArgumentParser(
        prog="speed.py", description="Time, memory and roofline of training and rendering."
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module in COMMANDS.items():
        own = commands.add_parser(name, help=module.HELP, description=module.__doc__)
        module.add_arguments(own)
        own.add_argument("--threads", type=common.count, help="processor threads; default: all cores")
        _add_results(own)
    table = commands.add_parser("table", help="print the stored results as Markdown")
    _add_results(table)
    return top


def _add_results(own: argparse.ArgumentParser) -> None:
    own.add_argument(
        "--results", type=Path, default=stored.RESULTS, metavar="DIR", help="folder of the stored figures"
    )


def table(folder: Path) -> str:
    """Every stored result under a heading; the newest program shows what older ones stored."""
    parts = []
    for name, module in COMMANDS.items():
        for record in stored.load(common.STUDY, existing_folder(folder, "--results")):
            if record["command"] == name:
                parts.append(f"## {record['name']}\n\n{common.title(record)}\n\n{module.show(record)}")
    return "\n\n".join(parts) if parts else "Nothing is stored yet."


def main(words: Sequence[str] | None = None) -> int:
    """Run one command.

    Raises:
        InputError: for bad input.
    """
    arguments = parser().parse_args(words)
    if arguments.command == "table":
        print(table(arguments.results))
        return 0
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    module = COMMANDS[arguments.command]
    figures, label = module.measure(arguments)
    record = common.record_of(arguments, figures)
    print(f"{common.title(record)}\n\n{module.show(record)}")
    common.store(arguments, record, label)
    return 0
