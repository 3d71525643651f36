"""Products of bfloat16 by the processor's dot products, against float64 products of the same numbers."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops import mlp
from gridreg.ops.cpu.mlp import dots
from gridreg.ops.cpu.mlp import gemm_tile as register_blocks
from gridreg.ops.cpu.mlp.dots import multiply, pack, weight_gradient

native = pytest.mark.skipif(not dots.available(), reason="the processor has no dot products of bfloat16")

rows = st.sampled_from([1, 2, 7, 8, 31, 33, 65]) | st.integers(1, 200)
columns = st.sampled_from([1, 3, 16, 27, 32, 33, 48, 128, 135, 224]) | st.integers(1, dots.WIDEST)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).bfloat16()


def close(found: Tensor, expected: Tensor, scale: Tensor, relative: float) -> None:
    assert found.shape == expected.shape
    assert float((found.double() - expected).abs().max()) <= relative * float(scale.abs().max()) + 1e-30


@native
@settings(max_examples=60, deadline=None)
@given(count=rows, width=columns, height=columns)
def test_products_and_their_endings(count, width, height):
    x, weight, bias = draw(count, width), draw(height, width, seed=1).float(), draw(height, seed=2).float()
    product = x.double() @ weight.double().T
    packed = pack(weight)
    full = multiply(x, packed, bias=bias, dtype=torch.float32)
    assert full.is_contiguous()
    assert full.shape[0] % 8 == full.shape[1] % 16 == 0
    close(full[:count, :height], product + bias, product, 1e-5)
    close(multiply(x, packed)[:count, :height], product, product, 2**-8)
    hidden = multiply(x, packed, bias=bias, relu=True)
    close(hidden[:count, :height], (product + bias).clamp(min=0), product + bias, 2**-8)
    slope = draw(count, 5, seed=3)
    back = draw(height, 5, seed=4).float()
    gated = multiply(slope, pack(back), gates=hidden)
    expected = (slope.double() @ back.double().T) * (hidden[:count, :height] > 0)
    close(gated[:count, :height], expected, expected, 2**-8)


@native
@settings(max_examples=60, deadline=None)
@given(count=rows, width=columns, height=columns)
def test_sums_over_rows(count, width, height):
    slope, x = draw(count, height), draw(count, width, seed=1)
    of_weight, of_bias = weight_gradient(slope, x)
    expected = slope.double().T @ x.double()
    close(of_weight, expected, expected, 1e-5)
    close(of_bias, slope.double().sum(0), slope.double().abs().sum(0), 1e-5)


@native
def test_no_rows():
    assert multiply(draw(0, 5), pack(draw(3, 5).float()), dtype=torch.float32).shape == (0, 16)
    of_weight, of_bias = weight_gradient(draw(0, 3), draw(0, 5))
    assert torch.equal(of_weight, torch.zeros(3, 5))
    assert torch.equal(of_bias, torch.zeros(3))


@native
def test_what_is_not_a_number_stays_in_its_row():
    x, weight = draw(40, 6), draw(20, 6, seed=1).float()
    x[17, 2] = float("nan")
    for relu in (False, True):
        found = multiply(x, pack(weight), relu=relu)[:40, :20]
        assert bool(found[17].isnan().all())
        assert not bool(found[:17].isnan().any() or found[18:].isnan().any())


@native
def test_results_do_not_depend_on_threads():
    x, slope, weight = draw(3000, 50), draw(3000, 40, seed=1), draw(40, 50, seed=2).float()
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append((multiply(x, pack(weight)), *weight_gradient(slope, x)))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


@native
@pytest.mark.parametrize("width", [40, dots.WIDEST + 1])
def test_perceptrons_agree_with_onednn(monkeypatch, width):
    x = draw(300, 30).float().requires_grad_()
    layers = [
        (F.normalize(draw(width, 30, seed=1).float()).requires_grad_(), draw(width).float().requires_grad_()),
        (F.normalize(draw(3, width, seed=2).float()).requires_grad_(), draw(3).float().requires_grad_()),
    ]
    inputs = [x, *(tensor for layer in layers for tensor in layer)]
    results = []
    for use in (True, False):
        monkeypatch.setattr(dots, "available", lambda use=use: use)
        out = mlp(x, layers, precision="bfloat16")
        results.append([out.detach(), *torch.autograd.grad(out.square().sum(), inputs)])
    for ours, theirs in zip(*results, strict=True):
        assert float((ours - theirs).norm()) <= 0.02 * float(theirs.norm())


def test_an_emulated_processor_is_not_trusted(monkeypatch):
    """numba may be told to compile for another processor than this one."""
    register_blocks.has.cache_clear()
    monkeypatch.setattr(register_blocks.config, "CPU_NAME", "generic")
    try:
        assert dots.available() is False
    finally:
        register_blocks.has.cache_clear()
