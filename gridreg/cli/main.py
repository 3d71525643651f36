"""``gridreg COMMAND ...``: finds the command and loads nothing but what it needs.

Each command is a module with a dataclass of options, which tyro turns into ``--help``, and a function ``run``.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union

import gridreg
from gridreg.cli.exit_status import run_cli
from gridreg.errors import InputError, near_names


@dataclass(frozen=True)
class Command:
    """A command and the place of its code.

    Args:
        about: one line for the overview.
        options: name of the dataclass of its options.
        module: that holds this dataclass, and ``run``, which takes the options and returns the exit status.
    """

    about: str
    options: str
    module: str

    def load(self) -> tuple[Any, Callable[[Any], int | None]]:
        """Import it: the dataclass of its options, and what runs it."""
        module = importlib.import_module(self.module)
        return getattr(module, self.options), module.run


def _own(about: str, options: str, module: str) -> Command:
    return Command(about, options, f"gridreg.cli.{module}")


COMMANDS: dict[str, Command] = {
    "board": _own("draw the sheet to print and to photograph an object on", "BoardOptions", "board"),
    "reconstruct": _own("make an object of photographs, in one command", "ReconstructOptions", "reconstruct"),
    "prepare": _own("turn a folder of images into a scene", "PrepareOptions", "prepare"),
    "train": _own("reconstruct a scene, score it, and write a mesh and a video", "TrainOptions", "train"),
    "eval": _own("score a checkpoint again", "EvalOptions", "evaluate"),
    "ensemble": _own("make one run of several: the mean of their fields", "EnsembleOptions", "ensemble"),
    "view": _own("look at a checkpoint in the browser", "ViewOptions", "view"),
    "render": _own("render a video of one checkpoint, or of several side by side", "RenderOptions", "render"),
    "mesh": _own("cut a mesh out of a checkpoint", "MeshOptions", "mesh"),
    "page": _own("make the page of a run, to pass on", "PageOptions", "page"),
    "compare-mesh": _own("measure a mesh against the true one", "CompareMeshOptions", "compare_mesh"),
    "ablate": Command(
        "compare compositions of regularizers over scenes and seeds",
        "AblationOptions",
        "gridreg.ablation.command",
    ),
    "tune": Command(
        "choose strengths of regularizers by the training views of a scene",
        "TuneOptions",
        "gridreg.ablation.tune",
    ),
    "report": Command(
        "make the report of a table of anybody's results", "ReportOptions", "gridreg.ablation.table_report"
    ),
    "show": _own("list presets, compositions, protocols, regularizers and keys", "ShowOptions", "show"),
    "bench": _own("run a benchmark of a checkout", "BenchOptions", "bench"),
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
    options, run = COMMANDS[name].load()
    if name == "bench":
        # What follows the name of a benchmark is the benchmark's own.
        return int(run(rest) or 0)
    from gridreg.cli.arguments import parse_options
    from gridreg.training.progress import compilation_shown

    chosen = parse_options(options, rest, f"gridreg {name}")
    with compilation_shown():
        return int(run(chosen) or 0)


def options_of(name: str) -> Any:
    """The dataclass of a command's options."""
    return COMMANDS[name].load()[0]


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


def _completion(words: list[str]) -> int:
    import tyro

    parts = [
        Annotated[options_of(name), tyro.conf.subcommand(name, prefix_name=False, description=command.about)]
        for name, command in COMMANDS.items()
    ]
    tyro.cli(Union[tuple(parts)], args=words, prog="gridreg")  # type: ignore[call-overload]  # noqa: UP007
    return 0
