"""Positional encodings in bfloat16 or float32, for kernels: written from sine and cosine, gradients read back."""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.bfloat16 import get
from gridreg.ops.cpu.jit.compiler import float32, inline
from gridreg.ops.cpu.jit.simd import store

__all__ = ["read_octaves", "write_octaves"]


@inline
def write_octaves(
    x: Any, sine: Any, cosine: Any, out: Any, to: Any, dims: Any, octaves: Any, write: Any
) -> None:
    """Write all octaves of some elements of a row; ``sin 2a = 2 sin a cos a``, ``cos 2a = 1 - 2 sin^2 a``.

    ``write`` is `store_low`, or what does the same.
    """
    write(out, to, x)
    for octave in range(octaves):
        place = to + (1 + 2 * octave) * dims
        write(out, place, sine)
        write(out, place + dims, cosine)
        doubled = float32(2) * sine
        sine, cosine = doubled * cosine, float32(1) - doubled * sine


@inline
def read_octaves(
    x: Any, at: Any, g: Any, begin: Any, result: Any, to: Any, dims: Any, octaves: Any, like: Any
) -> None:
    """Write ``g_x + sum over octaves of f (cos g_sin - sin g_cos)``, from encodings at ``at`` and gradients at
    ``begin``."""
    total = get(g, begin, like)
    frequency = float32(1)
    for octave in range(octaves):
        place = (1 + 2 * octave) * dims
        sine, cosine = get(x, at + place, like), get(x, at + place + dims, like)
        slope = cosine * get(g, begin + place, like) - sine * get(g, begin + place + dims, like)
        total = total + frequency * slope
        frequency = frequency * float32(2)
    store(result, to, total)
