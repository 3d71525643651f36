"""``gridreg COMMAND ...``: finds the command and loads nothing but what it needs.

Each command is a module with a dataclass of options, which tyro turns into ``--help``, and a function ``run``.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union

import gridreg
from gridreg.cli.exit_status import run_cli
from gridreg.errors import InputError, near_names

__all__ = ["COMMANDS", "Command", "main", "options_of"]


@dataclass(frozen=True)
class Command:
    """A command and the place of its code.

    Args:
        about: one line for the overview.
        options: ``module:class`` of its options.
        run: ``module:function`` that takes them and returns the exit status.
    """

    about: str
    options: str
    run: str


def _own(about: str, module: str, options: str) -> Command:
    return Command(about, f"gridreg.cli.{module}:{options}", f"gridreg.cli.{module}:run")


COMMANDS: dict[str, Command] = {
    "board": _own("draw the sheet to print and to photograph an object on", "board", "BoardOptions"),
    "reconstruct": _own("make an object of photographs, in one command", "reconstruct", "ReconstructOptions"),
    "prepare": _own("turn a folder of images into a scene", "prepare", "PrepareOptions"),
    "train": Command(
        "reconstruct a scene, score it, and write a mesh and a video",
        "gridreg.training.options:TrainOptions",
        "gridreg.cli.train:run",
    ),
    "eval": _own("score a checkpoint again", "evaluate", "EvalOptions"),
    "ensemble": _own("make one run of several: the mean of their fields", "ensemble", "EnsembleOptions"),
    "view": _own("look at a checkpoint in the browser", "view", "ViewOptions"),
    "render": _own("render a video of one checkpoint, or of several side by side", "render", "RenderOptions"),
    "mesh": _own("cut a mesh out of a checkpoint", "mesh", "MeshOptions"),
    "page": _own("make the page of a run, to pass on", "page", "PageOptions"),
    "compare-mesh": _own("measure a mesh against the true one", "compare_mesh", "CompareMeshOptions"),
    "ablate": Command(
        "compare compositions of regularizers over scenes and seeds",
        "gridreg.ablation.command:AblationOptions",
        "gridreg.ablation.command:run",
    ),
    "tune": Command(
        "choose strengths of regularizers by the training views of a scene",
        "gridreg.ablation.tune:TuneOptions",
        "gridreg.ablation.tune:run",
    ),
    "report": Command(
        "make the report of a table of anybody's results",
        "gridreg.ablation.table_report:ReportOptions",
        "gridreg.ablation.table_report:run",
    ),
    "show": _own("list presets, compositions, protocols, regularizers and keys", "show", "ShowOptions"),
    "bench": _own("run a benchmark of a checkout", "bench", "BenchOptions"),
}
"""The commands by name, in the order of the overview."""

_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: the words after the program's name; None: those of this process.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    return run_cli(lambda: _main(words))


def _main(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    if words[0] in ("-V", "--version"):
        print(f"gridreg {gridreg.__version__}")
        return 0
    if words[0] in _COMPLETION:
        return _completion(words)
    name, rest = words[0], words[1:]
    if name not in COMMANDS:
        known = ", ".join(COMMANDS)
        raise InputError(f"command: found {name!r}, expected one of {known}{near_names(name, COMMANDS)}")
    run = _load(COMMANDS[name].run)
    if name == "bench":
        # What follows the name of a benchmark is the benchmark's own.
        return int(run(rest))
    from gridreg.cli.arguments import parse_options
    from gridreg.training.progress import compilation_shown

    options = parse_options(options_of(name), rest, f"gridreg {name}")
    with compilation_shown():
        return int(run(options) or 0)


def options_of(name: str) -> Any:
    """The dataclass of a command's options."""
    return _load(COMMANDS[name].options)


def overview() -> str:
    """The text of ``gridreg --help``."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.about}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: gridreg COMMAND [OPTIONS]",
            "",
            "From a few photographs to a radiance field, a mesh, a video, and an honest score.",
            "",
            *lines,
            "",
            "gridreg COMMAND --help    options with units and defaults",
            "gridreg --version",
            "gridreg --tyro-print-completion bash|zsh    completion for a shell, to be sourced",
            "",
            "From photographs of your own, taken on the sheet that `gridreg board` draws:",
            "  gridreg reconstruct PHOTOS OUT",
            "or step by step:",
            "  gridreg prepare IMAGES SCENE",
            "  gridreg train --scene SCENE --out RUN --view",
            "  gridreg view RUN",
        ]
    )


def _load(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def _completion(words: list[str]) -> int:
    import tyro

    parts = [
        Annotated[options_of(name), tyro.conf.subcommand(name, prefix_name=False, description=command.about)]
        for name, command in COMMANDS.items()
    ]
    tyro.cli(Union[tuple(parts)], args=words, prog="gridreg")  # type: ignore[call-overload]  # noqa: UP007
    return 0
