"""How every program of gridreg ends: what bad input and Ctrl-C look like, in one place."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from gridreg.errors import InputError

__all__ = ["run_cli"]


def run_cli(program: Callable[[], int]) -> int:
    """Run a program and give the exit status of what became of it.

    Bad input is one line ``error: ...`` on standard error and status 2, Ctrl-C one line and status 130. Anything else
    that is raised is a defect and keeps its traceback.

    Example:
        >>> run_cli(lambda: 0)
        0
    """
    # Nothing here draws on a screen; what a notebook sets for its own process is often not installed beside us.
    os.environ["MPLBACKEND"] = "agg"
    try:
        status = program()
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read standard output has seen enough; the interpreter must not flush it once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 141
