"""Formulas of the roofline against the same computations in numbers that count what is done with them."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from timing import work as work_module
from timing.work import density_work, encoding_operations, layer_operations_backward, work

from tests.speed_runs import COUNTS


class Number:
    """A number that counts operations."""

    done = 0

    def __init__(self, value: float = 0.5) -> None:
        self.value = value

    def _next(self, value: float) -> Number:
        Number.done += 1
        return Number(value)

    def __add__(self, other: Any) -> Number:
        return self._next(self.value + _plain(other))

    def __sub__(self, other: Any) -> Number:
        return self._next(self.value - _plain(other))

    def __rsub__(self, other: Any) -> Number:
        return self._next(_plain(other) - self.value)

    def __mul__(self, other: Any) -> Number:
        return self._next(self.value * _plain(other))

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: Any) -> Number:
        return self._next(self.value / _plain(other))

    def __rtruediv__(self, other: Any) -> Number:
        return self._next(_plain(other) / self.value)

    def f(self) -> Number:
        """A root or a function of the exponential's kind."""
        return self._next(self.value)


def _plain(x: Any) -> float:
    return x.value if isinstance(x, Number) else x


@pytest.fixture(autouse=True)
def from_zero() -> None:
    Number.done = 0


def numbers(count: int) -> list[Number]:
    return [Number() for _ in range(count)]


def place() -> tuple[list[Number], list[list[Number]], list[Number]]:
    """In the box, on the grid; shares, corners of three planes, and complements."""
    u = [(x - 0.1) / 0.7 for x in numbers(3)]
    shares = [x - math.floor(x.value) for x in (a * 7 for a in u)]
    rests = [1 - s for s in shares]
    corners = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        corners.append(
            [rests[a] * rests[b], rests[a] * shares[b], shares[a] * rests[b], shares[a] * shares[b]]
        )
    return shares, corners, rests


def plane_value(corners: list[Number]) -> Number:
    p = numbers(4)
    return p[0] * corners[0] + p[1] * corners[1] + p[2] * corners[2] + p[3] * corners[3]


def line_value(share: Number, rest: Number) -> Number:
    low, high = numbers(2)
    return low * rest + high * share


def products(channels: int) -> list[Number]:
    shares, corners, rests = place()
    return [
        plane_value(corners[k]) * line_value(shares[2 - k], rests[2 - k])
        for k in range(3)
        for _ in range(channels)
    ]


def add_gradients(channels: int, upstream: list[Number]) -> None:
    shares, corners, rests = place()
    for k in range(3):
        for c in range(channels):
            g = upstream[k * channels + c]
            on_plane = line_value(shares[2 - k], rests[2 - k]) * g
            on_line = plane_value(corners[k]) * g
            for weight in corners[k]:
                Number() + on_plane * weight
            Number() + on_line * rests[2 - k]
            Number() + on_line * shares[2 - k]


def test_density_by_counting() -> None:
    features = products(COUNTS.density_channels)
    total = features[0]
    for one in features[1:]:
        total = total + one
    ((total + -10.0).f() + 1).f() * 25.0
    assert work(COUNTS)["density"].operations == COUNTS.samples * Number.done


def test_appearance_by_counting() -> None:
    products(COUNTS.appearance_channels)
    assert work(COUNTS)["colour/lookup"].operations == COUNTS.coloured * Number.done


def test_backward_lookups_by_counting() -> None:
    add_gradients(COUNTS.appearance_channels, numbers(9))
    assert work(COUNTS)["backward/lookup"].operations == COUNTS.coloured * Number.done
    Number.done = 0
    upstream = Number() * ((Number() / -25.0).f() * -25.0)
    of_slope, Number.done = Number.done, 0
    add_gradients(COUNTS.density_channels, [upstream] * 6)
    expected = COUNTS.samples * of_slope + COUNTS.nonzero * Number.done
    assert work(COUNTS)["backward/density"].operations == expected


def encode(dims: int, octaves: int) -> None:
    for x in numbers(dims):
        if octaves:
            sine, cosine = x.f(), x.f()
        for _ in range(octaves - 1):
            doubled = 2 * sine
            sine, cosine = doubled * cosine, 1 - doubled * sine


def multiply(rows: int, columns: int) -> None:
    """One row times a matrix, with a bias."""
    for _ in range(columns):
        total = Number()
        for x in numbers(rows):
            total = total + x * Number()


def test_network_by_counting() -> None:
    c = COUNTS
    encode(*c.encodings[0])
    encode(*c.encodings[2])
    for x in numbers(3):
        1 / (1 + x.f())
    by_sample = Number.done
    Number.done = 0
    encode(*c.encodings[1])
    by_ray = Number.done
    Number.done = 0
    multiply(3 * c.appearance_channels, c.features)
    multiply(c.layers[0], c.layers[1])
    multiply(c.layers[1], c.layers[2])
    found = work(c)["colour/network"]
    assert found.operations == c.coloured * by_sample + c.rays * by_ray
    assert found.low == c.coloured * Number.done
    single = work(replace(c, low=False))["colour/network"]
    assert (single.operations, single.low) == (found.operations + found.low, 0)


def test_network_backward_by_counting() -> None:
    c = COUNTS
    wide, hidden, out = c.layers
    wanted = c.encodings[0][0] * (1 + 2 * c.encodings[0][1])
    components = 3 * c.appearance_channels
    # Gradients of weights are products of a column and a row; of inputs, products with the matrix.
    for rows, columns, back in (
        (wide, hidden, wanted),
        (hidden, out, hidden),
        (components, c.features, components),
    ):
        for _ in range(rows * columns):
            Number() + Number() * Number()
        multiply(columns, back)
    assert work(c)["backward/network"].low == c.coloured * Number.done
    Number.done = 0
    for _ in range(c.encodings[0][0] * c.encodings[0][1]):
        sine, cosine, of_sine, of_cosine = numbers(4)
        Number() + 2.0 * (cosine * of_sine - sine * of_cosine)
    assert work(c)["backward/network"].operations == c.coloured * Number.done
    assert layer_operations_backward((2, 3), 0) == 2 * 2 * 3
    assert encoding_operations(4, 0) == 0


def test_march_and_compositing_by_counting() -> None:
    t = Number() + (Number() + 0.5) * 0.1
    for origin, direction in zip(numbers(3), numbers(3), strict=True):
        origin + t * direction
    assert work(COUNTS)["march"].operations == COUNTS.samples * Number.done
    Number.done = 0
    through = (Number() * -0.1).f()
    weight = Number() * (1 - through)
    Number() * through
    _ = Number() + weight * t, Number() + weight
    by_sample = Number.done
    Number.done = 0
    _ = [Number() + weight * x for x in numbers(3)]
    by_colour = Number.done
    Number.done = 0
    rest = 1 - Number()
    _ = [Number() + rest * x for x in numbers(3)]
    expected = COUNTS.samples * by_sample + COUNTS.coloured * by_colour + COUNTS.rays * Number.done
    assert work(COUNTS)["compositing"].operations == expected


def test_optimiser_by_counting() -> None:
    m, v, g = numbers(3)
    m = m + 0.1 * (g - m)
    v = 0.99 * v + 0.01 * (g * g)
    Number() - 0.02 * (m / (v.f() * 1.1 + 1e-8))
    assert work(COUNTS)["optimiser"].operations == COUNTS.parameters * Number.done
    assert work(COUNTS)["optimiser"].bytes == COUNTS.parameters * 2 * 4 * 4


def test_bytes_of_lookups_by_hand() -> None:
    # Two samples, one channel: 2 x 12 bytes of positions, 2 x 4 of densities, and 5 nodes of 4 bytes.
    assert density_work(2, 1, 5).bytes == 24 + 8 + 20
    # Through the caches every sample reads 4 nodes of three planes and 2 of three lines.
    assert density_work(2, 1, 5).cached == 24 + 8 + 2 * 3 * 6 * 4
    found = work(COUNTS)
    c = COUNTS
    # In bfloat16 a component has 2 bytes, else 4.
    row = 3 * c.appearance_channels * 2
    single = work(replace(c, low=False))
    assert single["colour/lookup"].bytes - found["colour/lookup"].bytes == c.coloured * row
    assert single["backward/network"].bytes - found["backward/network"].bytes == c.coloured * 2 * row
    assert (
        found["colour/lookup"].bytes
        == c.coloured * (12 + row) + c.appearance_nodes * c.appearance_channels * 4
    )
    gradients = 3 * c.appearance_nodes * c.appearance_channels * 4
    assert found["backward/lookup"].bytes == c.coloured * (12 + row) + gradients
    assert found["march"].bytes == 5 * 36 + 6 * 8 + 27 + 11 * 24
    weights = 9 * 4 + c.layers[0] * 6 + 6 * 3
    assert found["colour/network"].bytes == c.coloured * (row + 32) + 4 * weights
    assert list(found) == re.findall(r"^    ([a-z]+(?:/[a-z]+)?) {2,}[\d(]", str(work_module.__doc__), re.M)
