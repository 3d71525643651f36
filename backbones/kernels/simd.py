"""Vectors of float32 channels for kernels.

A loop over a channel count known only at run time is compiled to scalar code for short rows, and LLVM cannot prove that
the gradient rows that a kernel updates do not overlap. So the channel loops say themselves what a vector is: `WIDE` and
`ONE` are samples of the two types of a channel step, eight float32 or a single one, and ``load(x, i, like)`` gives what
``like`` is. Written once, a loop body serves the blocks of eight and the rest::

    for c in range(0, blocks, 8): body(c, wide())
    for c in range(blocks, channels): body(c, one())

``+``, ``-`` and ``*`` work on eight lanes at once, also with a float32 on either side, and contract to fused
multiply-adds. LLVM maps eight lanes to whatever the processor has (one AVX register, two NEON ones, ...).
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import models, overload, register_model

from backbones.kernels.compiler import inline, intrinsic

__all__ = ["LANES", "add_to", "load", "one", "prefetch", "store", "total", "wide"]

LANES = 8
_FLAGS = ("contract", "nsz", "arcp", "reassoc")
_LLVM = ir.VectorType(ir.FloatType(), LANES)


class _Lanes(types.Type):
    """Eight float32."""

    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


_lanes = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LLVM)  # type: ignore[no-untyped-call]


def _element(context: Any, builder: Any, signature: Any, arguments: Any, pointee: Any) -> Any:
    """Pointer to element ``arguments[1]`` of the contiguous 1-D array ``arguments[0]``."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.bitcast(builder.gep(array.data, [arguments[1]]), pointee.as_pointer())


def _width(like: Any) -> Any:
    return _LLVM if isinstance(like, _Lanes) else ir.FloatType()


@intrinsic
def _load(context: Any, array: Any, index: Any, like: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_element(context, builder, signature, arguments, _width(like)), align=4)

    return like(array, types.int64, like), generate


@intrinsic
def _store(context: Any, array: Any, index: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _element(context, builder, signature, arguments, _width(value))
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, value), generate


@intrinsic
def prefetch(context: Any, array: Any, index: Any) -> Any:
    """``prefetch(x, i)``: ask for the cache line of element ``i`` of the 1-D array ``x``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _element(context, builder, signature, arguments, ir.IntType(8))
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, word, word, word])
        function = builder.module.declare_intrinsic("llvm.prefetch", (pointer.type,), kind)
        builder.call(function, [pointer, word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def _splat(context: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)
        first = builder.insert_element(ir.Constant(_LLVM, ir.Undefined), arguments[0], word(0))
        mask = ir.Constant(ir.VectorType(word, LANES), [0] * LANES)
        return builder.shuffle_vector(first, ir.Constant(_LLVM, ir.Undefined), mask)

    return _lanes(types.float32), generate


@intrinsic
def _sum_lanes(context: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)
        rest, width = arguments[0], LANES
        while width > 1:
            width //= 2
            halves = [
                builder.shuffle_vector(
                    rest,
                    ir.Constant(rest.type, ir.Undefined),
                    ir.Constant(ir.VectorType(word, width), list(range(start, start + width))),
                )
                for start in (0, width)
            ]
            rest = builder.fadd(*halves, flags=_FLAGS)
        return builder.extract_element(rest, word(0))

    return types.float32(_lanes), generate


def _binary(name: str) -> Any:
    def typed(context: Any, left: Any, right: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, name)(*arguments, flags=_FLAGS)

        return _lanes(_lanes, _lanes), generate

    return intrinsic(typed)


def _overload_operator(symbol: Callable[[Any, Any], Any], name: str) -> None:
    apply = _binary(name)

    @overload(symbol)  # type: ignore[untyped-decorator]
    def choose(left, right):  # type: ignore[no-untyped-def]
        if isinstance(left, _Lanes) and isinstance(right, _Lanes):
            return lambda left, right: apply(left, right)
        if isinstance(left, _Lanes) and right == types.float32:
            return lambda left, right: apply(left, _splat(right))
        if left == types.float32 and isinstance(right, _Lanes):
            return lambda left, right: apply(_splat(left), right)
        return None


_overload_operator(operator.add, "fadd")
_overload_operator(operator.sub, "fsub")
_overload_operator(operator.mul, "fmul")


@inline
def wide() -> Any:
    """Eight zeros."""
    return _splat(types.float32(0))


@inline
def one() -> Any:
    """A single zero."""
    return types.float32(0)


@inline
def load(x: Any, i: Any, like: Any) -> Any:
    """Elements from ``i`` on of the 1-D array ``x``, as many as ``like`` has."""
    return _load(x, i, like)


@inline
def store(x: Any, i: Any, value: Any) -> Any:
    """Write ``value`` to the elements from ``i`` on of the 1-D array ``x``."""
    _store(x, i, value)


@inline
def add_to(x: Any, i: Any, value: Any) -> Any:
    """Add ``value`` to the elements from ``i`` on of the 1-D array ``x``."""
    _store(x, i, _load(x, i, value) + value)


def total(value: Any) -> Any:
    """Sum of the lanes, in kernels."""
    return value


@overload(total)  # type: ignore[untyped-decorator]
def _total(value):  # type: ignore[no-untyped-def]
    if isinstance(value, _Lanes):
        return lambda value: _sum_lanes(value)
    return lambda value: value
