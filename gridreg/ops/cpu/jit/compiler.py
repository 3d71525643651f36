"""Compilation of kernels, and of the functions that they call.

A kernel is a function of a task's number and of typed arguments::

    @kernel
    def _scale(task: int, x: Vector[float32], factor: float32) -> None:
        for n in range(task * 64, min((task + 1) * 64, x.shape[0])):
            x[n] *= factor

`gridreg.ops.cpu.jit.launch.launch` gives it the arguments in this order, by a table in memory; any number of threads
serve tasks until there are none. A last argument annotated `Table` is that table itself, for a kernel whose number of
arguments varies; it reads further arguments by their position, with `vector` and its like.

Kernels are compiled on their first use and cached on disk. Functions that they call are decorated with `inline`. What
reads the table is written into the kernel's own source, and generated: each function that numba has to compile costs
the first run some hundredths of a second, and a slice or a new array in a kernel costs several.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import gc
import inspect
import textwrap
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba import cfunc, njit, types
from numba.core.caching import FunctionCache
from numba.core.errors import NumbaWarning

from gridreg.ops.compilation import compiling, timed
from gridreg.ops.cpu.jit.cache import can_lock, discard_damaged, forget_outdated, one_process
from gridreg.ops.cpu.jit.table import TABLE, cube, integer, matrix, next_task, real, vector

# Reordering and contraction make sums fast; not-a-number and infinity keep their meaning, as a run must see them.
_FAST = {"contract", "nsz", "arcp", "reassoc"}
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "boundscheck": False}
# Only kernels are called from outside.
_HELPER: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_COMPILING = threading.Lock()
# The package whose kernels a second process knows.
_OPERATIONS = "gridreg.ops."


class Kernel:
    """A compiled kernel; use it as a decorator, `kernel`.

    Args:
        function: takes a task's number and typed arguments, returns nothing.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function
        self.__doc__ = function.__doc__
        self._compiled: Any = None

    @property
    def address(self) -> int:
        """Address of the C function ``void (*)(int64_t *)``; compiles, or reads the cache, the first time."""
        if self._compiled is None:
            with _COMPILING:
                if self._compiled is None:
                    with timed():
                        self._compiled = self._compile()
        return int(self._compiled.address)

    @property
    def name(self) -> str:
        """Module and function, as its files in the cache begin."""
        return f"{self.function.__module__.rpartition('.')[2]}.{self.function.__name__}"

    @property
    def _folder(self) -> str:
        """The cache's folder, which need not exist."""
        cache = FunctionCache(self.function)  # type: ignore[no-untyped-call]
        return str(cache.cache_path)

    @property
    def cached(self) -> bool:
        """Whether a process has compiled the kernel, or is at it."""
        folder = self._folder
        with one_process(folder, "gridreg-kernels"):
            forget_outdated(folder)
        return (Path(folder) / f"{self.name}.lock").exists()

    def _compile(self) -> Any:
        compiled: Any = functools.partial(cfunc, types.void(TABLE), fastmath=_FAST, **_OPTIONS)
        serving = _serving(self.function)
        with _no_collection(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NumbaWarning)
            try:
                folder = self._folder
                with one_process(folder, "gridreg-kernels"):
                    empty = forget_outdated(folder)
                if empty and can_lock() and self.function.__module__.startswith(_OPERATIONS):
                    _precompile()
                ready = any(Path(folder).glob(f"{self.name}-*.nbi"))
                with contextlib.nullcontext() if ready else compiling(), one_process(folder, self.name):
                    try:
                        return compiled(cache=True)(serving)
                    except Exception:
                        # Whatever reading a damaged file raises; a fault of the kernel's own is raised once more.
                        if not discard_damaged(folder, self.name):
                            raise
                        return compiled(cache=True)(serving)
            except (RuntimeError, OSError):
                # No folder to keep a cache in: neither beside the source nor in the user's.
                return compiled(cache=False)(serving)


kernel = Kernel


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Leave what numba allocates to later: looking for cycles in it takes a quarter of the time of compiling."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _reading(annotation: str, place: int) -> str:
    """Source that reads the argument at ``place`` of the table."""
    kind, _, rest = annotation.partition("[")
    if kind == "Table":
        return "_table"
    if rest:
        return f"_{kind.lower()}(_table, {place}, {rest[:-1]})"
    return f"_integer(_table, {place})" if kind.startswith("int") else f"_real(_table, {place})"


def _serving(function: Callable[..., None]) -> Callable[[Any], None]:
    """The function of one table that reads the arguments of a kernel and runs it for one task after another.

    The kernel's own source between a few lines in front, under the same file and line numbers, by which numba caches.
    """
    lines, first = inspect.getsourcelines(function)
    tree = ast.parse(textwrap.dedent("".join(lines)))
    ast.increment_lineno(tree, first - 1)
    (definition,) = tree.body
    assert isinstance(definition, ast.FunctionDef)
    task, *arguments = definition.args.args
    if task.arg == "table":
        return function
    reads = [
        f"    {argument.arg} = {_reading(ast.unparse(argument.annotation or ast.Name('Table')), place)}\n"
        for place, argument in enumerate(arguments)
    ]
    frame = ast.parse(
        f"def {definition.name}(_table):\n{''.join(reads)}    while True:\n        {task.arg} = _next_task(_table)\n"
        f"        if {task.arg} < 0:\n            break\n"
    )
    for node in ast.walk(frame):
        if isinstance(node, ast.stmt | ast.expr | ast.arg):
            node.lineno = node.end_lineno = definition.lineno
    (outer,) = frame.body
    assert isinstance(outer, ast.FunctionDef)
    assert isinstance(outer.body[-1], ast.While)
    outer.body[-1].body += definition.body[1:] if ast.get_docstring(definition) else definition.body
    readers = (next_task, vector, matrix, cube, integer, real)
    namespace = function.__globals__ | {f"_{reader.__name__}": reader for reader in readers}
    exec(compile(frame, function.__code__.co_filename, "exec"), namespace)
    return namespace[definition.name]  # type: ignore[no-any-return]


@functools.cache
def _precompile() -> None:
    # Here, as that module uses this one.
    from gridreg.ops.cpu.jit import precompile

    precompile.start()


def inline(function: Callable[..., Any]) -> Any:
    """Mark a function that kernels call: compiled with them, fast arithmetic, no checks of bounds."""
    return njit(fastmath=_FAST, **_HELPER)(function)


def exact(function: Callable[..., Any]) -> Any:
    """Like `inline`, with every operation rounded on its own, in the order written."""
    return njit(fastmath=False, **_HELPER)(function)
