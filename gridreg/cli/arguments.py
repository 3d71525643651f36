"""Options: how they are read, and their types as ``--help`` shows them, an optional one by what it holds."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from gridreg.errors import InputError

Checkpoint = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
"""Output folder of a run, or its checkpoint."""
# The hint is left out because it could only say "None": the text of each option says what holds without it.
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")]
OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]

T = TypeVar("T")


def parse_options(options: type[T], words: Sequence[str], program: str) -> T:
    """Read the words of a command line into a dataclass of options.

    Raises:
        InputError: for a wrong option, in one line with a hint.
        SystemExit: after ``--help``.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(options, args=list(words), prog=program)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(f"{_first_of(said.getvalue())}; see {program} --help") from None


def _first_of(box: str) -> str:
    """The message of tyro's framed text, without its title, and the first of the options that it suggests."""
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip("│╭╮╰╯─ ") for line in box.splitlines()[1:]]
    # A blank line, or one of dashes, divides what is said from what is added.
    parts = "\n".join(line if line.strip("-") else "\0" for line in lines).strip("\0\n").split("\0")
    message, rest = " ".join(parts[0].split()).rstrip("."), " ".join(" ".join(parts[1:]).split())
    meant = re.match(r"Perhaps you meant: (--[\w-]+)", rest)
    return message + (f"; did you mean {meant[1]}?" if meant else "")
