"""The one exception for input that a user can mend."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input: its text is one line that names the file or argument, what was found and what is expected.

    The programs print that line and exit with status 2; library callers may catch it as a ``ValueError``.
    """
