"""The samples of a march as bits, one for each place on a ray's lattice, before they are written out."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from gridreg.ops.cpu.jit.compiler import exact, inline, int64

__all__ = ["MarchBits", "distance_of", "next_bit", "sample_at"]

_REST = np.int64(2**63 - 1)


class MarchBits(NamedTuple):
    """The samples of a march before they are written out.

    Args:
        origins, directions: ``(R, 3)``, contiguous.
        near, shift: ``(R,)``; sample ``index`` lies at ``near + (index + shift) * step``.
        bits: ``(R, words)`` int64; bit i of word w is set if index ``64 w + i`` is kept.
        offsets: ``(R + 1,)`` int64; the samples of ray r are ``offsets[r] : offsets[r + 1]``.
    """

    origins: Tensor
    directions: Tensor
    near: Tensor
    shift: Tensor
    bits: Tensor
    offsets: Tensor


@exact
def sample_at(o: Any, d: Any, axis: Any, distance: Any) -> Any:
    """Coordinate of a sample along an axis."""
    return o[axis] + distance * d[axis]


@exact
def distance_of(near: Any, shift: Any, step: Any, index: Any) -> Any:
    """Distance of sample ``index`` along its ray."""
    return near + (np.float32(index) + shift) * step


@inline
def next_bit(bits: Any, after: Any) -> Any:
    """The first index from ``after`` on whose bit is set; 64 for each word if there is none."""
    words = bits.shape[0]
    word = after >> 6
    rest = int64(0)
    if word < words:
        # The sign bit would be shifted in for ever.
        low = after & 63
        rest = bits[word] if low == 0 else (bits[word] >> low) & (_REST >> (low - 1))
    while rest == 0:
        word += 1
        if word >= words:
            return 64 * words
        after = 64 * word
        rest = bits[word]
    while rest & 1 == 0:
        rest = (rest >> 1) & _REST
        after += 1
    return after
