"""How kernels are compiled, and how they read their arguments.

A kernel is a function of one argument, the table that `backbones.kernels.threading.launch` fills. It begins by naming
its arguments by their position and then serves tasks until there are none::

    @kernel
    def _scale(table):
        x = vector(table, 0, float32)
        factor = real(table, 1)
        while True:
            task = next_task(table)
            if task < 0:
                break
            ...

Kernels are compiled on their first use and cached on disk. Functions that they call are marked with `inline`.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import carray, cfunc, extending, njit, types  # type: ignore[attr-defined]
from numba.core.errors import NumbaWarning

__all__ = [
    "Kernel",
    "cube",
    "exact",
    "float32",
    "inline",
    "int32",
    "int64",
    "integer",
    "intrinsic",
    "kernel",
    "matrix",
    "next_task",
    "real",
    "size",
    "uint8",
    "vector",
]

float32, int32, int64, uint8 = np.float32, np.int32, np.int64, np.uint8

# Reordering and contraction make sums fast; not-a-number and infinity keep their meaning, as a run must see them.
_FAST = {"contract", "nsz", "arcp", "reassoc"}
_TABLE = types.CPointer(types.int64)  # type: ignore[no-untyped-call]
_COMPILING = threading.Lock()

# Untyped: a call from a kernel has fewer arguments than the function that generates it.
intrinsic: Any = extending.intrinsic


class Kernel:
    """A compiled kernel; use it as a decorator, `kernel`.

    Args:
        function: takes the table, returns nothing.
    """

    def __init__(self, function: Callable[[Any], None]) -> None:
        self.function = function
        self.__doc__ = function.__doc__
        self._compiled: Any = None

    @property
    def address(self) -> int:
        """Address of the C function ``void (*)(int64_t *)``; compiles, or reads the cache, the first time."""
        if self._compiled is None:
            with _COMPILING:
                if self._compiled is None:
                    self._compiled = self._compile()
        return int(self._compiled.address)

    def _compile(self) -> Any:
        signature = types.void(_TABLE)
        options: dict[str, Any] = {"nopython": True, "fastmath": _FAST, "error_model": "numpy"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumbaWarning)
            try:
                return cfunc(signature, cache=True, **options)(self.function)
            except (RuntimeError, OSError):
                # No folder to keep a cache in: neither beside the source nor in the user's.
                return cfunc(signature, cache=False, **options)(self.function)


kernel = Kernel


def inline(function: Callable[..., Any]) -> Any:
    """Mark a function that kernels call: compiled with them, fast arithmetic, no checks of bounds."""
    return njit(nogil=True, fastmath=_FAST, error_model="numpy", boundscheck=False)(function)


def exact(function: Callable[..., Any]) -> Any:
    """Like `inline`, with every operation rounded on its own, in the order written."""
    return njit(nogil=True, fastmath=False, error_model="numpy", boundscheck=False)(function)


@intrinsic
def _fetch_add(context: Any, pointer: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.atomic_rmw("add", arguments[0], arguments[1], "monotonic")

    return types.int64(_TABLE, types.int64), generate


@intrinsic
def _pointer(context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


@intrinsic
def _as_double(context: Any, bits: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


@inline
def next_task(table: Any) -> Any:
    """Number of a task that no other thread has, or -1 when all are taken."""
    task = _fetch_add(table, 1)
    return task if task < table[1] else -1


@inline
def vector(table: Any, place: Any, dtype: Any) -> Any:
    """Argument ``place``, a tensor, as ``(N,)``: all of its elements."""
    base = 2 + 4 * place
    return carray(_pointer(table[base]), (table[base + 1] * table[base + 2] * table[base + 3],), dtype)


@inline
def matrix(table: Any, place: Any, dtype: Any) -> Any:
    """Argument ``place``, a tensor of two axes."""
    base = 2 + 4 * place
    return carray(_pointer(table[base]), (table[base + 1], table[base + 2]), dtype)


@inline
def cube(table: Any, place: Any, dtype: Any) -> Any:
    """Argument ``place``, a tensor of three axes."""
    base = 2 + 4 * place
    return carray(_pointer(table[base]), (table[base + 1], table[base + 2], table[base + 3]), dtype)


@inline
def integer(table: Any, place: Any) -> Any:
    """Argument ``place``, an integer."""
    return table[2 + 4 * place]


@inline
def real(table: Any, place: Any) -> Any:
    """Argument ``place``, a number, as float32."""
    return np.float32(_as_double(table[2 + 4 * place]))


@inline
def size(table: Any, place: Any, axis: Any) -> Any:
    """Length of argument ``place``, a tensor, along ``axis``; 1 for an axis that it does not have."""
    return table[3 + 4 * place + axis]
