"""Blocks of matrix products of bfloat16 with float32 sums, by the processor's dot products of pairs (AVX-512 BF16).

What `gridreg.ops.cpu.mlp.dots` and `gridreg.ops.cpu.mlp.fused` are made of: a block of results stays in registers, and
ends with what a layer needs: bias and ReLU, or the gate of a ReLU.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils

from gridreg.ops.cpu.jit.compiler import inline, int32, int64, intrinsic, uint16
from gridreg.ops.cpu.jit.simd import LANES, load, store, wide
from gridreg.ops.cpu.mlp.gemm_tile import (
    INDEX,
    LONG,
    REALS,
    SUMMED,
    WIDEST,
    ahead,
    everywhere,
    has,
    places_of,
    relu,
    summed,
)

__all__ = [
    "HIGH",
    "PAIRS",
    "available",
    "full_one",
    "full_two",
    "gate_one",
    "gate_two",
    "lower",
    "low_one",
    "low_two",
    "pair_rows",
    "product",
    "relu_one",
    "relu_two",
    "sum_products",
    "take",
]

# Rows of a block of results that stays in registers.
HIGH = 8
# Pairs of the rows of a sum.
PAIRS = SUMMED // 2 * WIDEST
_WORD = ir.IntType(32)


class _BFloat(ir.types.Type):  # type: ignore[misc]
    """LLVM's bfloat, which llvmlite has no name for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


_WORDS = ir.VectorType(_WORD, 16)
_SHORTS = ir.VectorType(ir.IntType(16), 16)
_LOW, _HALF = ir.VectorType(_BFloat(), 32), ir.VectorType(_BFloat(), 16)
_DOT, _CONVERT = "llvm.x86.avx512bf16.dpbf16ps.512", "llvm.x86.avx512bf16.cvtneps2bf16"


def available() -> bool:
    """Whether numba compiles for a processor that has these instructions."""
    return has("avx512bf16")


def _lowered(builder: Any, value: Any) -> Any:
    """Eight or sixteen float32 rounded to bfloat16."""
    lanes = value.type.count
    kind = ir.FunctionType(ir.VectorType(_BFloat(), lanes), [value.type])
    name = f"{_CONVERT}.{32 * lanes}"
    convert = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
    return builder.call(convert, [value])


def _block(vectors: int, ending: str) -> Any:
    """An intrinsic for a block of results, 8 rows and 16 columns for each of ``vectors``, that stays in registers.

    ``block(a, at, down, along, b, begin, pairs, c, to, row, d, n)``: for ``r < 8`` and ``j < 16 vectors`` the sum over
    ``p < pairs`` of ``a[at + r down + p along] . b[panel]`` ends in ``c[to + r row + j]``. Places in a and b are those
    of pairs of bfloat16, whatever their arrays hold; a panel of b has 16 columns. What becomes of the sum is the
    ending's: ``add``: added to what stands in c; with d from ``n`` on, ``full``: d is added; ``low``: that in bfloat16;
    ``relu``: its ReLU in bfloat16; ``gate``: 0 where d, ``n`` behind the place of c, is not positive.
    """

    @intrinsic
    def block(
        context: Any, a: Any, at: Any, down: Any, along: Any, b: Any, begin: Any, pairs: Any, c: Any, to: Any,
        row: Any, d: Any, n: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            left, right, out, more = (
                context.make_array(signature.args[k])(context, builder, arguments[k]).data
                for k in (0, 4, 7, 10)
            )
            left, right = (builder.bitcast(x, _WORD.as_pointer()) for x in (left, right))
            _, at, down, along, _, begin, pairs, _, to, row, _, n = arguments
            kind = ir.FunctionType(REALS, [REALS, _LOW, _LOW])
            dot = cgutils.get_or_insert_function(builder.module, kind, _DOT)  # type: ignore[no-untyped-call]
            places = places_of(builder, to, row, HIGH, vectors)
            nothing = ir.Constant(REALS, [0.0] * LONG)
            before = [nothing] * len(places)
            if ending == "add":
                before = [builder.load(ahead(builder, out, place), align=4) for place in places]
            panel = builder.mul(pairs, INDEX(LONG))

            def grow(number: Any, sums: Any) -> list[Any]:
                first = builder.add(begin, builder.mul(number, INDEX(LONG)))
                factors = []
                for v in range(vectors):
                    place = builder.add(first, builder.mul(panel, INDEX(v)))
                    words = builder.load(ahead(builder, right, place, _WORDS), align=4)
                    factors.append(builder.bitcast(words, _LOW))
                start = builder.add(at, builder.mul(number, along))
                grown: list[Any] = []
                for r in range(HIGH):
                    pair = builder.load(builder.gep(left, [builder.add(start, builder.mul(down, INDEX(r)))]))
                    pair = builder.bitcast(everywhere(builder, pair), _LOW)
                    for factor in factors:
                        grown.append(builder.call(dot, [sums[len(grown)], pair, factor]))
                return grown

            sums = summed(builder, before, pairs, grow)
            for nth, (place, value) in enumerate(zip(places, sums, strict=True)):
                if ending in ("full", "low", "relu"):
                    bias = builder.add(n, INDEX(LONG * (nth % vectors)))
                    value = builder.fadd(value, builder.load(ahead(builder, more, bias), align=4))
                if ending == "relu":
                    value = relu(builder, value)
                if ending == "gate":
                    seen = builder.load(ahead(builder, more, builder.add(place, n), _SHORTS), align=2)
                    above = builder.icmp_signed(">", seen, ir.Constant(_SHORTS, [0] * LONG))
                    value = builder.select(above, value, nothing)
                if ending in ("full", "add"):
                    builder.store(value, ahead(builder, out, place), align=4)
                else:
                    builder.store(_lowered(builder, value), ahead(builder, out, place, _HALF), align=2)
            return context.get_dummy_value()

        i = types.int64
        return types.void(a, i, i, i, b, i, i, c, i, i, d, i), generate

    return block


_add_two, _add_one = _block(2, "add"), _block(1, "add")
full_two, full_one = _block(2, "full"), _block(1, "full")
low_two, low_one = _block(2, "low"), _block(1, "low")
relu_two, relu_one = _block(2, "relu"), _block(1, "relu")
gate_two, gate_one = _block(2, "gate"), _block(1, "gate")


@intrinsic
def _zip(context: Any, x: Any, upper: Any, lower: Any, out: Any, to: Any) -> Any:
    """``zip(x, i, j, out, to)``: sixteen pairs of what begins at i and at j in x, both 16 bits wide."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3)
        )
        halves = [
            builder.zext(builder.load(ahead(builder, source, arguments[k], _SHORTS), align=2), _WORDS)
            for k in (1, 2)
        ]
        joined = builder.or_(halves[0], builder.shl(halves[1], ir.Constant(_WORDS, [16] * 16)))
        builder.store(joined, ahead(builder, target, arguments[4], _WORDS), align=4)
        return context.get_dummy_value()

    i = types.int64
    return types.void(x, i, i, out, i), generate


@intrinsic
def lower(context: Any, array: Any, index: Any, value: Any) -> Any:
    """``lower(x, i, value)``: eight float32 rounded to bfloat16, as `gridreg.ops.cpu.jit.bfloat16.store_low` does it,
    but for subnormal numbers, which become 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        index = context.cast(builder, arguments[1], signature.args[1], types.int64)
        low = _lowered(builder, arguments[2])
        builder.store(low, ahead(builder, data, index, low.type), align=2)
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@inline
def take(x: Any, width: Any, first: Any, count: Any, pairs: Any, a: Any) -> Any:
    """Copy rows ``first`` on of x, ``width`` wide, to rows of ``pairs`` pairs, with zeros where there is nothing."""
    split = width - width % (2 * LANES)
    for r in range(-(-count // HIGH) * HIGH):
        to, begin, filled = 2 * r * pairs, (first + r) * width, int64(0)
        if r < count:
            # Sixteen bfloat16 are as long as eight float32.
            for i in range(0, split, 2 * LANES):
                store(a, to + i, load(x, begin + i, wide()))
            for i in range(split, width):
                a[to + i] = x[begin + i]
            filled = width
        for i in range(filled, 2 * pairs):
            a[to + i] = uint16(0)


@inline
def pair_rows(x: Any, given: Any, first: Any, count: Any, out: Any, across: Any, down: Any) -> Any:
    """Pairs of rows of x as pairs of bfloat16: pair p, column i at ``(i // 16) across + p down + i % 16``."""
    split = given - given % 16
    for p in range(-(-count // 2)):
        upper = (first + 2 * p) * given
        there = 2 * p + 1 < count
        lower = upper + given if there else upper
        for i in range(0, split, 16):
            _zip(x, upper + i, lower + i, out, (i // 16) * across + p * down)
        at = (split // 16) * across + p * down
        for i in range(split, given):
            out[at + i - split] = int32(x[upper + i]) | (int32(x[lower + i]) << 16)
        for i in range(given - split, 16 if given > split else 0):
            out[at + i] = 0
        if not there:
            for i in range(given):
                out[(i // 16) * across + p * down + i % 16] &= 0xFFFF


@inline
def product(
    a: Any, at: Any, pairs: Any, count: Any, weight: Any, columns: Any, out: Any, to: Any, more: Any, n: Any,
    along: Any, two: Any, one: Any,
) -> Any:  # fmt: skip
    """Rows of pairs, from pair ``at`` on, times a packed weight, to rows of ``columns`` from ``to`` on.

    ``more`` is what the ending takes, from ``n`` on; ``along`` is 1 if it is one number for a column, else 0.
    """
    both = columns - columns % 32
    for i in range(0, both, 32):
        for r in range(0, count, HIGH):
            place = to + r * columns + i
            two(
                a,
                at + r * pairs,
                pairs,
                1,
                weight,
                i * pairs,
                pairs,
                out,
                place,
                columns,
                more,
                n + i * along,
            )
    if both < columns:
        for r in range(0, count, HIGH):
            place = to + r * columns + both
            one(
                a,
                at + r * pairs,
                pairs,
                1,
                weight,
                both * pairs,
                pairs,
                out,
                place,
                columns,
                more,
                n + both * along,
            )


@inline
def sum_products(of_slope: Any, high: Any, of_x: Any, width: Any, pairs: Any, out: Any, base: Any) -> Any:
    """Add products of `pair_rows` of two matrices, ``high`` and ``width`` wide, to out ``(high, width)``."""
    both = width - width % 32
    for n in range(0, high, HIGH):
        to = base + n * width
        for k in range(0, both, 32):
            _add_two(of_slope, n, 1, high, of_x, k * pairs, pairs, out, to + k, width, out, 0)
        if both < width:
            _add_one(of_slope, n, 1, high, of_x, both * pairs, pairs, out, to + both, width, out, 0)
