"""A second process that compiles kernels while the first one does, from the other end.

A run compiles what it uses, in the order in which it uses it, and numba compiles one function at a time. Where the
cache is empty, the process that finds it so starts another one, which begins with what a run needs last and ends where
both meet: on two processors a first run waits little more than half as long. What neither of the two needs is not
compiled.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import os
import subprocess
import sys

from backbones.kernels.dot_blocks import available
from gridreg.cores import usable_cores

__all__ = ["main", "start"]

_SWITCH = "GRIDREG_COMPILE_AHEAD"
# Of a run with a VM field, from the one that it compiles last.
_ORDER = (
    "encode._forward",
    "vm._density",
    "adam_update._flat",
    "adam_update._grid",
    "adam_update._edges",
    "vm_gradient._density_backward",
    "sums._thin",
    "sums._measure",
    "composite._weights_backward",
    "vm_gradient._low_features_backward",
    "rows._sort",
    "dots._low",
    "dots._sum_rows",
    "sums._fold",
    "perceptron_dots.backward",
    "perceptron_float.backward",
    "pools._gather",
    "composite._pixels_backward",
    "composite._pixels_forward",
    "pools._spread",
    "perceptron_dots.forward",
    "perceptron_float.forward",
)
# Modules that only a processor with dot products of bfloat16 needs, and that only others need.
_DOTS, _OTHERS = ("dots", "perceptron_dots"), ("perceptron_float",)


def start() -> subprocess.Popen[bytes] | None:
    """Start the second process, if a processor is free for it; it ends with this one.

    The variable ``GRIDREG_COMPILE_AHEAD=0`` forbids it.
    """
    frozen = getattr(sys, "frozen", False) or not sys.executable
    if frozen or usable_cores() < 2 or os.environ.get(_SWITCH, "1") == "0":
        return None
    try:
        helper = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, _SWITCH: "0", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
    except OSError:
        return None
    atexit.register(_stop, helper)
    return helper


def _stop(helper: subprocess.Popen[bytes]) -> None:
    # Files of the cache are written beside and renamed, so none is left half-written.
    helper.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        helper.wait(5)


def main() -> None:
    """Compile until there is a kernel that another process has compiled."""
    for name in _ORDER:
        module, _, function = name.partition(".")
        if module in (_OTHERS if available() else _DOTS):
            continue
        kernel = getattr(importlib.import_module(f"backbones.kernels.{module}"), function)
        if kernel.cached:
            break
        _ = kernel.address


if __name__ == "__main__":
    main()
