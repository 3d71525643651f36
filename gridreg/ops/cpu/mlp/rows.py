"""What the kernels of a perceptron have in common: their arguments, and rows of positional encodings, side by side.

Rows are bfloat16 or float32, as the array says that holds them.
"""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.bfloat16 import put
from gridreg.ops.cpu.jit.compiler import float32, inline, int64, integer, vector
from gridreg.ops.cpu.jit.simd import LANES, load, one, wide
from gridreg.ops.cpu.jit.sincos import sine_and_cosine
from gridreg.ops.cpu.mlp.octaves import read_octaves, write_octaves

__all__ = ["AHEAD", "BACK", "OF_BLOCK", "OF_LAYER", "copy_rows", "decode_rows", "encode_rows"]

AHEAD, BACK = 5, 8
"""Arguments of a forward and of a backward kernel before those of the blocks of encodings and of the layers."""

OF_BLOCK, OF_LAYER = 4, 3
"""Arguments for each block of encodings, and for each layer."""


@inline
def copy_rows(x: Any, width: Any, first: Any, count: Any, out: Any, wider: Any) -> Any:
    """Copy rows of float32, with zeros behind them."""
    for r in range(count):
        for i in range(wider):
            put(out, r * wider + i, x[(first + r) * width + i] if i < width else float32(0))


@inline
def encode_rows(
    table: Any, place: Any, blocks: Any, first: Any, count: Any, encoded: Any, width: Any, write: Any
) -> Any:
    """Write the encodings of some rows, and zeros behind them.

    Args:
        table: of the kernel; from ``place`` on x, rows, dims and octaves of each block.
        first, count: rows.
        encoded: ``width`` wide; the last vector that is written may reach beyond its block.
        write: eight float32 to it.
    """
    at = int64(0)
    for block in range(blocks):
        where = place + OF_BLOCK * block
        x, rows = vector(table, where, float32), vector(table, where + 1, int64)
        dims, octaves = integer(table, where + 2), integer(table, where + 3)
        by_row = rows.shape[0] > 0
        for n in range(first, first + count):
            source, to = (rows[n] if by_row else n) * dims, n * width + at
            # From the last vector on, as what a vector is too wide belongs to places that are written later.
            for i in range((dims - 1) // LANES * LANES, -1, -LANES):
                value = load(x, source + i, wide())
                sine, cosine = value, value
                if octaves > 0:
                    sine, cosine = sine_and_cosine(value)
                write_octaves(value, sine, cosine, encoded, to + i, dims, octaves, write)
        at += dims * (1 + 2 * octaves)
    for n in range(first, first + count):
        for i in range(n * width + at, (n + 1) * width):
            encoded[i] = 0


@inline
def decode_rows(
    table: Any,
    place: Any,
    blocks: Any,
    first: Any,
    count: Any,
    encoded: Any,
    width: Any,
    g: Any,
    wider: Any,
) -> Any:
    """Gradients of the inputs, from those of the encodings.

    Args:
        table: of the kernel; from ``place`` on result, first column, dims and octaves of each block.
        first, count: rows.
        encoded: ``width`` wide.
        g: gradients of the encodings, from the first of these rows on, ``wider`` wide.
    """
    for block in range(blocks):
        where = place + OF_BLOCK * block
        result, begin = vector(table, where, float32), integer(table, where + 1)
        dims, octaves = integer(table, where + 2), integer(table, where + 3)
        if result.shape[0] == 0:
            continue
        split = dims - dims % LANES
        for r in range(count):
            at, source, to = (first + r) * width + begin, r * wider + begin, (first + r) * dims
            for i in range(0, split, LANES):
                read_octaves(encoded, at + i, g, source + i, result, to + i, dims, octaves, wide())
            for i in range(split, dims):
                read_octaves(encoded, at + i, g, source + i, result, to + i, dims, octaves, one())
