"""What blocks of matrix products have in common whose results stay in registers: their sizes, and the loop."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import binding, ir  # type: ignore[import-untyped]
from numba import config

__all__ = [
    "INDEX",
    "LONG",
    "REALS",
    "ROWS",
    "SUMMED",
    "TASKS",
    "WIDEST",
    "ahead",
    "everywhere",
    "has",
    "places_of",
    "relu",
    "summed",
]

WIDEST = 512
"""Columns of the widest matrix."""

# Rows whose factors stay in the nearest caches, for products and for sums over rows.
ROWS = 32
SUMMED = 64
# Tasks that share the rows of a sum.
TASKS = 16

LONG = 16
"""Columns of a vector of results."""
INDEX = ir.IntType(64)
REALS = ir.VectorType(ir.FloatType(), LONG)
_WORD = ir.IntType(32)


@functools.cache
def has(feature: str) -> bool:
    """Whether numba compiles for this processor, and it has a feature, as LLVM calls it."""
    name, features = config.CPU_NAME, config.CPU_FEATURES  # type: ignore[attr-defined]
    if name not in (None, "host") or features is not None:
        return False
    try:
        return bool(binding.get_host_cpu_features().get(feature, False))
    except RuntimeError:
        return False


def ahead(builder: Any, pointer: Any, index: Any, like: Any = REALS) -> Any:
    """Pointer to a vector of type ``like`` that begins at an element."""
    return builder.bitcast(builder.gep(pointer, [index]), like.as_pointer())


def everywhere(builder: Any, value: Any) -> Any:
    """A vector of ``value`` in all of `LONG` lanes."""
    kind = ir.VectorType(value.type, LONG)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, _WORD(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_WORD, LONG), [0] * LONG))


def places_of(builder: Any, to: Any, row: Any, high: int, vectors: int) -> list[Any]:
    """Where the vectors of a block begin: of each of ``high`` rows, ``row`` elements apart, all ``vectors``."""
    return [
        builder.add(builder.add(to, builder.mul(row, INDEX(r))), INDEX(LONG * v))
        for r in range(high)
        for v in range(vectors)
    ]


def summed(
    builder: Any, before: Sequence[Any], count: Any, grow: Callable[[Any, Sequence[Any]], Sequence[Any]]
) -> list[Any]:
    """A loop that lets sums grow ``count`` times; the builder stands behind it then.

    Args:
        builder: where it begins.
        before: the sums at first.
        count: int64.
        grow: the number of a turn and the sums to the sums after it.
    """
    entry = builder.block
    head, body, end = (builder.append_basic_block(name) for name in ("turns", "turn", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    number = builder.phi(INDEX)
    number.add_incoming(INDEX(0), entry)
    sums = []
    for value in before:
        sums.append(builder.phi(REALS))
        sums[-1].add_incoming(value, entry)
    builder.cbranch(builder.icmp_signed("<", number, count), body, end)
    builder.position_at_end(body)
    grown = grow(number, sums)
    number.add_incoming(builder.add(number, INDEX(1)), body)
    for value, larger in zip(sums, grown, strict=True):
        value.add_incoming(larger, body)
    builder.branch(head)
    builder.position_at_end(end)
    return sums


def relu(builder: Any, value: Any) -> Any:
    """Not-a-number stays."""
    nothing = ir.Constant(REALS, [0.0] * LONG)
    return builder.select(builder.fcmp_ordered("<=", value, nothing), nothing, value)
