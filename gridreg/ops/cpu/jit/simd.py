"""Vectors of float32 channels for kernels, in memory float32 or bfloat16.

A loop over a channel count known only at run time is compiled to scalar code for short rows, and LLVM cannot prove
that the gradient rows that a kernel updates do not overlap. So the channel loops say themselves what a vector is:
`vector_zero` and `scalar_zero` give samples of the two types of a channel step, eight float32 or a single one, and
``load(x, i, dtype_like)`` gives what ``dtype_like`` is. Written once, a loop body serves the blocks of eight and the
rest::

    for c in range(0, blocks, LANES): body(c, vector_zero())
    for c in range(blocks, channels): body(c, scalar_zero())

``+``, ``-`` and ``*`` work on eight lanes at once, also with a float32 on either side, and contract to fused
multiply-adds. LLVM maps eight lanes to whatever the processor has (one AVX register, two NEON ones, ...). An array of
uint16 holds bfloat16, the upper halves of float32: they are widened and rounded on the way.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

from gridreg.ops.cpu.jit.table import intrinsic

LANES = 8
_FLAGS = ("contract", "nsz", "arcp", "reassoc")
_LLVM = ir.VectorType(ir.FloatType(), LANES)
_INDEX = ir.IntType(32)


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
    """Pointer to element ``arguments[1]``, in the order of memory, of the contiguous array ``arguments[0]``."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    index = context.cast(builder, arguments[1], signature.args[1], types.int64)
    return builder.bitcast(builder.gep(array.data, [index]), pointee.as_pointer())


def _splat(builder: Any, value: Any) -> Any:
    """``value`` in every lane."""
    undefined = ir.Constant(_LLVM, ir.Undefined)
    mask = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.shuffle_vector(builder.insert_element(undefined, value, _INDEX(0)), undefined, mask)


def _integers(kind: Any) -> tuple[Any, Any]:
    """int32 and int16 with as many lanes as a type of float32."""
    word, half = ir.IntType(32), ir.IntType(16)
    if isinstance(kind, ir.VectorType):
        return ir.VectorType(word, kind.count), ir.VectorType(half, kind.count)
    return word, half


def _constant(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * kind.count if isinstance(kind, ir.VectorType) else value)


def bf16_bits(builder: Any, value: Any) -> Any:
    """Write instructions: bits of float32 rounded to the nearest bfloat16, ties to even; NaN stays NaN."""
    word, half = _integers(value.type)
    bits = builder.bitcast(value, word)
    upper = builder.lshr(bits, _constant(word, 16))
    even = builder.and_(upper, _constant(word, 1))
    nearest = builder.lshr(builder.add(bits, builder.add(even, _constant(word, 0x7FFF))), _constant(word, 16))
    # Rounding would carry the payload of a NaN over into infinity or zero.
    hidden = builder.fcmp_unordered("uno", value, value)
    return builder.trunc(builder.select(hidden, builder.or_(upper, _constant(word, 0x40)), nearest), half)


@intrinsic
def load(context: Any, array: Any, index: Any, dtype_like: Any) -> Any:
    """``load(x, i, dtype_like)``: elements from ``i`` on as float32, as many as ``dtype_like`` has."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        real = _LLVM if isinstance(dtype_like, _Lanes) else ir.FloatType()
        if array.dtype != types.uint16:
            return builder.load(_element(context, builder, signature, arguments, real), align=4)
        word, half = _integers(real)
        bits = builder.load(_element(context, builder, signature, arguments, half), align=2)
        return builder.bitcast(builder.shl(builder.zext(bits, word), _constant(word, 16)), real)

    return dtype_like(array, index, dtype_like), generate


@intrinsic
def store(context: Any, array: Any, index: Any, value: Any) -> Any:
    """``store(x, i, value)``: write float32 to the elements from ``i`` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        low = array.dtype == types.uint16
        found = bf16_bits(builder, arguments[2]) if low else arguments[2]
        builder.store(
            found, _element(context, builder, signature, arguments, found.type), align=2 if low else 4
        )
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@intrinsic
def prefetch(context: Any, array: Any, index: Any) -> Any:
    """``prefetch(x, i)``: ask for the cache line of element ``i``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _element(context, builder, signature, arguments, ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INDEX, _INDEX, _INDEX])
        function = builder.module.declare_intrinsic("llvm.prefetch", (pointer.type,), kind)
        builder.call(function, [pointer, _INDEX(0), _INDEX(3), _INDEX(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate


@intrinsic
def vector_zero(context: Any) -> Any:
    """``vector_zero()``: eight zeros."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(_LLVM, [0.0] * LANES)

    return _lanes(), generate


@intrinsic
def scalar_zero(context: Any) -> Any:
    """``scalar_zero()``: a single zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(ir.FloatType(), 0.0)

    return types.float32(), generate


@intrinsic
def total(context: Any, value: Any) -> Any:
    """``total(value)``: sum of the lanes, in pairs; a float32 itself."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rest, width = arguments[0], LANES
        if not isinstance(value, _Lanes):
            return rest
        while width > 1:
            width //= 2
            undefined = ir.Constant(rest.type, ir.Undefined)
            masks = (list(range(start, start + width)) for start in (0, width))
            kind = ir.VectorType(_INDEX, width)
            halves = [builder.shuffle_vector(rest, undefined, ir.Constant(kind, mask)) for mask in masks]
            rest = builder.fadd(*halves, flags=_FLAGS)
        return builder.extract_element(rest, _INDEX(0))

    return types.float32(value), generate


def _define(symbol: Any, instruction: str) -> None:
    """Give an operator a meaning for vectors, and for a vector and a float32."""

    @infer_global(symbol)  # type: ignore[no-untyped-call]
    class _Typed(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            vectors = [isinstance(kind, _Lanes) for kind in args]
            if any(vectors) and all(
                v or kind == types.float32 for v, kind in zip(vectors, args, strict=True)
            ):
                return signature(_lanes, *args)  # type: ignore[no-untyped-call]
            return None

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        operands = [
            value if isinstance(kind, _Lanes) else _splat(builder, value)
            for kind, value in zip(sig.args, arguments, strict=True)
        ]
        return getattr(builder, instruction)(*operands, flags=_FLAGS)

    for kinds in ((_Lanes, _Lanes), (_Lanes, types.Float), (types.Float, _Lanes)):
        lower_builtin(symbol, *kinds)(generate)  # type: ignore[no-untyped-call]


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
