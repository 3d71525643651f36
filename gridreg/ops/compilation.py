"""Compiling of kernels as seen from outside: the time it has taken, and word of it to whoever waits.

Kernels are compiled where they are first used, in the midst of setting up or of an iteration. Clocks that are to show
the work alone subtract `compile_seconds`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_spent = 0.0
_stood = 0.0
_read = 0
_tell: Callable[[int | None], None] | None = None


def compile_seconds() -> float:
    """Seconds that this process has spent on compiling kernels, or on reading them from the cache."""
    return _spent


def work_clock() -> float:
    """Seconds of a clock that stands still while kernels are compiled, and in `clock_stopped`.

    Example:
        >>> work_clock() <= work_clock()
        True
    """
    return time.perf_counter() - _spent - _stood


@contextmanager
def clock_stopped() -> Iterator[None]:
    """A block, such as a pause that somebody asked for, in which `work_clock` stands still."""
    global _stood
    began = time.perf_counter()
    try:
        yield
    finally:
        _stood += time.perf_counter() - began


@contextmanager
def telling_compilation(tell: Callable[[int | None], None]) -> Iterator[None]:
    """A block in which ``tell`` is called before a kernel is compiled and after it.

    Args:
        tell: takes the number of kernels that were ready before, and None when the kernel is done. What the cache
            holds is read without a word. Inside of another such block nobody else is told.
    """
    global _tell
    before, _tell = _tell, _tell or tell
    try:
        yield
    finally:
        _tell = before


@contextmanager
def timed() -> Iterator[None]:
    """A block that makes one kernel ready."""
    global _spent, _read
    began = time.perf_counter()
    try:
        yield
    finally:
        _spent += time.perf_counter() - began
        _read += 1


@contextmanager
def compiling() -> Iterator[None]:
    """A block that compiles a kernel, or waits for another process that does."""
    if _tell is not None:
        _tell(_read)
    try:
        yield
    finally:
        if _tell is not None:
            _tell(None)
