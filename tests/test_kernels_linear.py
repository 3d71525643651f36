"""Perceptrons through oneDNN against torch's own layers in float64."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.ops import linear, use_backend
from gridreg.ops.cpu.mlp import chain
from gridreg.ops.linear import Layer, bfloat16_is_fast, mlp


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)) / max(1, shape[-1]) ** 0.5


def make(sizes: list[int], bias: bool = True) -> list[Layer]:
    return [
        Layer(draw(b, a, seed=a + b).requires_grad_(), draw(b, seed=b).requires_grad_() if bias else None)
        for a, b in pairwise(sizes)
    ]


def by_hand(x, layers, offset=None, rows=None):
    for place, (weight, bias) in enumerate(layers):
        x = x @ weight.T + (0 if bias is None else bias)
        if place == 0 and offset is not None:
            x = x + (offset if rows is None else offset[rows])
        x = x if place + 1 == len(layers) else x.clamp(min=0)
    return x


def compare(found, expected, inputs, value: float, slope: float):
    """Largest errors of values and gradients, relative to the largest value of each tensor."""
    assert found.dtype == torch.float32
    assert found.shape == expected.shape
    if not found.numel():
        return
    assert (found - expected).abs().max() <= value * expected.abs().max()
    seed = draw(*found.shape, seed=9)
    given = [x for x in inputs if x is not None]
    for a, b in zip(
        torch.autograd.grad(found, given, seed),
        torch.autograd.grad(expected, given, seed.double()),
        strict=True,
    ):
        assert a.dtype == torch.float32
        assert (a - b).norm() <= slope * b.norm() + 1e-12


def doubles(layers):
    return [Layer(w.double(), None if b is None else b.double()) for w, b in layers]


@settings(max_examples=40, deadline=None)
@given(
    count=st.sampled_from([0, 1, 5, 64]),
    sizes=st.lists(st.integers(1, 40), min_size=2, max_size=4),
    bias=st.booleans(),
    kind=st.sampled_from(["none", "each", "rows"]),
)
def test_float32(count, sizes, bias, kind):
    x, layers = draw(count, sizes[0]).requires_grad_(), make(sizes, bias)
    rows = torch.sort(torch.randint(0, 3, (count,), generator=torch.Generator().manual_seed(0))).values
    rows = rows if kind == "rows" else None
    offset = (
        None if kind == "none" else draw(3 if kind == "rows" else count, sizes[1], seed=4).requires_grad_()
    )
    found = mlp(x, layers, offset=offset, rows=rows, precision="float32")
    expected = by_hand(x.double(), doubles(layers), None if offset is None else offset.double(), rows)
    compare(found, expected, (x, offset, *[t for layer in layers for t in layer]), 1e-5, 1e-4)


def test_bfloat16():
    """The documented tolerance: 2^-8 of what is summed; emulated where the processor does not have it."""
    x, layers = draw(300, 150).requires_grad_(), make([150, 128, 128, 3])
    offset = draw(20, 128, seed=5).requires_grad_()
    rows = torch.arange(300) // 15
    found = mlp(x, layers, offset=offset, rows=rows, precision="bfloat16")
    expected = by_hand(x.double(), doubles(layers), offset.double(), rows)
    compare(found, expected, (x, offset, *[t for layer in layers for t in layer]), 2**-7, 2**-4)
    assert not torch.equal(found, mlp(x, layers, offset=offset, rows=rows, precision="float32"))


def test_auto_follows_the_processor(monkeypatch):
    x, layers = draw(30, 15), make([15, 8, 3])
    for fast, precision in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(linear, "bfloat16_is_fast", lambda fast=fast: fast)
        assert torch.equal(mlp(x, layers), mlp(x, layers, precision=precision))
    assert isinstance(bfloat16_is_fast(), bool)


def test_without_onednn(monkeypatch):
    x, layers = draw(30, 15).requires_grad_(), make([15, 8, 3])
    monkeypatch.setattr(linear.torch._C, "_has_mkldnn", False)
    expected = by_hand(x.double(), doubles(layers))
    compare(mlp(x, layers, precision="float32"), expected, (x, *[t for p in layers for t in p]), 1e-5, 1e-4)


@pytest.mark.parametrize("supported", [False, True])
def test_onednn_is_asked_for_bfloat16_only_where_it_takes_it(monkeypatch, supported):
    """Without AVX-512 it raises, so torch's own product serves; float32 it always takes."""
    asked = []

    def stand_in(x, weight, bias, then, scalars, algorithm):
        asked.append(x.dtype)
        found = torch.nn.functional.linear(x, weight, bias)
        return found.relu() if then == "relu" else found

    known = SimpleNamespace(_linear_pointwise=stand_in, _is_mkldnn_bf16_supported=lambda: supported)
    monkeypatch.setattr(chain.torch.ops, "mkldnn", known)
    x, weight, bias = draw(6, 4), draw(5, 4, seed=1), draw(5, seed=2)
    expected = (x @ weight.T + bias).clamp(min=0)
    torch.testing.assert_close(chain.product(x, weight, bias, True), expected)
    low = chain.product(x.bfloat16(), weight.bfloat16(), bias.bfloat16(), True)
    assert low.dtype == torch.bfloat16
    torch.testing.assert_close(low.float(), expected, atol=0.03, rtol=0.03)
    assert asked == [torch.float32] + [torch.bfloat16] * supported


def test_plain_path():
    layers = doubles(make([4, 5, 3]))
    x, offset = draw(6, 4).double().requires_grad_(), draw(2, 5).double().requires_grad_()
    rows = torch.tensor([0, 0, 0, 1, 1, 1])
    assert torch.autograd.gradcheck(lambda x, o: mlp(x, layers, offset=o, rows=rows), (x, offset))
    single = [Layer(w.float(), None if b is None else b.float()) for w, b in layers]
    with use_backend("torch"):
        found = mlp(x.float(), single, precision="bfloat16")
    torch.testing.assert_close(found, by_hand(x.float(), single))


def test_parts_without_gradients():
    x, layers = draw(6, 4), make([4, 5, 3])
    layers[0].weight.requires_grad_(False)
    mlp(x, layers, precision="float32").sum().backward()
    assert layers[0].weight.grad is None
    assert x.grad is None
    assert layers[0].bias.grad is not None
    assert layers[1].weight.grad is not None


def test_columns_of_a_weight():
    """Weights may be views and masked tensors, as decoders pass them."""
    whole, x = draw(5, 9).requires_grad_(), draw(6, 4)
    mask = torch.tensor([1.0, 1.0, 0.0, 0.0])
    found = mlp(x, [(whole[:, 2:6] * mask, None)], precision="float32")
    torch.testing.assert_close(found, (x * mask) @ whole[:, 2:6].T)
    found.sum().backward()
    assert torch.count_nonzero(whole.grad[:, [0, 1, 4, 5, 6, 7, 8]]) == 0


def test_bad_arguments():
    x, layers = draw(6, 4), make([4, 5, 3])
    for arguments, word in (
        ({"precision": "float16"}, "precision"),
        ({"layers": []}, "expected at least one"),
        ({"x": draw(6, 3)}, r"layers\[0\]: found a weight \(5, 4\)"),
        ({"layers": [(layers[0][0], torch.zeros(3))]}, r"expected \(5,\)"),
        ({"offset": draw(6, 4)}, "offset"),
        ({"offset": draw(3, 5)}, "offset"),
        ({"rows": torch.zeros(6, dtype=torch.int64)}, "rows"),
    ):
        with pytest.raises(InputError, match=word):
            mlp(**({"x": x, "layers": layers} | arguments))
