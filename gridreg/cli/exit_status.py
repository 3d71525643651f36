"""Ends of every program of gridreg: what bad input, Ctrl-C and a full disk look like, in one place."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from typing import Any, TextIO

from gridreg.errors import InputError, one_line

_OF_TRAIN = {
    "PIL",
    "imageio",
    "imageio_ffmpeg",
    "jinja2",
    "llvmlite",
    "matplotlib",
    "numba",
    "safetensors",
    "scipy",
    "skimage",
}
_OF_TRAIN |= {"tqdm", "trimesh", "tyro"}
# Line breaks that a program prints on purpose, and colours, reach a terminal; so does what progress bars move by, on
# standard error. Other control characters come from names in files of others.
_CONTROL = re.compile(r"[^\S\n\t ]|[^\w\s\x20-\x7e]")
_PASS = re.compile(r"(\x1b\[[0-9;]*m)")
_PASS_LIVE = re.compile(r"(\x1b\[[0-9;]*[mKA]|\r)")


class _Output:
    """Standard output or error that takes whatever is printed to it and never ends the program.

    Closed, it takes text and drops it. What its encoding has not got, and whatever a terminal would obey, is escaped.
    An error of the disk behind it is kept for the end.

    Args:
        stream: what stood there; None if it was closed.
        passing: controls that are not escaped.
    """

    def __init__(self, stream: TextIO | None, passing: re.Pattern[str]) -> None:
        self.stream: TextIO = open(os.devnull, "w", encoding="utf-8") if stream is None else stream  # noqa: SIM115
        self.passing = passing
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write text, with controls and what the encoding lacks escaped; an error is kept for later."""
        # Every second part is one that passes.
        parts = self.passing.split(text)
        parts[::2] = [_CONTROL.sub(lambda m: one_line(m[0]), part) for part in parts[::2]]
        text = "".join(parts)
        encoding = getattr(self.stream, "encoding", None) or "utf-8"
        self._try(self.stream.write, text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Hand on what is buffered; an error is kept for later."""
        self._try(self.stream.flush)

    def _try(self, act: Callable[..., Any], *arguments: Any) -> None:
        try:
            act(*arguments)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.error = error

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def run_cli(program: Callable[[], int]) -> int:
    """Run a program and return the exit status of what became of it.

    Bad input is one line ``error: ...`` on standard error and status 2, and so is output that could not be written;
    Ctrl-C is one line and status 130. Anything else that is raised is a defect and keeps its traceback.

    Example:
        >>> run_cli(lambda: 0)
        0
    """
    # Nothing here draws on a screen; what a notebook sets for its own process is often not installed beside us.
    os.environ["MPLBACKEND"] = "agg"
    before = sys.stdout, sys.stderr
    output = _Output(sys.stdout, _PASS)
    sys.stdout, sys.stderr = output, _Output(sys.stderr, _PASS_LIVE)  # type: ignore[assignment]
    try:
        status = _status_of(program)
        if output.error is not None:
            print(f"error: standard output: cannot write: {output.error.strerror}", file=sys.stderr)
            # The interpreter must not try once more.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return status if output.error is None else status or 2
    finally:
        sys.stdout, sys.stderr = before


def _status_of(program: Callable[[], int]) -> int:
    try:
        status = program()
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in _OF_TRAIN:
            raise
        print(f"error: {error.name} is not installed: pip install 'gridreg[train]'", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read standard output has seen enough; the interpreter must not flush it once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 141
