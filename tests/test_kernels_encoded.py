"""Perceptrons on encodings in one pass, against encodings and layers in float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gridreg.encodings import positional_encoding
from gridreg.errors import InputError
from gridreg.ops import Block, encoded_mlp, use_backend
from gridreg.ops.cpu.jit.bfloat16 import load_low, store_low
from gridreg.ops.cpu.jit.compiler import float32, kernel, next_task, uint16, vector
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, wide
from gridreg.ops.cpu.mlp.chain import CHUNK, CHUNK_TAIL, padded_rows
from gridreg.ops.linear import Layer


def draw(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@kernel
def _round_trip(table) -> None:
    x, low, back = vector(table, 0, float32), vector(table, 1, uint16), vector(table, 2, float32)
    while next_task(table) >= 0:
        split = x.shape[0] - x.shape[0] % LANES
        for i in range(0, split, LANES):
            store_low(low, i, load(x, i, wide()))
            store(back, i, load_low(low, i, wide()))
        for i in range(split, x.shape[0]):
            store_low(low, i, load(x, i, one()))
            store(back, i, load_low(low, i, one()))


def test_numbers_round_to_bfloat16_as_torch_rounds_them():
    special = [
        0.0,
        -0.0,
        1.0,
        float("inf"),
        -float("inf"),
        float("nan"),
        1e-40,
        3.4e38,
        1.00390625,
        1.01171875,
    ]
    x = torch.cat([torch.tensor(special), draw(1000) * 10.0 ** draw(1000, seed=1)])
    low, back = torch.empty(len(x), dtype=torch.bfloat16), torch.empty(len(x))
    launch(_round_trip, 1, x, low, back)
    np.testing.assert_array_equal(low.float().numpy(), x.bfloat16().float().numpy())
    np.testing.assert_array_equal(back.numpy(), low.float().numpy())


def case(count, hidden, octaves, seed=0, bias=True):
    """Blocks as a decoder has them, and layers."""
    rays = torch.randint(0, 7, (count,), generator=torch.Generator().manual_seed(seed))
    blocks = [
        Block(draw(count, 9, seed=seed).requires_grad_(), octaves[0]),
        Block(draw(7, 3, seed=seed + 1), octaves[1], rays),
        Block(draw(count, 3, seed=seed + 2), octaves[2]),
    ]
    sizes = [sum(block.width for block in blocks), *hidden, 3]
    layers = [
        Layer(
            draw(b, a, seed=a + b, scale=a**-0.5).requires_grad_(),
            draw(b, seed=b, scale=0.3).requires_grad_() if bias else None,
        )
        for a, b in pairwise(sizes)
    ]
    return blocks, layers


def by_hand(blocks, layers):
    parts = []
    for block in blocks:
        x = block.x.double() if block.rows is None else block.x.double()[block.rows]
        parts.append(positional_encoding(x, block.octaves, "octave"))
    value = torch.cat(parts, dim=-1)
    for place, (weight, bias) in enumerate(layers):
        value = value @ weight.double().T
        value = value if bias is None else value + bias.double()
        value = value if place + 1 == len(layers) else value.clamp(min=0)
    return value


@pytest.mark.parametrize(("precision", "value", "slope"), [("float32", 2e-5, 2e-4), ("bfloat16", 3e-2, 0.25)])
@given(
    count=st.sampled_from([0, 1, 5, CHUNK_TAIL, CHUNK_TAIL + 1]),
    hidden=st.sampled_from([(), (16,), (24, 17)]),
    octaves=st.tuples(*[st.integers(0, 4)] * 3),
    bias=st.booleans(),
)
def test_it_is_the_network_on_the_encodings(precision, value, slope, count, hidden, octaves, bias):
    blocks, layers = case(count, hidden, octaves, bias=bias)
    found, expected = encoded_mlp(blocks, layers, precision=precision), by_hand(blocks, layers)
    assert found.shape == (count, 3)
    assert found.dtype == torch.float32
    if not count:
        return
    assert (found - expected).norm() <= value * expected.norm()
    if precision == "bfloat16" and count < CHUNK_TAIL:
        # One unit at the edge of its ReLU weighs too much among few samples.
        return
    inputs = [blocks[0].x, *[t for layer in layers for t in layer if t is not None]]
    seed = draw(count, 3, seed=9)
    results = (
        torch.autograd.grad(found, inputs, seed),
        torch.autograd.grad(expected, inputs, seed.double()),
    )
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= slope * b.norm() + 1e-6


def test_in_bfloat16_a_sample_does_not_depend_on_its_company():
    blocks, layers = case(CHUNK + CHUNK_TAIL + 77, (32, 32), (2, 2, 2))
    whole = encoded_mlp(blocks, layers, precision="bfloat16")
    for part in (slice(0, 40), slice(CHUNK - 10, CHUNK + 600), slice(len(whole) - 3, len(whole))):
        some = [
            block._replace(x=block.x[part]) if block.rows is None else block._replace(rows=block.rows[part])
            for block in blocks
        ]
        assert torch.equal(encoded_mlp(some, layers, precision="bfloat16"), whole[part])


def test_several_chunks_sum_their_gradients():
    blocks, layers = case(CHUNK + 600, (16,), (1, 1, 1))
    found, expected = encoded_mlp(blocks, layers, precision="bfloat16"), by_hand(blocks, layers)
    weights = [t for layer in layers for t in layer]
    for a, b in zip(
        torch.autograd.grad(found.square().mean(), weights),
        torch.autograd.grad(expected.square().mean(), weights),
        strict=True,
    ):
        assert (a - b).norm() <= 0.03 * b.norm()


def test_what_is_given_by_ray_may_need_a_gradient():
    blocks, layers = case(20, (16,), (1, 2, 0))
    direction = blocks[1].x.requires_grad_()
    found = torch.autograd.grad(encoded_mlp(blocks, layers, precision="float32").sum(), direction)[0]
    expected = torch.autograd.grad(by_hand(blocks, layers).sum(), direction)[0]
    torch.testing.assert_close(found, expected.to(found), atol=1e-4, rtol=1e-3)


def test_rays_alone_and_two_sets_of_rays():
    blocks, layers = case(20, (16,), (1, 2, 0))
    for some in ([blocks[1]], [blocks[1], blocks[1]], [blocks[1], blocks[0]]):
        width = sum(block.width for block in some)
        first = [(layers[0].weight[:, :width], layers[0].bias), layers[1]]
        if width > layers[0].weight.shape[1]:
            first = [(draw(16, width), None), layers[1]]
        for precision, bound in (("float32", 1e-5), ("bfloat16", 3e-2)):
            found, expected = encoded_mlp(some, first, precision=precision), by_hand(some, first)
            assert (found - expected).norm() <= bound * expected.norm()


def test_the_plain_backend_is_taken_when_chosen():
    blocks, layers = case(10, (8,), (2, 2, 2))
    with use_backend("torch"):
        plain = encoded_mlp(blocks, layers)
    expected = by_hand(blocks, layers)
    assert (plain - expected).norm() <= 1e-5 * expected.norm()


@pytest.mark.parametrize(("count", "rows"), [(0, 0), (1, CHUNK_TAIL), (CHUNK_TAIL, CHUNK_TAIL)])
def test_rows_are_padded_to_few_shapes(count, rows):
    assert padded_rows(count) == rows


def test_bad_arguments_are_named():
    x, layers = torch.zeros(4, 2), [Layer(torch.zeros(3, 2), None)]
    for blocks, some, text in (
        ([], layers, "blocks: found none"),
        ([(x, 0), (torch.zeros(5, 1), 0)], layers, r"blocks\[1\]: found x \(5, 1\) with 5 samples"),
        ([(x, -1)], layers, "-1 octaves"),
        ([(x, 1)], layers, r"layers\[0\]: found a weight \(3, 2\), expected \(out, 6\)"),
        ([(x, 0)], [], "layers: found none"),
    ):
        with pytest.raises(InputError, match=text):
            encoded_mlp(blocks, some)
    with pytest.raises(InputError, match="precision: found 'half'"):
        encoded_mlp([(x, 0)], layers, precision="half")
