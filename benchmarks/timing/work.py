"""Bytes and operations that a step on a VM field must move and do, from what was counted in that step.

An operation is an addition, a multiplication, a division, a root, or one function of the exponential's kind. A product
of a row of ``a`` with a matrix ``(a, b)`` counts ``2 a b``. A byte is counted when it must cross from memory at least
once in a stage, however often the stage uses it; numbers have 4 bytes, indices 8. So a *node* of a grid (a place on a
plane or line, with all its channels) counts once for all samples that touch it. Beside that, ``cached`` counts every
use: what goes through the caches even if nothing is fetched twice.

With R rays, S steps on them inside the box, N samples that are kept, M of them coloured, F of them with a gradient of
their density that is not 0, and a pair of plane and line for each of three directions, C channels each (D for density,
A for appearance), P nodes touched (Q by the F):

    stage             bytes                                    operations
    rays              48 R                                     24 R
    march             36 R + 8 (R + 1) + min(S, cells) + 24 N  9 N
    density           16 N + 4 D P                             N (36 D + 31)
    colour/lookup     12 M + 3 e A M + 4 A P                   M (33 A + 27)
    colour/network    3 e A M + 32 M + 4 weights               M (6 A F + layers + encodings + 9)
    compositing       12 N + 12 M + 32 R                       8 N + 6 M + 7 R
    backward/other    12 N + 24 M                              5 N + 17 M
    backward/network  6 e A M + 12 M + 8 weights               2 (6 A F M) + layers and encodings backwards
    backward/lookup   12 M + 3 e A M + 12 A P                  M (72 A + 27)
    backward/density  20 N + 12 D Q                            4 N + F (72 D + 27)
    optimiser         32 a parameter                           13 a parameter

e is the size of a product of plane and line that is handed to the basis: 2 bytes where the basis and the layers
multiply in bfloat16, else 4.

* march: ``t = t_min + (index + jitter) step`` and ``o + t d``; origin, direction, entry, exit and jitter are read; an
  index, a distance and a position are written.
* density: a position in the box (6), on the grid (6), complements of interpolation weights (3), the corners of three
  planes (12); per channel 7 for the plane, 3 for the line, 1 for their product, 1 for the sum; shift, exponential,
  1 +, logarithm, scale.
* network: the basis ``3 A -> F``, the layers on F features, position and direction with their encodings (the first
  sine and cosine, then 4 operations an octave), sigmoids; a direction is encoded once a ray. Backwards every product
  counts twice, for its weights and for its input, but for columns of the first layer whose input needs no gradient;
  a sine and a cosine count 5.
* compositing: ``exp(-density delta)``, 1 minus it, weight, transmittance (5); depth and opacity (3); colours (6).
* backward/other: compositing (4 and the interval; 5 and 3 for colours) and sigmoids (9).
* backward lookups: the products again (a line 3, a plane 7, times the gradient 1 each), then 8 for the four nodes of
  the plane and 4 for the two of the line, 24 in all; parameters are read, gradients read and written; 4 more for the
  slope of the density.
* optimiser: Adam reads and writes parameter, gradient and two moments (Kingma and Ba 2015). Only parameters that had
  a gradient count; penalties that are folded into it add operations that do not.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass


@dataclass(frozen=True)
class Counts:
    """Counts of a step.

    Args:
        rays, steps, cells, samples, coloured: R, S, number of occupancy cells, N and M.
        density_channels, appearance_channels: D and A that are open.
        density_nodes, appearance_nodes: P of either.
        nonzero, nonzero_nodes: F and Q.
        features: F that the decoder reads.
        layers: widths of the decoder, its input first.
        encodings: inputs of the decoder as (dimensions, octaves): features, direction, position if it reads it.
        parameters: that Adam updates.
        low: whether basis and decoder multiply in bfloat16, and products of planes and lines are handed over in it.
    """

    rays: int
    steps: int
    cells: int
    samples: int
    coloured: int
    density_channels: int
    appearance_channels: int
    density_nodes: int
    appearance_nodes: int
    nonzero: int
    nonzero_nodes: int
    features: int
    layers: tuple[int, ...]
    encodings: tuple[tuple[int, int], ...]
    parameters: int
    low: bool

    @property
    def component_bytes(self) -> int:
        """Bytes of a product of plane and line that is handed to the basis."""
        return 2 if self.low else 4


@dataclass(frozen=True)
class Work:
    """Work that a stage must do.

    Args:
        bytes: to and from memory.
        operations: in float32.
        low: operations in bfloat16.
        cached: bytes through the caches.
    """

    bytes: float
    operations: float
    low: float = 0.0
    cached: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(
            self.bytes + other.bytes,
            self.operations + other.operations,
            self.low + other.low,
            self.cached + other.cached,
        )


def layer_operations(widths: tuple[int, ...]) -> int:
    """Return the operations of one row through linear layers."""
    return sum(2 * a * b for a, b in itertools.pairwise(widths))


def encoding_operations(dimensions: int, octaves: int) -> int:
    """Return those of one row's sines and cosines: two are computed, each further octave doubles the angle in 4."""
    return dimensions * (2 + 4 * (octaves - 1)) if octaves else 0


def layer_operations_backward(widths: tuple[int, ...], wanted: int) -> int:
    """Gradients of weights and inputs of one row; of the first layer's input only ``wanted`` columns."""
    first = 2 * widths[0] * widths[1]
    return 2 * layer_operations(widths) - first + 2 * wanted * widths[1]


def density_work(n: int, channels: int, nodes: int) -> Work:
    """Look up, activate: ``N`` samples."""
    once = 16 * n + 4 * channels * nodes
    return Work(once, n * (36 * channels + 31), cached=16 * n + 72 * channels * n)


def lookup_work(m: int, channels: int, nodes: int, size: int) -> Work:
    """Products of planes and lines of ``size`` bytes, side by side: ``M`` samples."""
    kept = 12 * m + 3 * size * channels * m
    return Work(kept + 4 * channels * nodes, m * (33 * channels + 27), cached=kept + 72 * channels * m)


def density_backward_work(n: int, nonzero: int, channels: int, nodes: int) -> Work:
    """Gradients of planes and lines from that of the density, of which ``nonzero`` are not 0."""
    kept = 20 * n
    operations = 4 * n + nonzero * (72 * channels + 27)
    return Work(kept + 12 * channels * nodes, operations, cached=kept + 216 * channels * nonzero)


def lookup_backward_work(m: int, channels: int, nodes: int, size: int) -> Work:
    """Gradients of planes and lines from those of their products, of ``size`` bytes."""
    kept = 12 * m + 3 * size * channels * m
    return Work(kept + 12 * channels * nodes, m * (72 * channels + 27), cached=kept + 216 * channels * m)


def network_work(c: Counts) -> tuple[Work, Work]:
    """Basis, encodings and decoder, forwards and backwards."""
    m, components, widths = c.coloured, 3 * c.appearance_channels, c.layers
    weights = components * c.features + sum(a * b for a, b in itertools.pairwise(widths))
    basis = 2 * components * c.features
    (dims, octaves), (of_direction, turns), *position = c.encodings
    encoded = encoding_operations(dims, octaves) + sum(encoding_operations(d, o) for d, o in position)
    wanted = dims * (1 + 2 * octaves)
    # Sigmoids; backwards, of each octave a sine and a cosine: two products, a difference, a factor and a sum.
    forward = m * (encoded + 9) + c.rays * encoding_operations(of_direction, turns)
    back = m * 5 * dims * octaves
    products = m * (basis + layer_operations(widths))
    products_back = m * (2 * basis + layer_operations_backward(widths, wanted))
    low, low_back = (products, products_back) if c.low else (0, 0)
    handed = c.component_bytes * components * m
    moved, moved_back = handed + 32 * m + 4 * weights, 2 * handed + 12 * m + 8 * weights
    return (
        Work(moved, forward + products - low, low, moved),
        Work(moved_back, back + products_back - low_back, low_back, moved_back),
    )


def work(c: Counts) -> dict[str, Work]:
    """The table above, for one step."""
    r, n, m = c.rays, c.samples, c.coloured

    def streamed(moved: int, operations: int) -> Work:
        return Work(moved, operations, cached=moved)

    forward, backward = network_work(c)
    return {
        "rays": streamed(48 * r, 24 * r),
        "march": streamed(36 * r + 8 * (r + 1) + min(c.steps, c.cells) + 24 * n, 9 * n),
        "density": density_work(n, c.density_channels, c.density_nodes),
        "colour/lookup": lookup_work(m, c.appearance_channels, c.appearance_nodes, c.component_bytes),
        "colour/network": forward,
        "compositing": streamed(12 * n + 12 * m + 32 * r, 8 * n + 6 * m + 7 * r),
        "backward/other": streamed(12 * n + 24 * m, 5 * n + 17 * m),
        "backward/network": backward,
        "backward/lookup": lookup_backward_work(
            m, c.appearance_channels, c.appearance_nodes, c.component_bytes
        ),
        "backward/density": density_backward_work(n, c.nonzero, c.density_channels, c.nonzero_nodes),
        "optimiser": streamed(32 * c.parameters, 13 * c.parameters),
    }
