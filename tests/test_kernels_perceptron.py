"""The perceptron in one kernel against the same layer by layer, and against float64."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import textwrap
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gridreg.ops import Block, encoded_mlp
from gridreg.ops.cpu.jit.compiler import float32, kernel, next_task, uint16, vector
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, wide
from gridreg.ops.cpu.mlp import gemm_bf16 as dot_blocks
from gridreg.ops.cpu.mlp import gemm_f32 as fma_blocks
from gridreg.ops.cpu.mlp.fused import fits, rows_of
from gridreg.ops.cpu.mlp.gemm_bf16 import HIGH, lower
from gridreg.ops.cpu.mlp.gemm_tile import SUMMED, TASKS
from gridreg.ops.linear import Layer

native = pytest.mark.skipif(
    not dot_blocks.available(), reason="the processor has no dot products of bfloat16"
)
precisions = pytest.mark.parametrize("precision", [pytest.param("bfloat16", marks=native), "float32"])
DTYPES = {"bfloat16": torch.bfloat16, "float32": torch.float32}


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


def results(blocks, layers, wanted, precision):
    """Value, and gradients of the wanted blocks and of all layers."""
    found = encoded_mlp(blocks, layers, precision=precision)
    inputs = [blocks[place].x for place in wanted]
    inputs += [tensor for layer in layers for tensor in layer if tensor is not None]
    seed = draw(*found.shape, seed=9)
    return [found.detach(), *torch.autograd.grad(found, inputs, seed)]


@precisions
@given(
    count=st.sampled_from([1, 2, 7, 8, 9, 31, 33, 64, 65, 700, 1500]),
    dims=st.lists(st.integers(1, 19), min_size=1, max_size=3),
    octaves=st.integers(0, 3),
    hidden=st.lists(st.integers(1, 70), max_size=3),
    out=st.integers(1, 20),
    bias=st.booleans(),
    chosen=st.integers(0, 7),
)
def test_one_kernel_is_the_layers_one_by_one(precision, count, dims, octaves, hidden, out, bias, chosen):
    blocks = [Block(draw(count, dim, seed=k), (octaves + k) % 4) for k, dim in enumerate(dims)]
    wanted = [k for k in range(len(dims)) if chosen >> k & 1]
    for k in wanted:
        blocks[k].x.requires_grad_()
    rays = Block(draw(5, 3, seed=7), 2, torch.arange(count) % 5)
    blocks.insert(len(blocks) // 2, rays)
    wanted = [k + (k >= len(dims) // 2) for k in wanted]
    layers = network([sum(block.width for block in blocks), *hidden, out], bias)
    assert fits(blocks, layers, DTYPES[precision])
    fused = results(blocks, layers, wanted, precision)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules[encoded_mlp.__module__], "fits", lambda blocks, layers, dtype: False)
        apart = results(blocks, layers, wanted, precision)
    # Biases of the first layer are rounded there and not here; a unit may cross the edge of its ReLU.
    value, slope = (0.01, 0.1) if precision == "bfloat16" else (1e-5, 1e-3)
    for number, (a, b) in enumerate(zip(fused, apart, strict=True)):
        assert (a - b).norm() <= (value if number == 0 else slope) * b.norm() + 1e-5


@precisions
def test_gradients_are_those_of_the_network(precision):
    """Where no unit is near its edge, only rounding is left."""
    count = 300
    blocks = [Block(draw(count, 27).requires_grad_(), 2), Block(draw(count, 3, seed=1), 6)]
    layers = network([sum(block.width for block in blocks), 32, 3])
    with torch.no_grad():
        layers[0].bias.add_(torch.where(torch.arange(32) % 2 == 0, 9.0, -9.0))
    found = results(blocks, layers, [0], precision)
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
    bound = 0.005 if precision == "bfloat16" else 1e-6
    assert (found[0] - value).norm() <= bound * value.norm()
    for a, b in zip(found[1:], expected, strict=True):
        assert (a - b).norm() <= 2 * bound * b.norm()


@precisions
def test_numbers_do_not_depend_on_threads(precision):
    blocks = [Block(draw(3000, 27).requires_grad_(), 2), Block(draw(9, 3), 6, torch.arange(3000) % 9)]
    layers = network([sum(block.width for block in blocks), 128, 128, 3])
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(results(blocks, layers, [0], precision))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)


def test_blocks_of_rows_end_within_what_is_there():
    """Both passes read and write whole blocks of rows, and those of the backward pass begin anywhere."""
    assert HIGH >= fma_blocks.HIGH
    for count in range(1, 3000):
        ends = [-(-count // HIGH) * HIGH]
        for task in range(TASKS):
            end = count * (task + 1) // TASKS
            for first in range(count * task // TASKS, end, SUMMED):
                ends.append(first + -(-min(SUMMED, end - first) // HIGH) * HIGH)
        assert max(ends) <= rows_of(count)


@precisions
def test_what_is_not_a_number_stays_in_its_row(precision):
    x = draw(100, 9)
    x[40, 3] = float("nan")
    found = encoded_mlp([Block(x, 2)], network([45, 16, 3]), precision=precision)
    assert bool(found[40].isnan().all())
    assert not bool(found[:40].isnan().any() or found[41:].isnan().any())


@precisions
def test_what_is_too_wide_takes_another_way(precision):
    blocks, dtype = [Block(draw(3, 9), 2)], DTYPES[precision]
    assert fits(blocks, network([45, 512, 3]), dtype)
    assert not fits(blocks, network([45, 513, 3]), dtype)
    assert not fits([Block(draw(3, 103), 2)], network([515, 16, 3]), dtype)
    assert encoded_mlp([Block(draw(3, 103), 2)], network([515, 16, 3]), precision=precision).shape == (3, 3)


def test_what_a_processor_cannot_do_does_not_fit(monkeypatch):
    monkeypatch.setattr(dot_blocks, "available", lambda: False)
    blocks, layers = [Block(draw(3, 9), 2)], network([45, 16, 3])
    assert not fits(blocks, layers, torch.bfloat16)
    assert fits(blocks, layers, torch.float32)


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names a processor of x86")
def test_blocks_for_fewer_registers_give_the_same(tmp_path):
    """As on a processor with 16 registers of 8 float32: smaller blocks of results, compiled in a process of its own."""
    text = """
        import torch
        from gridreg.ops import Block, encoded_mlp
        from gridreg.ops.cpu.mlp import gemm_f32 as fma_blocks
        from gridreg.ops.linear import Layer

        def draw(*shape, seed=0):
            return torch.randn(shape, generator=torch.Generator().manual_seed(seed))

        assert fma_blocks.HIGH == 4
        x = draw(77, 9).requires_grad_()
        layers = [Layer(draw(40, 45, seed=1) / 7, draw(40, seed=2)), Layer(draw(5, 40, seed=3) / 6, None)]
        layers = [Layer(w.requires_grad_(), b if b is None else b.requires_grad_()) for w, b in layers]
        found = encoded_mlp([Block(x, 2)], layers, precision="float32")
        wanted = [x, layers[0].weight, layers[0].bias, layers[1].weight]
        slopes = torch.autograd.grad(found, wanted, draw(77, 5, seed=4))
        value = torch.cat([x, x.sin(), x.cos(), (2 * x).sin(), (2 * x).cos()], 1)
        value = (value @ layers[0].weight.T + layers[0].bias).relu() @ layers[1].weight.T
        torch.testing.assert_close(found, value, atol=1e-5, rtol=1e-5)
        for a, b in zip(slopes, torch.autograd.grad(value, wanted, draw(77, 5, seed=4))):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    """
    small = {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": "+sse4.2", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        env={**os.environ, **small, "GRIDREG_COMPILE_AHEAD": "0"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr


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
