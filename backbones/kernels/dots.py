"""Matrix products of bfloat16 with float32 sums, by the processor's dot products of pairs (AVX-512 BF16).

The matrices of a small perceptron fit into the cache; what costs is the way there: oneDNN prepares each product for its
shape, and torch copies, converts and pads around it. Here a task takes some rows, multiplies them by a matrix that was
packed once, and ends with what the layer needs: bias and ReLU, or the gate of a ReLU. Sums over rows, which make the
gradient of a weight, are done by a fixed number of tasks, so that they do not depend on the number of threads.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from llvmlite import binding, ir  # type: ignore[import-untyped]
from numba import config, types
from numba.core import cgutils
from torch import Tensor
from torch.nn import functional as F

from backbones.kernels.bfloat16 import load_low
from backbones.kernels.compiler import (
    float32,
    inline,
    int32,
    int64,
    intrinsic,
    kernel,
    next_task,
    scratch,
    size,
    uint16,
    vector,
)
from backbones.kernels.simd import LANES, load, one, store, wide
from backbones.kernels.sums import fold
from backbones.kernels.threading import launch

__all__ = ["WIDEST", "available", "multiply", "pack", "weight_gradient"]

WIDEST = 512
"""Columns of the widest matrix."""

# Rows of a block of results that stays in registers.
_HIGH = 8
# Rows whose factors stay in the nearest cache, for products and for sums over rows.
_ROWS = 32
_SUMMED = 64
# Tasks that share the rows of a sum.
_TASKS = 16
_FACTORS, _PAIRS = _ROWS * WIDEST, _SUMMED // 2 * WIDEST
_WORD, _INDEX = ir.IntType(32), ir.IntType(64)


class _BFloat(ir.types.Type):  # type: ignore[misc]
    """LLVM's bfloat, which llvmlite has no name for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


_REALS = ir.VectorType(ir.FloatType(), 16)
_WORDS = ir.VectorType(_WORD, 16)
_SHORTS = ir.VectorType(ir.IntType(16), 16)
_LOW, _HALF = ir.VectorType(_BFloat(), 32), ir.VectorType(_BFloat(), 16)
_DOT, _CONVERT = "llvm.x86.avx512bf16.dpbf16ps.512", "llvm.x86.avx512bf16.cvtneps2bf16.512"


@functools.cache
def available() -> bool:
    """Whether numba compiles for a processor that has these instructions."""
    name, features = config.CPU_NAME, config.CPU_FEATURES  # type: ignore[attr-defined]
    if name not in (None, "host") or features is not None:
        return False
    try:
        return bool(binding.get_host_cpu_features().get("avx512bf16", False))
    except RuntimeError:
        return False


def _vector(builder: Any, pointer: Any, index: Any, like: Any) -> Any:
    """Pointer to a vector of type ``like`` that begins at an element."""
    return builder.bitcast(builder.gep(pointer, [index]), like.as_pointer())


def _lowered(builder: Any, value: Any) -> Any:
    """Sixteen float32 rounded to bfloat16."""
    kind = ir.FunctionType(_HALF, [_REALS])
    convert = cgutils.get_or_insert_function(builder.module, kind, _CONVERT)  # type: ignore[no-untyped-call]
    return builder.call(convert, [value])


def _block(vectors: int, ending: str) -> Any:
    """An intrinsic for a block of results, 8 rows and 16 columns for each of ``vectors``, that stays in registers.

    ``block(a, at, down, along, b, begin, pairs, c, to, row, d, n)``: for ``r < 8`` and ``j < 16 vectors`` the sum over
    ``p < pairs`` of ``a[at + r down + p along] . b[panel]`` ends in ``c[to + r row + j]``. Places in a and b are those
    of pairs of bfloat16, whatever their arrays hold; a panel of b has 16 columns. What becomes of the sum is the
    ending's: ``add``: added to what stands in c; with d from ``n`` on, ``full``: d is added; ``low``: that in bfloat16;
    ``relu``: its ReLU in bfloat16; ``gate``: 0 where d, at the place of c, is not positive.
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
            kind = ir.FunctionType(_REALS, [_REALS, _LOW, _LOW])
            dot = cgutils.get_or_insert_function(builder.module, kind, _DOT)  # type: ignore[no-untyped-call]
            places = [
                builder.add(builder.add(to, builder.mul(row, _INDEX(r))), _INDEX(16 * v))
                for r in range(_HIGH)
                for v in range(vectors)
            ]
            nothing = ir.Constant(_REALS, [0.0] * 16)
            before = [nothing] * len(places)
            if ending == "add":
                before = [builder.load(_vector(builder, out, place, _REALS), align=4) for place in places]
            entry = builder.block
            head, body, end = (builder.append_basic_block(name) for name in ("pairs", "pair", "done"))
            builder.branch(head)
            builder.position_at_end(head)
            number = builder.phi(_INDEX)
            number.add_incoming(_INDEX(0), entry)
            sums = []
            for value in before:
                sums.append(builder.phi(_REALS))
                sums[-1].add_incoming(value, entry)
            builder.cbranch(builder.icmp_signed("<", number, pairs), body, end)
            builder.position_at_end(body)
            first = builder.add(begin, builder.mul(number, _INDEX(16)))
            panel = builder.mul(pairs, _INDEX(16))
            factors = []
            for v in range(vectors):
                place = builder.add(first, builder.mul(panel, _INDEX(v)))
                words = builder.load(_vector(builder, right, place, _WORDS), align=4)
                factors.append(builder.bitcast(words, _LOW))
            start = builder.add(at, builder.mul(number, along))
            undefined, everywhere = ir.Constant(_WORDS, ir.Undefined), ir.Constant(_WORDS, [0] * 16)
            grown: list[Any] = []
            for r in range(_HIGH):
                pair = builder.load(builder.gep(left, [builder.add(start, builder.mul(down, _INDEX(r)))]))
                pair = builder.insert_element(undefined, pair, _WORD(0))
                pair = builder.bitcast(builder.shuffle_vector(pair, undefined, everywhere), _LOW)
                for factor in factors:
                    grown.append(builder.call(dot, [sums[len(grown)], pair, factor]))
            number.add_incoming(builder.add(number, _INDEX(1)), body)
            for value, larger in zip(sums, grown, strict=True):
                value.add_incoming(larger, body)
            builder.branch(head)
            builder.position_at_end(end)
            added = []
            if ending in ("full", "low", "relu"):
                added = [
                    builder.load(_vector(builder, more, builder.add(n, _INDEX(16 * v)), _REALS), align=4)
                    for v in range(vectors)
                ]
            for nth, (place, value) in enumerate(zip(places, sums, strict=True)):
                if added:
                    value = builder.fadd(value, added[nth % vectors])
                if ending == "relu":
                    # Not-a-number stays.
                    value = builder.select(builder.fcmp_ordered("<=", value, nothing), nothing, value)
                if ending == "gate":
                    seen = builder.load(_vector(builder, more, place, _SHORTS), align=2)
                    above = builder.icmp_signed(">", seen, ir.Constant(_SHORTS, [0] * 16))
                    value = builder.select(above, value, nothing)
                if ending in ("full", "add"):
                    builder.store(value, _vector(builder, out, place, _REALS), align=4)
                else:
                    builder.store(_lowered(builder, value), _vector(builder, out, place, _HALF), align=2)
            return context.get_dummy_value()

        i = types.int64
        return types.void(a, i, i, i, b, i, i, c, i, i, d, i), generate

    return block


_add_two, _add_one = _block(2, "add"), _block(1, "add")
_full_two, _full_one = _block(2, "full"), _block(1, "full")
_low_two, _low_one = _block(2, "low"), _block(1, "low")
_relu_two, _relu_one = _block(2, "relu"), _block(1, "relu")
_gate_two, _gate_one = _block(2, "gate"), _block(1, "gate")


@intrinsic
def _zip(context: Any, x: Any, upper: Any, lower: Any, out: Any, to: Any) -> Any:
    """``zip(x, i, j, out, to)``: sixteen pairs of what begins at i and at j in x, both 16 bits wide."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3)
        )
        halves = [
            builder.zext(builder.load(_vector(builder, source, arguments[k], _SHORTS), align=2), _WORDS)
            for k in (1, 2)
        ]
        joined = builder.or_(halves[0], builder.shl(halves[1], ir.Constant(_WORDS, [16] * 16)))
        builder.store(joined, _vector(builder, target, arguments[4], _WORDS), align=4)
        return context.get_dummy_value()

    i = types.int64
    return types.void(x, i, i, out, i), generate


@inline
def _take(x: Any, width: Any, first: Any, count: Any, pairs: Any, a: Any) -> Any:
    """Copy rows ``first`` on of x, ``width`` wide, to rows of ``pairs`` pairs, with zeros where there is nothing."""
    split = width - width % (2 * LANES)
    for r in range(-(-count // _HIGH) * _HIGH):
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
def _layer(table: Any, out: Any, more: Any, two: Any, one: Any) -> Any:
    """x ``(M, K)``, packed weight ``(N / 16, K / 2, 16)``, out ``(M', N)``; what the ending takes."""
    x, weight = vector(table, 0, uint16), vector(table, 1, int32)
    rows, width = size(table, 0, 0), size(table, 0, 1)
    columns, pairs = 16 * size(table, 1, 0), size(table, 1, 1)
    a = scratch(_FACTORS, uint16)
    both = columns - columns % 32
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * _ROWS
        count = min(_ROWS, rows - first)
        _take(x, width, first, count, pairs, a)
        for n in range(0, both, 32):
            for r in range(0, count, _HIGH):
                to = (first + r) * columns + n
                two(a, r * pairs, pairs, 1, weight, n * pairs, pairs, out, to, columns, more, n)
        if both < columns:
            for r in range(0, count, _HIGH):
                to = (first + r) * columns + both
                one(a, r * pairs, pairs, 1, weight, both * pairs, pairs, out, to, columns, more, both)


@kernel
def _full(table: Any) -> None:
    """x, packed weight, out in float32, bias: see `_layer`."""
    _layer(table, vector(table, 2, float32), vector(table, 3, float32), _full_two, _full_one)


@kernel
def _low(table: Any) -> None:
    """x, packed weight, out in bfloat16, bias."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, float32), _low_two, _low_one)


@kernel
def _relu(table: Any) -> None:
    """x, packed weight, out in bfloat16, bias."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, float32), _relu_two, _relu_one)


@kernel
def _gate(table: Any) -> None:
    """x, packed weight, out in bfloat16, a ReLU's output in bfloat16, as wide as out."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, uint16), _gate_two, _gate_one)


@inline
def _pair_rows(x: Any, given: Any, first: Any, count: Any, out: Any, across: Any, down: Any) -> Any:
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


@kernel
def _sum_rows(table: Any) -> None:
    """slope ``(M, N)``, x ``(M, K)``, both bfloat16; ``slope^T x (tasks, N', K')`` and sums of slope ``(tasks, N)``."""
    slope, x = vector(table, 0, uint16), vector(table, 1, uint16)
    out, totals = vector(table, 2, float32), vector(table, 3, float32)
    rows, given, taken = size(table, 0, 0), size(table, 0, 1), size(table, 1, 1)
    high, width = size(table, 2, 1), size(table, 2, 2)
    of_slope, of_x = scratch(_PAIRS, int32), scratch(_PAIRS, int32)
    split, both = given - given % LANES, width - width % 32
    while True:
        task = next_task(table)
        if task < 0:
            break
        begin, end = rows * task // _TASKS, rows * (task + 1) // _TASKS
        base, total = task * high * width, task * given
        for i in range(base, base + high * width):
            out[i] = float32(0)
        for n in range(total, total + given):
            totals[n] = float32(0)
        for first in range(begin, end, _SUMMED):
            count = min(int64(_SUMMED), end - first)
            pairs = -(-count // 2)
            _pair_rows(slope, given, first, count, of_slope, 16, high)
            _pair_rows(x, taken, first, count, of_x, 16 * pairs, 16)
            for at in range(first * given, (first + count) * given, given):
                for n in range(0, split, LANES):
                    store(
                        totals, total + n, load(totals, total + n, wide()) + load_low(slope, at + n, wide())
                    )
                for n in range(split, given):
                    totals[total + n] += load_low(slope, at + n, one())
            for n in range(0, high, _HIGH):
                to = base + n * width
                for k in range(0, both, 32):
                    _add_two(of_slope, n, 1, high, of_x, k * pairs, pairs, out, to + k, width, out, 0)
                if both < width:
                    _add_one(of_slope, n, 1, high, of_x, both * pairs, pairs, out, to + both, width, out, 0)


def _up(count: int, to: int) -> int:
    return -(-count // to) * to


def pack(weight: Tensor) -> Tensor:
    """A weight ``(out, in)`` as `multiply` reads it: ``(out / 16, in / 2, 16)`` pairs, both rounded up."""
    rows, columns = weight.shape
    low = weight.detach().to(torch.bfloat16)
    padded = F.pad(low, (0, columns % 2, 0, _up(rows, 16) - rows)).contiguous()
    words = padded.view(torch.int32)
    return words.reshape(-1, 16, words.shape[1]).transpose(1, 2).contiguous()


def multiply(
    x: Tensor,
    packed: Tensor,
    *,
    bias: Tensor | None = None,
    relu: bool = False,
    gates: Tensor | None = None,
    dtype: torch.dtype = torch.bfloat16,
) -> Tensor:
    """``x weight^T + bias``.

    Args:
        x: ``(M, K)`` bfloat16, contiguous; K at most `WIDEST`.
        packed: the weight ``(N, K)``, see `pack`; N at most `WIDEST`.
        bias: ``(N,)`` float32.
        relu: of the result, which is then bfloat16.
        gates: what this returned for a ReLU of M rows and N columns: the result, in bfloat16 and without bias, is 0
            where that is not positive.
        dtype: of the result otherwise, float32 or bfloat16.

    Returns:
        Contiguous; at least M rows and N columns, which are rounded up to whole blocks.
    """
    rows, columns = x.shape[0], 16 * packed.shape[0]
    low = relu or gates is not None or dtype == torch.bfloat16
    out = torch.empty(_up(rows, _HIGH), columns, dtype=torch.bfloat16 if low else torch.float32)
    if gates is None:
        more = torch.zeros(columns)
        if bias is not None:
            more[: len(bias)] = bias.detach()
        compiled = _relu if relu else (_low if low else _full)
    else:
        more, compiled = gates, _gate
    launch(compiled, -(-rows // _ROWS), x, packed, out, more)
    return out


def weight_gradient(slope: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """``slope^T x (N, K)`` and the sum of slope over rows ``(N,)``, float32.

    Args:
        slope: ``(M, N)`` bfloat16, contiguous; N at most `WIDEST`.
        x: ``(M, K)`` bfloat16, contiguous; K at most `WIDEST`.
    """
    out = torch.empty(_TASKS, _up(slope.shape[1], 16), _up(x.shape[1], 16))
    totals = torch.empty(_TASKS, slope.shape[1])
    launch(_sum_rows, _TASKS, slope, x, out, totals)
    return fold(out)[: slope.shape[1], : x.shape[1]], fold(totals)
