"""bfloat16 in memory, float32 in registers, for kernels: arrays are uint16, the upper halves of float32."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types

from gridreg.ops.cpu.jit.compiler import intrinsic

__all__ = ["get", "load_low", "put", "rounded", "store_low"]


def _kinds(lanes: Any) -> tuple[Any, Any, Any]:
    """float32, int32 and int16 as wide as ``lanes``, the type that a kernel computes with."""
    count = lanes.count if isinstance(lanes, ir.VectorType) else 0
    kinds = (ir.FloatType(), ir.IntType(32), ir.IntType(16))
    if count:
        return tuple(ir.VectorType(kind, count) for kind in kinds)  # type: ignore[return-value]
    return kinds


def _constant(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * kind.count if isinstance(kind, ir.VectorType) else value)


def _pointer(context: Any, builder: Any, signature: Any, arguments: Any, pointee: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    index = context.cast(builder, arguments[1], signature.args[1], types.int64)
    return builder.bitcast(builder.gep(array.data, [index]), pointee.as_pointer())


def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    real, word, half = _kinds(context.get_value_type(signature.args[2]))
    bits = builder.load(_pointer(context, builder, signature, arguments, half), align=2)
    return builder.bitcast(builder.shl(builder.zext(bits, word), _constant(word, 16)), real)


def rounded(builder: Any, value: Any) -> Any:
    """Bits of float32 rounded to the nearest bfloat16, ties to even; NaN stays NaN."""
    _, word, half = _kinds(value.type)
    bits = builder.bitcast(value, word)
    upper = builder.lshr(bits, _constant(word, 16))
    even = builder.and_(upper, _constant(word, 1))
    nearest = builder.lshr(builder.add(bits, builder.add(even, _constant(word, 0x7FFF))), _constant(word, 16))
    # Rounding would carry the payload of a NaN over into infinity or zero.
    hidden = builder.fcmp_unordered("uno", value, value)
    return builder.trunc(builder.select(hidden, builder.or_(upper, _constant(word, 0x40)), nearest), half)


def _store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    found = rounded(builder, arguments[2])
    builder.store(found, _pointer(context, builder, signature, arguments, found.type), align=2)
    return context.get_dummy_value()


@intrinsic
def load_low(context: Any, array: Any, index: Any, like: Any) -> Any:
    """``load_low(x, i, like)``: bfloat16 elements from ``i`` on as float32, as many as ``like`` has."""
    return like(array, index, like), _load


@intrinsic
def store_low(context: Any, array: Any, index: Any, value: Any) -> Any:
    """``store_low(x, i, value)``: float32 rounded to the nearest bfloat16, ties to even; NaN stays NaN."""
    return types.void(array, index, value), _store


@intrinsic
def get(context: Any, array: Any, index: Any, like: Any) -> Any:
    """``get(x, i, like)``: elements of an array of float32 or, if it is one of uint16, of bfloat16."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        real = context.get_value_type(signature.args[2])
        return builder.load(_pointer(context, builder, signature, arguments, real), align=4)

    return like(array, index, like), _load if array.dtype == types.uint16 else generate


@intrinsic
def put(context: Any, array: Any, index: Any, value: Any) -> Any:
    """``put(x, i, value)``: write elements of an array of float32 or, if it is one of uint16, of bfloat16."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _pointer(context, builder, signature, arguments, arguments[2].type)
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, index, value), _store if array.dtype == types.uint16 else generate
