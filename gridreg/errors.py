"""Exceptions for input that a user can mend, and the line that names what was meant."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

RENAMED = {
    "Distortion": "DistortionLoss",
    "SpaceAnnealing": "SampleSpaceAnnealing",
    "SpatialAnnealing": "GridBlur",
}
"""Names that went, with those that took their place: found in files and programs from before."""

RENAMED_KEYS = {"pool_weight": "merge_weight", "faint_gradient": "stochastic_rounding"}
"""Keys of configurations that went, with those that took their place."""

KeyPath = tuple[str | int, ...]
"""Keys and list indices from the top of plain data to a value in it, such as ``("train", "steps")``."""

_LONGEST = 480


def one_line(text: str, longest: int = _LONGEST) -> str:
    """Text that may come from anybody's file, fit for a terminal or a log: one line, printable, not endless.

    Line breaks, escapes and lone surrogates are written as in a Python string; of a long text the middle is left out.

    Example:
        >>> one_line("two\\nlines")
        'two\\\\nlines'
    """
    shown = "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[: 4 * longest]
    )
    if len(text) <= longest and len(shown) <= longest:
        return shown
    tail = "".join(c if c.isprintable() else "?" for c in text[-longest // 4 :])
    return f"{shown[: longest - len(tail) - 5]} ... {tail}"


@contextmanager
def silenced(library: str) -> Iterator[None]:
    """Keep a library from logging lines of its own about a file: what goes wrong is raised, or does not matter."""
    logger = logging.getLogger(library)
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


class InputError(ValueError):
    """Bad input: its text is one line that names the file or argument, what was found and what is expected.

    The programs print that line and exit with status 2; library callers may catch it as a ``ValueError``. What cannot
    be printed is escaped here, so that no name in a file becomes a line of its own or a command to the terminal.
    """

    def __init__(self, text: object = "") -> None:
        super().__init__(one_line(str(text)))


class ConfigError(InputError):
    """A value of a configuration that will not do.

    Args:
        path: where it stands; empty for the whole.
        problem: what was found and what is expected, without path and source.
        source: names the data, with the line where it is known, such as ``"study.yaml:12"``.

    Example:
        >>> ConfigError(("train", "steps"), "found 0, expected at least 1", "run.yaml:3")
        ConfigError('run.yaml:3: train.steps: found 0, expected at least 1')
    """

    def __init__(self, path: KeyPath, problem: str, source: str = "") -> None:
        self.path, self.problem, self.source = tuple(path), problem, source
        super().__init__(": ".join(part for part in (source, ".".join(map(str, path)), problem) if part))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.problem, self.source)


def near_names(name: object, valid: Iterable[str], count: int = 1) -> str:
    """Continuation of an error about an unknown name: its successor, or else the names that are spelled like it.

    Args:
        name: what was found.
        valid: what could have been meant.
        count: how many names to offer at most.

    Returns:
        Text that begins with a semicolon, or nothing where no name is near.

    >>> near_names("fourier", ["fourierf", "tensorf"]), near_names("Distortion", []), near_names("x", ["abc"])
    ("; did you mean 'fourierf'?", "; it is called 'DistortionLoss' now.", '')
    """
    if name in RENAMED:
        return f"; it is called {RENAMED[str(name)]!r} now."
    near = difflib.get_close_matches(str(name), list(valid), n=count, cutoff=0.5)
    return f"; did you mean {', '.join(map(repr, near))}?" if near else ""
