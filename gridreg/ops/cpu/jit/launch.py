"""Runs compiled kernels on the threads that torch already owns.

A kernel is a compiled C function that takes the next task, does it, and returns when no task is left: any number
of threads may run it at once, and its result does not depend on how many do, as a task alone decides what it
writes. `launch` runs it on `torch.get_num_threads()` threads.

Why not numba's ``prange``: its layers bring a second pool of threads beside torch's, whose idle threads spin. With
``workqueue``, all that a machine without a system libgomp has, a kernel between two matrix products took three times
as long on two cores, and two Python threads in it at once abort the process. torch ships an OpenMP runtime of its
own, so `launch` asks that one for a team (``GOMP_parallel``): one pool, no oversubscription, a few microseconds per
call, safe from any Python thread. Where torch's runtime offers no such entry (Windows, some builds for macOS) a
small pool of Python threads does the same, slower to wake.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.jit.compiler import Kernel

_Team = Callable[[int, int, int], None]
_NATIVE = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_state: dict[str, Any] = {"forked": False}
# Behind the shape of a tensor of 0, 1, 2 and 3 axes.
_ONES = ((1, 1, 1), (1, 1), (1,), ())


def _openmp_team() -> _Team | None:
    """``GOMP_parallel`` of the runtime that torch is linked to, or None.

    It is looked up through torch's own library, as other packages may have loaded other runtimes.
    """
    name = {"linux": "libtorch_cpu.so", "darwin": "libtorch_cpu.dylib"}.get(sys.platform)
    if name is None or not torch.backends.openmp.is_available():  # type: ignore[no-untyped-call]
        return None
    try:
        parallel = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / name)).GOMP_parallel
    except (OSError, AttributeError):
        return None
    parallel.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
    parallel.restype = None

    def team(function: int, table: int, threads: int) -> None:
        parallel(function, table, threads, 0)

    return team


def _python_team() -> _Team:
    pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1, thread_name_prefix="gridreg-kernel")

    def team(function: int, table: int, threads: int) -> None:
        run = _NATIVE(function)
        helpers = [pool.submit(run, table) for _ in range(threads - 1)]
        run(table)
        # A helper that has not begun has nothing left to do; one that has must leave before the table goes.
        for helper in helpers:
            if not helper.cancel():
                helper.result()

    return team


def runtime() -> str:
    """The source of threads: ``"openmp"`` (torch's own runtime) or ``"python"`` (a pool of Python threads)."""
    if "team" not in _state:
        team = _openmp_team()
        _state["name"], _state["team"] = ("openmp", team) if team is not None else ("python", _python_team())
    return str(_state["name"])


def _after_fork() -> None:
    # The pool's threads do not exist in the child, which would wait for them for ever.
    _state["forked"] = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def launch(kernel: Kernel, tasks: int, *arguments: Tensor | int | float, alone: bool = False) -> None:
    """Run ``kernel`` until all of ``tasks`` are done.

    Args:
        kernel: a `gridreg.ops.cpu.jit.compiler.kernel`.
        tasks: how many; they start in order and run at the same time.
        arguments: contiguous CPU tensors of at most 3 axes, and numbers; the kernel reads them by position
            (`gridreg.ops.cpu.jit.compiler`). The kernel writes into tensors in place.
        alone: stay on this thread, as there is less to do than it takes to wake others.

    Raises:
        ValueError: for a tensor that is not contiguous or not on the CPU.
    """
    if tasks <= 0:
        return
    table = pack(tasks, arguments)
    address = ctypes.addressof(table)
    # Always the whole team: a smaller one would make the runtime end threads, and start them again later.
    threads = torch.get_num_threads()
    if alone or threads == 1 or tasks == 1 or _state["forked"]:
        _NATIVE(kernel.address)(address)
        return
    runtime()
    _state["team"](kernel.address, address, threads)


def pack(tasks: int, arguments: tuple[Tensor | int | float, ...]) -> Any:
    """The table that a kernel reads: next task, number of tasks, then four words for each argument."""
    # One call that packs, instead of one conversion for each word: this is on the way of every kernel.
    words: list[int | float] = [0, tasks]
    form = ["qq"]
    for place, value in enumerate(arguments):
        if isinstance(value, Tensor):
            shape = value.shape
            if not (value.is_contiguous() and value.is_cpu) or len(shape) > 3:
                raise ValueError(
                    f"argument {place}: found {value.device} tensor {tuple(value.shape)} with strides "
                    f"{value.stride()}, expected a contiguous CPU tensor of at most 3 axes"
                )
            words += (value.data_ptr(), *shape, *_ONES[len(shape)])
            form.append("qqqq")
        elif isinstance(value, float):
            words += (value, 0, 0, 0)
            form.append("dqqq")
        else:
            words += (int(value), 0, 0, 0)
            form.append("qqqq")
    return (ctypes.c_int64 * len(words)).from_buffer_copy(struct.pack("".join(form), *words))
