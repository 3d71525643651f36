"""The perceptron in one kernel against the same layer by layer, and against float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from backbones.kernels import Block, dot_blocks, encoded, encoded_mlp
from backbones.kernels.compiler import float32, kernel, next_task, uint16, vector
from backbones.kernels.dot_blocks import HIGH, SUMMED, TASKS, lower
from backbones.kernels.linear import Layer
from backbones.kernels.perceptron import fits, rows_of
from backbones.kernels.simd import LANES, load, wide
from backbones.kernels.threading import launch

native = pytest.mark.skipif(
    not dot_blocks.available(), reason="the processor has no dot products of bfloat16"
)


def draw(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def network(sizes, bias=True):
    return [
        Layer(
            draw(b, a, seed=a + b, scale=a**-0.5).requires_grad_(),
            draw(b, seed=b, scale=0.3).requires_grad_() if bias else None,
        )
        for a, b in pairwise(sizes)
    ]


def results(blocks, layers, wanted):
    """Value, and gradients of the wanted blocks and of all layers."""
    found = encoded_mlp(blocks, layers, precision="bfloat16")
    inputs = [blocks[place].x for place in wanted]
    inputs += [tensor for layer in layers for tensor in layer if tensor is not None]
    seed = draw(*found.shape, seed=9)
    return [found.detach(), *torch.autograd.grad(found, inputs, seed)]


@native
@given(
    count=st.sampled_from([1, 2, 7, 8, 9, 31, 33, 64, 65, 700, 1500]),
    dims=st.lists(st.integers(1, 19), min_size=1, max_size=3),
    octaves=st.integers(0, 3),
    hidden=st.lists(st.integers(1, 70), max_size=3),
    out=st.integers(1, 20),
    bias=st.booleans(),
    chosen=st.integers(0, 7),
)
def test_one_kernel_is_the_layers_one_by_one(count, dims, octaves, hidden, out, bias, chosen):
    blocks = [Block(draw(count, dim, seed=k), (octaves + k) % 4) for k, dim in enumerate(dims)]
    wanted = [k for k in range(len(dims)) if chosen >> k & 1]
    for k in wanted:
        blocks[k].x.requires_grad_()
    rays = Block(draw(5, 3, seed=7), 2, torch.arange(count) % 5)
    blocks.insert(len(blocks) // 2, rays)
    wanted = [k + (k >= len(dims) // 2) for k in wanted]
    layers = network([sum(block.width for block in blocks), *hidden, out], bias)
    assert fits(blocks, layers)
    fused = results(blocks, layers, wanted)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(encoded, "fits", lambda blocks, layers: False)
        apart = results(blocks, layers, wanted)
    for number, (a, b) in enumerate(zip(fused, apart, strict=True)):
        # Biases of the first layer are rounded there and not here; a unit may cross the edge of its ReLU.
        assert (a - b).norm() <= (0.01 if number == 0 else 0.1) * b.norm() + 1e-5


@native
def test_gradients_are_those_of_the_rounded_network():
    """Where no unit is near its edge, only rounding is left."""
    count = 300
    blocks = [Block(draw(count, 27).requires_grad_(), 2), Block(draw(count, 3, seed=1), 6)]
    layers = network([sum(block.width for block in blocks), 32, 3])
    with torch.no_grad():
        layers[0].bias.add_(torch.where(torch.arange(32) % 2 == 0, 9.0, -9.0))
    found = results(blocks, layers, [0])
    x = blocks[0].x.detach().double().requires_grad_()
    parts = []
    for value, k in ((x, 2), (blocks[1].x.double(), 6)):
        parts.append(value)
        for octave in range(k):
            parts += [(2**octave * value).sin(), (2**octave * value).cos()]
    weights = [
        (w.detach().double().requires_grad_(), b.detach().double().requires_grad_()) for w, b in layers
    ]
    value = (torch.cat(parts, 1) @ weights[0][0].T + weights[0][1]).clamp(min=0)
    value = value @ weights[1][0].T + weights[1][1]
    expected = torch.autograd.grad(
        value, [x, *(t for layer in weights for t in layer)], draw(*value.shape, seed=9).double()
    )
    assert (found[0] - value).norm() <= 0.005 * value.norm()
    for a, b in zip(found[1:], expected, strict=True):
        assert (a - b).norm() <= 0.01 * b.norm()


@native
def test_numbers_do_not_depend_on_threads():
    blocks = [Block(draw(3000, 27).requires_grad_(), 2), Block(draw(9, 3), 6, torch.arange(3000) % 9)]
    layers = network([sum(block.width for block in blocks), 128, 128, 3])
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(results(blocks, layers, [0]))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)


def test_blocks_of_rows_end_within_what_is_there():
    """Both passes read and write whole blocks of rows, and those of the backward pass begin anywhere."""
    for count in range(1, 3000):
        ends = [-(-count // HIGH) * HIGH]
        for task in range(TASKS):
            end = count * (task + 1) // TASKS
            for first in range(count * task // TASKS, end, SUMMED):
                ends.append(first + -(-min(SUMMED, end - first) // HIGH) * HIGH)
        assert max(ends) <= rows_of(count)


@native
def test_what_is_not_a_number_stays_in_its_row():
    x = draw(100, 9)
    x[40, 3] = float("nan")
    found = encoded_mlp([Block(x, 2)], network([45, 16, 3]), precision="bfloat16")
    assert bool(found[40].isnan().all())
    assert not bool(found[:40].isnan().any() or found[41:].isnan().any())


@native
def test_what_is_too_wide_takes_another_way():
    blocks = [Block(draw(3, 9), 2)]
    assert fits(blocks, network([45, 512, 3]))
    assert not fits(blocks, network([45, 513, 3]))
    assert not fits([Block(draw(3, 103), 2)], network([515, 16, 3]))
    assert encoded_mlp([Block(draw(3, 103), 2)], network([515, 16, 3])).shape == (3, 3)


@kernel
def _lowered(table) -> None:
    x, low = vector(table, 0, float32), vector(table, 1, uint16)
    while next_task(table) >= 0:
        for i in range(0, x.shape[0], LANES):
            lower(low, i, load(x, i, wide()))


@native
def test_numbers_round_to_bfloat16_as_torch_rounds_them():
    special = [0.0, -0.0, 1.0, float("inf"), -float("inf"), 3.4e38, 1.00390625, 1.01171875]
    x = torch.cat([torch.tensor(special), draw(800) * 10.0 ** draw(800, seed=1)])
    low = torch.empty(len(x), dtype=torch.bfloat16)
    launch(_lowered, 1, x, low)
    np.testing.assert_array_equal(low.float().numpy(), x.bfloat16().float().numpy())
    launch(_lowered, 1, torch.tensor([1e-40] * 4 + [float("nan")] * 4), low)
    assert low[:4].tolist() == [0.0] * 4
    assert bool(low[4:8].isnan().all())
