"""Positional encodings in kernels of a perceptron: rows of several, side by side, and their gradients.

Rows are bfloat16 or float32, as the array says that holds them.
"""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.compiler import inline
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.simd_math import sine_and_cosine
from gridreg.ops.cpu.jit.table import float32, int64, integer, vector

MOST_OCTAVES = 8
"""Beyond, doubling angles has cost more than two digits of float32."""

PER_BLOCK = 4
"""Arguments of a kernel for each block: input or its gradient, rows or first column, dims, octaves."""


@inline
def copy_rows(x: Any, width: int, first: int, rows: int, out: Any, out_first: int, out_width: int) -> None:
    """Copy rows of ``width``, with zeros behind them."""
    split = width - width % LANES
    for r in range(rows):
        source, to = (first + r) * width, (out_first + r) * out_width
        for i in range(0, split, LANES):
            store(out, to + i, load(x, source + i, vector_zero()))
        for i in range(split, width):
            store(out, to + i, load(x, source + i, scalar_zero()))
        for i in range(width, out_width):
            store(out, to + i, scalar_zero())


@inline
def _write_octaves(
    x: Any, sine: Any, cosine: Any, out: Any, start: int, dims: int, octaves: int, write: Any
) -> None:
    """Write all octaves of some elements; ``sin 2a = 2 sin a cos a``, ``cos 2a = 1 - 2 sin^2 a``."""
    write(out, start, x)
    for octave in range(octaves):
        place = start + (1 + 2 * octave) * dims
        write(out, place, sine)
        write(out, place + dims, cosine)
        doubled = float32(2) * sine
        sine, cosine = doubled * cosine, float32(1) - doubled * sine


@inline
def encode_rows(
    table: Any, first_argument: int, blocks: int, first: int, rows: int, encoded: Any, width: int, write: Any
) -> None:
    """Write the encodings of some rows, and zeros behind them.

    Args:
        table: of the kernel; from ``first_argument`` on x, rows, dims and octaves of each block.
        encoded: ``width`` wide; the last vector that is written may reach beyond its block.
        write: eight float32 to it.
    """
    start = int64(0)
    for block in range(blocks):
        argument = first_argument + PER_BLOCK * block
        x, row_of = vector(table, argument, float32), vector(table, argument + 1, int64)
        dims, octaves = integer(table, argument + 2), integer(table, argument + 3)
        by_row = row_of.shape[0] > 0
        for n in range(first, first + rows):
            source, to = (row_of[n] if by_row else n) * dims, n * width + start
            # From the last vector on, as what a vector is too wide belongs to places that are written later.
            for i in range((dims - 1) // LANES * LANES, -1, -LANES):
                value = load(x, source + i, vector_zero())
                sine, cosine = value, value
                if octaves > 0:
                    sine, cosine = sine_and_cosine(value)
                _write_octaves(value, sine, cosine, encoded, to + i, dims, octaves, write)
        start += dims * (1 + 2 * octaves)
    for n in range(first, first + rows):
        for i in range(n * width + start, (n + 1) * width):
            encoded[i] = 0


@inline
def _read_octaves(
    x: Any, start: int, gradient: Any, gradient_start: int, result: Any, to: int, dims: int, octaves: int,
    dtype_like: Any,
) -> None:  # fmt: skip
    """Write ``g_x + sum over octaves of f (cos g_sin - sin g_cos)``, from encodings and their gradients."""
    total = load(gradient, gradient_start, dtype_like)
    frequency = float32(1)
    for octave in range(octaves):
        place = (1 + 2 * octave) * dims
        sine, cosine = load(x, start + place, dtype_like), load(x, start + place + dims, dtype_like)
        of_sine = load(gradient, gradient_start + place, dtype_like)
        of_cosine = load(gradient, gradient_start + place + dims, dtype_like)
        total = total + frequency * (cosine * of_sine - sine * of_cosine)
        frequency = frequency * float32(2)
    store(result, to, total)


@inline
def decode_rows(
    table: Any, first_argument: int, blocks: int, first: int, rows: int, encoded: Any, width: int,
    gradient: Any, wider: int,
) -> None:  # fmt: skip
    """Write gradients of the inputs, from those of the encodings.

    Args:
        table: of the kernel; from ``first_argument`` on result, first column, dims and octaves of each block.
        encoded: ``width`` wide.
        gradient: of the encodings, from the first of these rows on, ``wider`` wide.
    """
    for block in range(blocks):
        argument = first_argument + PER_BLOCK * block
        result, column = vector(table, argument, float32), integer(table, argument + 1)
        dims, octaves = integer(table, argument + 2), integer(table, argument + 3)
        if result.shape[0] == 0:
            continue
        split = dims - dims % LANES
        for r in range(rows):
            start, source, to = (first + r) * width + column, r * wider + column, (first + r) * dims
            for i in range(0, split, LANES):
                _read_octaves(
                    encoded, start + i, gradient, source + i, result, to + i, dims, octaves, vector_zero()
                )
            for i in range(split, dims):
                _read_octaves(
                    encoded, start + i, gradient, source + i, result, to + i, dims, octaves, scalar_zero()
                )
