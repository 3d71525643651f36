"""The one exception for input that a user can mend, and the line that names what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["RENAMED", "InputError", "near_names"]

RENAMED = {
    "Distortion": "DistortionLoss",
    "SpaceAnnealing": "SampleSpaceAnnealing",
    "SpatialAnnealing": "GridBlur",
}
"""Names that went, with those that took their place: found in files and programs from before."""


class InputError(ValueError):
    """Bad input: its text is one line that names the file or argument, what was found and what is expected.

    The programs print that line and exit with status 2; library callers may catch it as a ``ValueError``.
    """


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
