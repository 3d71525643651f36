"""Matrix products of a perceptron in float32 and in bfloat16, by register tiles."""

from __future__ import annotations

from typing import Any

import torch
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops.cpu.jit.compiler import inline
from gridreg.ops.cpu.jit.table import intrinsic
from gridreg.ops.cpu.mlp.gemm_amx import EDGE, configure_tiles, transpose_words
from gridreg.ops.cpu.mlp.gemm_tile import (
    BF16,
    COLUMNS,
    F32,
    Arithmetic,
    Epilogue,
    element,
    register_tile,
    round_lanes,
)

WIDEST = 512
"""Columns of the widest matrix."""

# Rows whose factors stay in the nearest caches, of products and of the sums over rows in a weight's gradient.
ROWS = 32
GRADIENT_ROWS = 64
# Tasks that share the rows of such a sum: so many whatever the number of threads, as that decides the order.
TASKS = 16

TILE_ROWS = max(F32.rows, BF16.rows)
"""Rows of the highest tile: products read and write whole tiles."""

_MATRIX_UNIT = BF16.matrix_unit
# Pairs of the rows of a sum.
PAIRS = GRADIENT_ROWS // 2 * WIDEST
_HALVES, _WORDS = ir.VectorType(ir.IntType(16), 16), ir.VectorType(ir.IntType(32), 16)


def _product(arithmetic: Arithmetic, epilogue: Epilogue) -> Any:
    """A product of rows with a packed weight, as a function for kernels."""
    wide, narrow = (register_tile(arithmetic, n, epilogue) for n in (arithmetic.wide, 1))
    height, by_column = arithmetic.rows, int(epilogue != "relu_mask")
    across = COLUMNS * arithmetic.wide

    @inline
    def product(
        left: Any, left_start: int, left_row: int, rows: int, weight: Any, steps: int, columns: int,
        out: Any, out_start: int, argument: Any, argument_start: int,
    ) -> None:  # fmt: skip
        """Write ``rows`` rows of ``columns``; see `TileArguments`. The weight is what `pack` returns."""
        panel = steps * COLUMNS
        split = columns - columns % across if across > COLUMNS else 0
        for i in range(0, split, across):
            for r in range(0, rows, height):
                wide(
                    left, left_start + r * left_row, left_row, 1, weight, i * steps, COLUMNS, panel, steps,
                    out, out_start + r * columns + i, columns, argument, argument_start + i * by_column,
                )  # fmt: skip
        for i in range(split, columns, COLUMNS):
            for r in range(0, rows, height):
                narrow(
                    left, left_start + r * left_row, left_row, 1, weight, i * steps, COLUMNS, panel, steps,
                    out, out_start + r * columns + i, columns, argument, argument_start + i * by_column,
                )  # fmt: skip

    return product


relu_f32, relu_bf16 = _product(F32, "relu"), _product(BF16, "relu")
bias_f32, bias_bf16 = _product(F32, "bias"), _product(BF16, "bias")
relu_mask_f32, relu_mask_bf16 = _product(F32, "relu_mask"), _product(BF16, "relu_mask")


def _sum_of_products(arithmetic: Arithmetic) -> Any:
    """Sums over rows of products of two matrices' columns, as a function for kernels."""
    wide, narrow = (register_tile(arithmetic, n, "accumulate") for n in (arithmetic.wide, 1))
    height, across = arithmetic.rows, COLUMNS * arithmetic.wide

    @inline
    def sum_of_products(
        left: Any, left_width: int, left_column: int, left_row: int, left_step: int, right: Any, right_start: int,
        right_step: int, right_panel: int, width: int, steps: int, sums: Any, sums_start: int,
    ) -> None:  # fmt: skip
        """Add to ``sums (left_width, width)``; columns of left are ``left_column`` words apart, tile by tile."""
        split = width - width % across if across > COLUMNS else 0
        for n in range(0, left_width, height):
            first, to = n * left_column, sums_start + n * width
            for k in range(0, split, across):
                wide(
                    left, first, left_row, left_step, right, right_start + k // COLUMNS * right_panel, right_step,
                    right_panel, steps, sums, to + k, width, sums, 0,
                )  # fmt: skip
            for k in range(split, width, COLUMNS):
                narrow(
                    left, first, left_row, left_step, right, right_start + k // COLUMNS * right_panel, right_step,
                    right_panel, steps, sums, to + k, width, sums, 0,
                )  # fmt: skip

    return sum_of_products


_sum_f32, _sum_bf16 = _sum_of_products(F32), _sum_of_products(BF16)


@inline
def add_weight_gradient_f32(
    slope: Any, slope_width: int, x: Any, width: int, first: int, rows: int, sums: Any, start: int,
    slope_pairs: Any, x_pairs: Any,
) -> None:  # fmt: skip
    """Add ``slope^T x`` over some rows to ``sums (slope_width, width)``, from ``start`` on.

    Args:
        slope: its first rows, ``slope_width`` wide.
        x: its rows from ``first`` on, ``width`` wide.
        slope_pairs, x_pairs: not used.
    """
    _sum_f32(
        slope, slope_width, 1, 1, slope_width, x, first * width, width, COLUMNS, width, rows, sums, start
    )


@inline
def _add_by_vectors(
    slope: Any, slope_width: int, x: Any, width: int, first: int, rows: int, sums: Any, start: int,
    slope_pairs: Any, x_pairs: Any,
) -> None:  # fmt: skip
    pairs = -(-rows // 2)
    _pair_rows(slope, slope_width, 0, rows, slope_pairs, COLUMNS, slope_width)
    _pair_rows(x, width, first, rows, x_pairs, COLUMNS * pairs, COLUMNS)
    _sum_bf16(
        slope_pairs, slope_width, 1, 1, slope_width, x_pairs, 0, COLUMNS, COLUMNS * pairs, width, pairs, sums, start
    )  # fmt: skip


@inline
def _add_by_matrices(
    slope: Any, slope_width: int, x: Any, width: int, first: int, rows: int, sums: Any, start: int,
    slope_pairs: Any, x_pairs: Any,
) -> None:  # fmt: skip
    pairs = -(-rows // (2 * EDGE)) * EDGE
    panel = COLUMNS * pairs
    for i in range(0, panel * max(slope_width, width) // COLUMNS if 2 * pairs > rows else 0):
        slope_pairs[i], x_pairs[i] = 0, 0
    _pair_rows(slope, slope_width, 0, rows, slope_pairs, panel, COLUMNS)
    _pair_rows(x, width, first, rows, x_pairs, panel, COLUMNS)
    for i in range(0, slope_width * pairs, EDGE * EDGE):
        transpose_words(slope_pairs, i)
    _sum_bf16(
        slope_pairs, slope_width, pairs, EDGE, EDGE, x_pairs, 0, COLUMNS, panel, width, pairs, sums, start
    )  # fmt: skip


add_weight_gradient_bf16 = _add_by_matrices if BF16.matrix_unit else _add_by_vectors
"""`add_weight_gradient_f32` in bfloat16; ``slope_pairs`` and ``x_pairs`` are memory for `PAIRS` pairs."""


@intrinsic
def _zip(context: Any, x: Any, upper: Any, lower: Any, out: Any, to: Any) -> Any:
    """``_zip(x, i, j, out, to)``: sixteen pairs of what begins at i and at j in x, both 16 bits wide."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3)
        )
        halves = [
            builder.zext(builder.load(element(builder, source, arguments[k], _HALVES), align=2), _WORDS)
            for k in (1, 2)
        ]
        joined = builder.or_(halves[0], builder.shl(halves[1], ir.Constant(_WORDS, [16] * 16)))
        builder.store(joined, element(builder, target, arguments[4], _WORDS), align=4)
        return context.get_dummy_value()

    i = types.int64
    return types.void(x, i, i, out, i), generate


@intrinsic
def round_to_bf16(context: Any, array: Any, index: Any, value: Any) -> Any:
    """``round_to_bf16(x, i, value)``: write eight float32 as bfloat16, see `round_lanes`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        index = context.cast(builder, arguments[1], signature.args[1], types.int64)
        found = round_lanes(builder, arguments[2])
        builder.store(found, element(builder, data, index, found.type), align=2)
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@inline
def prepare_bf16() -> None:
    """Before the products of a task in bfloat16."""
    if _MATRIX_UNIT:
        configure_tiles()


@inline
def prepare_f32() -> None:
    """Before the products of a task in float32: nothing."""


@inline
def _pair_rows(x: Any, width: int, first: int, rows: int, out: Any, across: int, down: int) -> None:
    """Write rows of x as pairs of bfloat16, two rows each; the width is a multiple of 16.

    Pair p, column i stands at ``(i // 16) across + p down + i % 16``.
    """
    for p in range(-(-rows // 2)):
        upper = (first + 2 * p) * width
        there = 2 * p + 1 < rows
        lower = upper + width if there else upper
        for i in range(0, width, COLUMNS):
            _zip(x, upper + i, lower + i, out, (i // COLUMNS) * across + p * down)
        if not there:
            for i in range(width):
                out[(i // COLUMNS) * across + p * down + i % COLUMNS] &= 0xFFFF


def round_up(count: int, to: int) -> int:
    """The next multiple of ``to``."""
    return -(-count // to) * to


def pack(weight: Tensor, width: int, dtype: torch.dtype) -> Tensor:
    """A weight as products read it: vectors of 16 of its rows, step by step.

    Args:
        weight: ``(out, in)`` float32.
        width: columns of the rows that it is multiplied with, in memory; at least ``in``.
        dtype: float32: ``(out / 16, in, 16)``; bfloat16: ``(out / 16, width / 2, 16)`` pairs, as int32.
    """
    rows, columns = weight.shape
    weight = weight.detach()
    if dtype == torch.float32:
        padded = F.pad(weight, (0, 0, 0, round_up(rows, COLUMNS) - rows))
    else:
        padded = F.pad(weight.to(dtype), (0, width - columns, 0, round_up(rows, COLUMNS) - rows))
        padded = padded.contiguous().view(torch.int32)
    return padded.view(-1, COLUMNS, padded.shape[1]).transpose(1, 2).contiguous()
