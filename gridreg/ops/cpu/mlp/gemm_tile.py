"""Register tiles: LLVM IR for a block of a matrix product that stays in registers while it is summed up.

A tile has some rows and 16 or 32 columns; how many follows from the registers that the processor has. Each
step of its sum takes one number of every row, in float32, or a pair of numbers, in bfloat16, whose products
are summed in float32: by one instruction where the processor has it (AVX-512 BF16), else by two
multiply-adds; or in the processor's matrix unit (`gridreg.ops.cpu.mlp.gemm_amx`). At its end stands an
epilogue: what a layer does with the sum before it is written.

It is generated because numba's own loops do not keep a block of results in registers: they take several times
as long.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

from llvmlite import binding, ir  # type: ignore[import-untyped]
from numba import config, types
from numba.core import cgutils

from gridreg.ops.cpu.jit.simd import bf16_bits
from gridreg.ops.cpu.jit.table import intrinsic
from gridreg.ops.cpu.mlp import gemm_amx

COLUMNS = 16
"""Columns of a vector of results."""

Epilogue: TypeAlias = Literal["accumulate", "bias", "relu", "relu_mask"]
"""Add to the output; add one number a column; that and a ReLU; 0 where the argument is not positive."""

_INDEX, _WORD, _HALF = ir.IntType(64), ir.IntType(32), ir.IntType(16)
_FLOATS, _WORDS = ir.VectorType(ir.FloatType(), COLUMNS), ir.VectorType(_WORD, COLUMNS)
_HALVES = ir.VectorType(_HALF, COLUMNS)
_ZERO = ir.Constant(_FLOATS, [0.0] * COLUMNS)
_FLAGS = ("contract", "nsz")


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


class _BFloat(ir.types.Type):  # type: ignore[misc]
    """LLVM's bfloat, which llvmlite has no name for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


class Arithmetic(NamedTuple):
    """Arithmetic of a tile.

    Args:
        word: LLVM type of what a row gives to a step.
        per_word: numbers in it.
        rows: of a tile.
        wide: vectors of 16 columns for which there are registers.
        operand: a vector of words to what `multiply_add` takes.
        multiply_add: a sum and two operands to the sum after the step.
        matrix_unit: whether `gridreg.ops.cpu.mlp.gemm_amx` sums up, instead of these two.
    """

    word: Any
    per_word: int
    rows: int
    wide: int
    operand: Callable[[Any, Any], Any]
    multiply_add: Callable[[Any, Any, Any, Any], Any]
    matrix_unit: bool = False


def _float_step(builder: Any, total: Any, left: Any, right: Any) -> Any:
    return builder.fadd(total, builder.fmul(left, right, flags=_FLAGS), flags=_FLAGS)


def _native_pairs(builder: Any, words: Any) -> Any:
    return builder.bitcast(words, ir.VectorType(_BFloat(), 2 * COLUMNS))


def _native_step(builder: Any, total: Any, left: Any, right: Any) -> Any:
    kind = ir.FunctionType(_FLOATS, [_FLOATS, left.type, right.type])
    name = "llvm.x86.avx512bf16.dpbf16ps.512"
    dot = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
    return builder.call(dot, [total, left, right])


def _portable_pairs(builder: Any, words: Any) -> tuple[Any, Any]:
    """Both numbers of each word as float32."""
    first = builder.shl(words, ir.Constant(_WORDS, [16] * COLUMNS))
    second = builder.and_(words, ir.Constant(_WORDS, [0xFFFF0000] * COLUMNS))
    return builder.bitcast(first, _FLOATS), builder.bitcast(second, _FLOATS)


def _portable_step(builder: Any, total: Any, left: Any, right: Any) -> Any:
    # The instruction's order: the second number first.
    return _float_step(builder, _float_step(builder, total, left[1], right[1]), left[0], right[0])


_NATIVE = has("avx512bf16")
# 16 registers of results of 32 (AVX-512), or 8 of 16.
_ROWS, _WIDE = (8, 2) if has("avx512f") else (4, 1)
_MATRIX_UNIT = _NATIVE and has("amx-bf16") and gemm_amx.allowed()

F32 = Arithmetic(ir.FloatType(), 1, _ROWS, _WIDE, lambda builder, words: words, _float_step)
BF16 = (
    Arithmetic(_WORD, 2, gemm_amx.EDGE, 4, _native_pairs, _native_step, True)
    if _MATRIX_UNIT
    else Arithmetic(_WORD, 2, 8, 2, _native_pairs, _native_step)
    if _NATIVE
    else Arithmetic(_WORD, 2, _ROWS, _WIDE, _portable_pairs, _portable_step)
)


def element(builder: Any, pointer: Any, index: Any, like: Any = _FLOATS) -> Any:
    """Pointer to a vector of type ``like`` that begins at an element."""
    return builder.bitcast(builder.gep(pointer, [index]), like.as_pointer())


def round_lanes(builder: Any, value: Any) -> Any:
    """Float32 rounded to bfloat16; by the processor's instruction, if it has it, which flushes subnormals."""
    if not _NATIVE:
        return bf16_bits(builder, value)
    lanes = value.type.count
    kind = ir.FunctionType(ir.VectorType(_BFloat(), lanes), [value.type])
    name = f"llvm.x86.avx512bf16.cvtneps2bf16.{32 * lanes}"
    convert = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
    return builder.call(convert, [value])


def _broadcast(builder: Any, value: Any) -> Any:
    """A vector of ``value`` in all lanes."""
    kind = ir.VectorType(value.type, COLUMNS)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, _WORD(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_WORDS, [0] * COLUMNS))


class TileArguments(NamedTuple):
    """Arguments of a tile. Starts and distances of left and right count in words; those of the output in
    elements.

    Args:
        left, left_start, left_row, left_step: array; its word of the first row and step; distance of rows, of
            steps.
        right, right_start, right_step, right_panel: array; its first vector; distance of steps, of vectors of
            a step.
        steps: of the sum.
        out, out_start, out_row: array of float32 or, if of uint16, bfloat16; first element; distance of rows.
        argument, argument_start: of the epilogue: a number a column from ``argument_start`` on; or, of a ReLU
            mask, an array like the output, ``argument_start`` elements further on.
    """

    left: Any
    left_start: Any
    left_row: Any
    left_step: Any
    right: Any
    right_start: Any
    right_step: Any
    right_panel: Any
    steps: Any
    out: Any
    out_start: Any
    out_row: Any
    argument: Any
    argument_start: Any


def _sum_registers(
    arithmetic: Arithmetic, builder: Any, at: TileArguments, left: Any, right: Any, vectors: int, before: Any
) -> list[Any]:
    """The sums of a tile, row by row, beginning with the vectors ``before``."""
    words = ir.VectorType(arithmetic.word, COLUMNS)

    def step(number: Any, sums: Sequence[Any]) -> list[Any]:
        first = builder.add(at.right_start, builder.mul(number, at.right_step))
        factors = []
        for v in range(vectors):
            place = builder.add(first, builder.mul(at.right_panel, _INDEX(v)))
            vector = builder.load(element(builder, right, place, words), align=4)
            factors.append(arithmetic.operand(builder, vector))
        start = builder.add(at.left_start, builder.mul(number, at.left_step))
        after: list[Any] = []
        for row in range(arithmetic.rows):
            place = builder.add(start, builder.mul(at.left_row, _INDEX(row)))
            one = _broadcast(builder, builder.load(builder.gep(left, [place])))
            one = arithmetic.operand(builder, one)
            for factor in factors:
                after.append(arithmetic.multiply_add(builder, sums[len(after)], one, factor))
        return after

    return gemm_amx.loop(builder, before, at.steps, step)


def register_tile(arithmetic: Arithmetic, vectors: int, epilogue: Epilogue) -> Any:
    """An intrinsic for a tile of 16 columns for each of ``vectors``; it takes `TileArguments`."""

    def tile(context: Any, *given: Any) -> Any:
        kinds = TileArguments(*given)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            at = TileArguments(*values)
            left, right, out, argument = (
                context.make_array(getattr(kinds, name))(context, builder, getattr(at, name)).data
                for name in ("left", "right", "out", "argument")
            )
            left, right = (builder.bitcast(x, arithmetic.word.as_pointer()) for x in (left, right))
            places = [
                builder.add(
                    builder.add(at.out_start, builder.mul(at.out_row, _INDEX(row))), _INDEX(COLUMNS * v)
                )
                for row in range(arithmetic.rows)
                for v in range(vectors)
            ]
            sums: Iterable[Any]
            if arithmetic.matrix_unit:
                into = out if epilogue == "accumulate" else None
                sums = gemm_amx.sum_tiles(builder, at, left, right, vectors, into)
            else:
                before = [_ZERO] * len(places)
                if epilogue == "accumulate":
                    before = [builder.load(element(builder, out, place), align=4) for place in places]
                sums = _sum_registers(arithmetic, builder, at, left, right, vectors, before)
            for number, (place, value) in enumerate(zip(places, sums, strict=False)):
                if epilogue in ("bias", "relu"):
                    column = builder.add(at.argument_start, _INDEX(COLUMNS * (number % vectors)))
                    value = builder.fadd(value, builder.load(element(builder, argument, column), align=4))
                if epilogue == "relu":
                    # Not-a-number stays.
                    value = builder.select(builder.fcmp_ordered("<=", value, _ZERO), _ZERO, value)
                if epilogue == "relu_mask":
                    seen = builder.add(place, at.argument_start)
                    value = builder.select(_positive(builder, argument, seen), value, _ZERO)
                if kinds.out.dtype == types.uint16:
                    value = round_lanes(builder, value)
                builder.store(
                    value, element(builder, out, place, value.type), align=kinds.out.dtype.bitwidth // 8
                )
            return context.get_dummy_value()

        integers = (kind if isinstance(kind, types.Array) else types.int64 for kind in given)
        return types.void(*integers), generate

    # numba reads off how many arguments there are.
    positional = inspect.Parameter.POSITIONAL_OR_KEYWORD
    names = ("context", *TileArguments._fields)
    tile.__signature__ = inspect.Signature([inspect.Parameter(name, positional) for name in names])  # type: ignore[attr-defined]
    return intrinsic(tile)


def _positive(builder: Any, array: Any, place: Any) -> Any:
    """Whether numbers are above 0; of bfloat16 the sign of the bits says it."""
    if array.type.pointee == ir.FloatType():
        return builder.fcmp_ordered(">", builder.load(element(builder, array, place), align=4), _ZERO)
    halves = builder.load(element(builder, array, place, _HALVES), align=2)
    return builder.icmp_signed(">", halves, ir.Constant(_HALVES, [0] * COLUMNS))
