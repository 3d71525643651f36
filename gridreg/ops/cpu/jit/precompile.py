"""A second process that compiles kernels while the first one does, from the other end.

A run compiles what it uses, in the order in which it uses it, and numba compiles one function at a time.
Where the cache is empty, the process that finds it so starts another one, which begins with what a run needs
last and ends where both meet: on two processors a first run waits little more than half as long. What neither
of the two needs is not compiled.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import os
import subprocess
import sys

from gridreg.machine import usable_cores
from gridreg.ops.cpu.mlp.gemm_tile import has

_SWITCH = "GRIDREG_COMPILE_AHEAD"
# Of a run with a VM field, from the one that it compiles last. Of two, the first is for processors that
# multiply bfloat16, the second for others.
_ORDER: tuple[str | tuple[str, str], ...] = (
    "cpu.vm._density",
    "cpu.adam.kernels.flat_step",
    "cpu.adam.kernels.grid_step",
    "cpu.adam.kernels.keep_edges",
    "cpu.vm_gradient._density_backward",
    "cpu.reductions._round",
    "cpu.reductions._measure",
    "cpu.composite._weights_backward",
    ("cpu.vm_gradient._bf16_features_backward", "cpu.vm_gradient._features_backward"),
    "cpu.counting_sort._sort",
    "cpu.reductions._reduce",
    ("cpu.mlp.kernels.backward_bf16", "cpu.mlp.kernels.backward_f32"),
    "cpu.merging._gather",
    "cpu.composite._pixels_backward",
    "cpu.composite._pixels_forward",
    "cpu.merging._spread",
    ("cpu.mlp.kernels.forward_bf16", "cpu.mlp.kernels.forward_f32"),
)


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
    native = has("avx512bf16")
    for entry in _ORDER:
        name = entry if isinstance(entry, str) else entry[0 if native else 1]
        module, _, function = name.rpartition(".")
        kernel = getattr(importlib.import_module(f"gridreg.ops.{module}"), function)
        if kernel.cached:
            break
        _ = kernel.address


if __name__ == "__main__":
    main()
