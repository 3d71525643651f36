"""Perceptrons: the reference and both precisions of the kernels, against float64."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gridreg.encodings import positional_encoding
from gridreg.errors import InputError
from gridreg.ops import Block, Layer, encoded_mlp, mlp, product_dtype, use_backend
from gridreg.ops.cpu.mlp import fused
from gridreg.ops.cpu.mlp.encodings import MOST_OCTAVES
from gridreg.ops.cpu.mlp.gemm import GRADIENT_ROWS, TASKS, TILE_ROWS, WIDEST
from gridreg.ops.cpu.mlp.gemm_tile import BF16, F32

precisions = pytest.mark.parametrize("precision", ["float32", "bfloat16"])
DTYPES = {"bfloat16": torch.bfloat16, "float32": torch.float32}
COUNTS = st.sampled_from([0, 1, 2, 7, 8, 9, 31, 33, 64, 65, 700, 1500])


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


def by_hand(blocks, layers):
    """In float64."""
    parts = []
    for block in blocks:
        encoded = positional_encoding(block.x.double(), block.octaves, "octave")
        parts.append(encoded if block.rows is None else encoded[block.rows])
    value = torch.cat(parts, dim=-1)
    for place, (weight, bias) in enumerate(layers):
        value = (value.clamp(min=0) if place else value) @ weight.double().T
        value = value if bias is None else value + bias.double()
    return value


def slopes(found, inputs):
    """Gradients of a random sum of the output."""
    seed = draw(*found.shape, seed=9).to(found.dtype)
    return torch.autograd.grad(found, [x for x in inputs if x is not None], seed)


@precisions
@settings(deadline=None)
@given(
    count=COUNTS,
    dims=st.lists(st.integers(1, 19), min_size=1, max_size=3),
    octaves=st.integers(0, 3),
    hidden=st.lists(st.integers(1, 70), max_size=3),
    out=st.integers(1, 20),
    bias=st.booleans(),
    chosen=st.integers(0, 7),
    rays=st.booleans(),
)
def test_it_is_the_network_on_the_encodings(precision, count, dims, octaves, hidden, out, bias, chosen, rays):
    blocks = [Block(draw(count, dim, seed=k), (octaves + k) % 4) for k, dim in enumerate(dims)]
    wanted = [block.x.requires_grad_() for k, block in enumerate(blocks) if chosen >> k & 1]
    if rays:
        blocks.insert(len(blocks) // 2, Block(draw(5, 3, seed=7), 2, torch.arange(count) % 5))
    layers = network([sum(block.width for block in blocks), *hidden, out], bias)
    found, expected = encoded_mlp(blocks, layers, precision=precision), by_hand(blocks, layers)
    assert found.shape == (count, out)
    assert found.dtype == torch.float32
    # In bfloat16 a unit may cross the edge of its ReLU, which weighs too much among few samples.
    value, slope = (0.03, 0.25) if precision == "bfloat16" else (2e-5, 2e-4)
    assert (found - expected).norm() <= value * expected.norm() + 1e-5
    inputs = [*wanted, *(tensor for layer in layers for tensor in layer)]
    for a, b in zip(slopes(found, inputs), slopes(expected, inputs), strict=True):
        assert a.dtype == torch.float32
        assert a.shape == b.shape
        if precision == "float32" or count > 500:
            assert (a - b).norm() <= slope * b.norm() + 1e-3


@precisions
def test_gradients_are_those_of_the_network(precision):
    """Where no unit is near its edge, only rounding is left."""
    blocks = [Block(draw(300, 27).requires_grad_(), 2), Block(draw(300, 3, seed=1), 6)]
    layers = network([sum(block.width for block in blocks), 32, 3])
    with torch.no_grad():
        layers[0].bias.add_(torch.where(torch.arange(32) % 2 == 0, 9.0, -9.0))
    found, expected = encoded_mlp(blocks, layers, precision=precision), by_hand(blocks, layers)
    bound = 0.005 if precision == "bfloat16" else 1e-6
    assert (found - expected).norm() <= bound * expected.norm()
    inputs = [blocks[0].x, *(tensor for layer in layers for tensor in layer)]
    for a, b in zip(slopes(found, inputs), slopes(expected, inputs), strict=True):
        assert (a - b).norm() <= 2 * bound * b.norm()


@settings(max_examples=60, deadline=None)
@given(
    count=st.sampled_from([1, 2, 7, 8, 31, 33, 65]) | st.integers(1, 200),
    width=st.sampled_from([1, 3, 16, 27, 32, 33, 48, 128, 135, 224]) | st.integers(1, WIDEST),
    out=st.sampled_from([1, 3, 16, 27, 32, 33, 48, 128]) | st.integers(1, WIDEST),
)
def test_one_layer_of_bfloat16_sums_exact_products(count, width, out):
    """Given bfloat16, only the gradient of the input is rounded."""
    x = draw(count, width).bfloat16().requires_grad_()
    weight, bias = draw(out, width, seed=1).bfloat16().float().requires_grad_(), draw(out).requires_grad_()
    found = mlp(x, [(weight, bias)], precision="bfloat16")
    expected = x.double() @ weight.double().T + bias.double()
    assert found.dtype == torch.float32
    upstream = draw(count, out, seed=3).bfloat16()
    ours = torch.autograd.grad(found, (weight, bias, x), upstream.float())
    theirs = torch.autograd.grad(expected, (weight, bias, x), upstream.double())
    assert ours[2].dtype == torch.bfloat16
    for a, b, bound in zip((found, *ours), (expected, *theirs), (1e-5, 1e-5, 1e-5, 2**-8), strict=True):
        assert a.shape == b.shape
        assert (a - b).detach().abs().max() <= bound * b.detach().abs().max().clamp(min=1)


@pytest.mark.parametrize("width", [32, 40])
@precisions
def test_an_input_that_is_read_as_it_is(precision, width):
    """One block without octaves, as wide as a vector or not, in the precision of the products or not."""
    for dtype in (torch.float32, DTYPES[precision]):
        x, layers = draw(45, width).to(dtype).requires_grad_(), network([width, 24, 3])
        found, expected = mlp(x, layers, precision=precision), by_hand([Block(x, 0)], layers)
        bound = 0.02 if precision == "bfloat16" else 1e-5
        assert (found - expected).norm() <= bound * expected.norm()
        (slope,) = slopes(found, [x])
        assert slope.dtype == dtype
        assert (slope - slopes(expected, [x])[0]).norm() <= 10 * bound * slope.norm()


def test_auto_follows_the_processor(monkeypatch):
    x, layers = draw(30, 15), network([15, 8, 3])
    for fast, precision in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(fused, "has", lambda feature, fast=fast: fast)
        assert product_dtype("auto") == DTYPES[precision]
        assert torch.equal(mlp(x, layers), mlp(x, layers, precision=precision))


@precisions
def test_numbers_do_not_depend_on_threads(precision):
    blocks = [Block(draw(3000, 27).requires_grad_(), 2), Block(draw(9, 3), 6, torch.arange(3000) % 9)]
    layers = network([sum(block.width for block in blocks), 128, 128, 3])
    inputs = [blocks[0].x, *(tensor for layer in layers for tensor in layer)]
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out = encoded_mlp(blocks, layers, precision=precision)
            found.append([out, *slopes(out, inputs)])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)


@precisions
def test_a_sample_does_not_depend_on_its_company(precision):
    rays = torch.arange(1500) % 7
    blocks = [Block(draw(1500, 9), 2), Block(draw(7, 3, seed=1), 3, rays)]
    layers = network([45 + 21, 32, 32, 3])
    whole = encoded_mlp(blocks, layers, precision=precision)
    for part in (slice(0, 40), slice(800, 1413), slice(1497, 1500)):
        some = [blocks[0]._replace(x=blocks[0].x[part]), blocks[1]._replace(rows=rays[part])]
        assert torch.equal(encoded_mlp(some, layers, precision=precision), whole[part])


@precisions
def test_what_is_not_a_number_stays_in_its_row(precision):
    x = draw(100, 9)
    x[40, 3] = float("nan")
    found = encoded_mlp([Block(x, 2)], network([45, 16, 3]), precision=precision)
    assert bool(found[40].isnan().all())
    assert not bool(found[:40].isnan().any() or found[41:].isnan().any())


def test_blocks_of_rows_end_within_what_is_there():
    """Both passes read and write whole tiles, and those of the backward pass begin at any row."""
    assert max(F32.rows, BF16.rows) == TILE_ROWS
    for count in range(1, 3000):
        ends = [-(-count // TILE_ROWS) * TILE_ROWS]
        for task in range(TASKS):
            end = count * (task + 1) // TASKS
            for first in range(count * task // TASKS, end, GRADIENT_ROWS):
                ends.append(first + -(-min(GRADIENT_ROWS, end - first) // TILE_ROWS) * TILE_ROWS)
        assert max(ends) <= fused.padded_rows(count)


@pytest.fixture
def runs(monkeypatch) -> list[torch.dtype]:
    """Precisions in which kernels ran."""
    found: list[torch.dtype] = []
    compiled = encoded_mlp.compiled

    def spied(blocks, layers, *, precision="auto") -> Tensor:
        found.append(product_dtype(precision))
        return compiled(blocks, layers, precision=precision)

    monkeypatch.setattr(encoded_mlp, "compiled", spied)
    return found


@precisions
def test_what_the_kernels_do_not_take_the_reference_does(precision, runs):
    layers = network([45, 512, 3])
    direction = draw(4, 9).requires_grad_()
    for blocks, some, taken in (
        ([Block(draw(3, 9), 2)], layers, True),
        ([Block(draw(3, 9), 2)], network([45, 513, 3]), False),
        ([Block(draw(3, 103), 2)], network([515, 16, 3]), False),
        ([Block(draw(3, 1), MOST_OCTAVES)], network([2 * MOST_OCTAVES + 1, 4]), True),
        ([Block(draw(3, 1), MOST_OCTAVES + 1)], network([2 * MOST_OCTAVES + 3, 4]), False),
        ([Block(direction, 2, torch.tensor([0, 1, 3]))], layers, False),
        ([Block(draw(3, 9).double(), 2)], [Layer(w.double(), b.double()) for w, b in layers], False),
        ([Block(draw(0, 9), 2)], layers, False),
    ):
        runs.clear()
        found, expected = encoded_mlp(blocks, some, precision=precision), by_hand(blocks, some)
        assert runs == [DTYPES[precision]] * taken
        assert found.dtype == some[0].weight.dtype
        bound = 0.02 if taken and precision == "bfloat16" else 1e-5
        assert (found - expected).norm() <= bound * expected.norm()


def test_one_product_of_float32_is_torch_s_own(runs):
    x, layers = draw(6, 4), network([4, 3])
    found = mlp(x, layers, precision="float32")
    assert torch.equal(found, torch.nn.functional.linear(x, *layers[0]))
    assert runs == []


def test_the_plain_backend_is_taken_when_chosen(runs):
    blocks, layers = [Block(draw(10, 3), 2)], network([15, 8, 3])
    with use_backend("torch"):
        plain = encoded_mlp(blocks, layers, precision="bfloat16")
    assert (plain - by_hand(blocks, layers)).norm() <= 1e-5 * plain.norm()
    assert runs == []


def test_the_reference_has_gradients_of_all():
    weights = [layer.weight.detach().double().requires_grad_() for layer in network([27, 5, 3])]
    x, direction = draw(6, 4).double().requires_grad_(), draw(2, 5).double().requires_grad_()
    rows = torch.tensor([0, 0, 0, 1, 1, 1])

    def whole(x, direction, *weights):
        blocks = [Block(x, 1), Block(direction, 1, rows)]
        return encoded_mlp(blocks, [(weight, None) for weight in weights])

    assert torch.autograd.gradcheck(whole, (x, direction, *weights))


@precisions
def test_parts_without_gradients(precision):
    x, layers = draw(6, 4), network([4, 5, 3])
    layers[0].weight.requires_grad_(False)
    mlp(x, layers, precision=precision).sum().backward()
    assert layers[0].weight.grad is None
    assert x.grad is None
    assert layers[0].bias.grad is not None
    assert layers[1].weight.grad is not None


@precisions
def test_columns_of_a_weight(precision):
    """Weights may be views and masked tensors, as decoders pass them; inputs need not be contiguous."""
    whole, x = draw(5, 9).requires_grad_(), draw(4, 6).T
    mask = torch.tensor([1.0, 1.0, 0.0, 0.0])
    found = mlp(x, [(whole[:, 2:6] * mask, None), (torch.eye(5), None)], precision=precision)
    bound = 0.02 if precision == "bfloat16" else 1e-6
    torch.testing.assert_close(found, ((x * mask) @ whole[:, 2:6].T).clamp(min=0), rtol=bound, atol=bound)
    found.sum().backward()
    assert torch.count_nonzero(whole.grad[:, [0, 1, 4, 5, 6, 7, 8]]) == 0


def test_bad_arguments_are_named():
    x, layers = torch.zeros(4, 2), [Layer(torch.zeros(3, 2), None)]
    for blocks, some, text in (
        ([], layers, "blocks: found none"),
        ([(x, 0), (torch.zeros(5, 1), 0)], layers, r"blocks\[1\]: found x \(5, 1\) with 5 samples"),
        ([(x, -1)], layers, "-1 octaves"),
        ([(x, 1)], layers, r"layers\[0\]: found a weight \(3, 2\), expected \(out, 6\)"),
        ([(x, 0)], [], "layers: found none, expected at least one"),
        ([(x, 0)], [(layers[0].weight, torch.zeros(2))], r"expected \(3,\)"),
    ):
        with pytest.raises(InputError, match=text):
            encoded_mlp(blocks, some)
    with pytest.raises(InputError, match="precision: found 'half'"):
        encoded_mlp([(x, 0)], layers, precision="half")
    with pytest.raises(InputError, match=r"x: found shape \(2,\), expected \(N, in\)"):
        mlp(torch.zeros(2), layers)
