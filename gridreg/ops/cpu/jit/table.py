"""The arguments of a kernel, in memory: a table that `launch` fills and that kernels read through what is here.

Next task, number of tasks, then four words for each argument: address or number, and the lengths of three axes.
"""

from __future__ import annotations

import functools
from typing import Any, TypeAlias, TypeVar

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import extending, types
from numba.np import arrayobj
from numpy import float32 as float32
from numpy import float64 as float64
from numpy import int32 as int32
from numpy import int64 as int64
from numpy import uint8 as uint8
from numpy import uint16 as uint16

_T = TypeVar("_T", bound=np.generic)
# Tensors as kernels see them: all elements in one row, or two or three axes.
Vector: TypeAlias = np.ndarray[Any, np.dtype[_T]]
Matrix: TypeAlias = np.ndarray[Any, np.dtype[_T]]
Cube: TypeAlias = np.ndarray[Any, np.dtype[_T]]
Table: TypeAlias = Any
TABLE = types.CPointer(types.int64)  # type: ignore[no-untyped-call]
_WORD = ir.IntType(64)

# Untyped: a call from a kernel has fewer arguments than the function that generates it.
intrinsic: Any = extending.intrinsic


def _word(builder: Any, table: Any, place: Any, offset: int) -> Any:
    """Word ``offset`` of argument ``place``."""
    at = builder.add(builder.mul(place, _WORD(4)), _WORD(2 + offset))
    return builder.load(builder.gep(table, [at]))


def _place(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return context.cast(builder, arguments[1], signature.args[1], types.int64)


@intrinsic
def next_task(context: Any, table: Any) -> Any:
    """``next_task(table)``: number of a task that no other thread has, or -1 when all are taken."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        task = builder.atomic_rmw("add", arguments[0], _WORD(1), "monotonic")
        tasks = builder.load(builder.gep(arguments[0], [_WORD(1)]))
        return builder.select(builder.icmp_signed("<", task, tasks), task, _WORD(-1))

    return types.int64(TABLE), generate


@intrinsic
def size(context: Any, table: Any, place: Any, axis: Any) -> Any:
    """``size(table, place, axis)``: length of a tensor along an axis; 1 for an axis that it does not have."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        axis = context.cast(builder, arguments[2], signature.args[2], types.int64)
        at = builder.mul(_place(context, builder, signature, arguments), _WORD(4))
        return builder.load(builder.gep(arguments[0], [builder.add(builder.add(at, axis), _WORD(3))]))

    return types.int64(TABLE, place, axis), generate


@intrinsic
def integer(context: Any, table: Any, place: Any) -> Any:
    """``integer(table, place)``: an integer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _word(builder, arguments[0], _place(context, builder, signature, arguments), 0)

    return types.int64(TABLE, place), generate


@intrinsic
def real(context: Any, table: Any, place: Any) -> Any:
    """``real(table, place)``: a number, as float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = _word(builder, arguments[0], _place(context, builder, signature, arguments), 0)
        return builder.fptrunc(builder.bitcast(bits, ir.DoubleType()), ir.FloatType())

    return types.float32(TABLE, place), generate


def _wrap(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """An array of type ``kind`` around memory."""
    array = arrayobj.make_array(kind)(context, builder)  # type: ignore[no-untyped-call]
    itemsize = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides = [itemsize]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(length, strides[0]))
    data = builder.bitcast(data, array.data.type)
    arrayobj.populate_array(  # type: ignore[no-untyped-call]
        array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None
    )
    return array._getvalue()


def _tensor(axes: int, name: str, text: str) -> Any:
    def typed(context: Any, table: Any, place: Any, dtype: Any) -> Any:
        kind = types.Array(dtype.dtype, axes, "C")

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            place = _place(context, builder, signature, arguments)
            data = builder.inttoptr(_word(builder, arguments[0], place, 0), ir.IntType(8).as_pointer())
            lengths = [_word(builder, arguments[0], place, 1 + axis) for axis in range(3)]
            # What a tensor has in more axes than asked for belongs to the last.
            shape = [*lengths[: axes - 1], functools.reduce(builder.mul, lengths[axes - 1 :])]
            return _wrap(context, builder, kind, data, shape)

        return kind(TABLE, place, dtype), generate

    typed.__name__, typed.__doc__ = name, text
    return intrinsic(typed)


vector = _tensor(1, "vector", "``vector(table, place, dtype)``: a tensor as ``(N,)``, all of its elements.")
matrix = _tensor(2, "matrix", "``matrix(table, place, dtype)``: a tensor of two axes.")
cube = _tensor(3, "cube", "``cube(table, place, dtype)``: a tensor of three axes.")


@intrinsic(prefer_literal=True)
def scratch(context: Any, length: Any, dtype: Any) -> Any:
    """``scratch(length, dtype)``: memory of a constant length on the stack; only for the function that asks for it."""
    if not isinstance(length, types.IntegerLiteral):
        return None
    kind = types.Array(dtype.dtype, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        count = signature.args[0].literal_value
        block = ir.ArrayType(context.get_data_type(kind.dtype), count)
        # numba's own `alloca_once` also writes zeros, element by element: code of the length of the memory.
        with builder.goto_entry_block():
            memory = builder.alloca(block)
        return _wrap(context, builder, kind, memory, [context.get_constant(types.intp, count)])

    return kind(length, dtype), generate
