"""The fused encodings against the plain one of the toolkit: values, gradients, orders."""

from __future__ import annotations

import importlib

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.encodings import positional_encoding
from gridreg.errors import InputError
from gridreg.ops import use_backend
from gridreg.ops.encode import encode, encode_together


def draw(rows: int, dims: int, seed: int, spread: float = 2.0) -> torch.Tensor:
    return torch.randn(rows, dims, generator=torch.Generator().manual_seed(seed)) * spread


def gradient(output: torch.Tensor, x: torch.Tensor, seed: int) -> torch.Tensor:
    return torch.autograd.grad(output, x, draw(*output.shape, seed).to(output.dtype))[0]


@settings(max_examples=60, deadline=None)
@given(
    rows=st.sampled_from([0, 1, 2, 255, 256, 300]),
    dims=st.integers(1, 30),
    octaves=st.integers(0, 6),
    order=st.sampled_from(["octave", "sines_first", "coordinate"]),
    scale=st.sampled_from([1.0, 3.14159265, 0.3]),
    seed=st.integers(0, 2**31),
)
def test_values_and_gradients(rows, dims, octaves, order, scale, seed):
    x = draw(rows, dims, seed).requires_grad_()
    found, expected = encode(x, octaves, order, scale), positional_encoding(x, octaves, order, scale=scale)
    # An angle a is rounded by a * 6e-8, and each doubling doubles the error.
    angle = 1 + float(x.detach().abs().max() if rows else 0) * scale
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-7 * angle * 2**octaves)
    slope = gradient(expected, x, seed)
    torch.testing.assert_close(
        gradient(found, x, seed), slope, rtol=1e-4, atol=1e-6 * angle * scale * 4**octaves
    )


def test_accuracy_against_float64():
    """Of a scene's inputs: positions in [-1, 1] with 6 octaves, features with 2."""
    for spread, octaves, dims in ((1.0, 6, 3), (5.0, 2, 27)):
        x = (torch.rand(2000, dims, generator=torch.Generator().manual_seed(0)) * 2 - 1) * spread
        exact = positional_encoding(x.double(), octaves)
        torch.testing.assert_close(encode(x, octaves).double(), exact, rtol=0, atol=1e-5)


def test_octave_zero_is_exact():
    x = draw(50, 11, 0)
    found = encode(x, 1)
    assert torch.equal(found, positional_encoding(x, 1))


def test_blocks_side_by_side():
    x, y, z = draw(40, 27, 0).requires_grad_(), draw(40, 3, 1), draw(40, 2, 2).requires_grad_()
    blocks = [(x, 2), (y, 6), (z, 0)]
    found = encode_together(blocks)
    expected = torch.cat([positional_encoding(values, octaves) for values, octaves in blocks], dim=-1)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)
    for values in (x, z):
        torch.testing.assert_close(
            torch.autograd.grad(found, values, torch.ones_like(found), retain_graph=True),
            torch.autograd.grad(expected, values, torch.ones_like(found), retain_graph=True),
            rtol=1e-4,
            atol=1e-4,
        )
    assert not y.requires_grad


def test_strided_input():
    x = draw(27, 40, 0).T
    assert not x.is_contiguous()
    torch.testing.assert_close(encode(x, 2), positional_encoding(x, 2), rtol=0, atol=1e-5)


def test_plain_path():
    x = draw(30, 5, 0).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: encode(x, 3), (x,))
    with use_backend("torch"):
        for order in ("octave", "coordinate"):
            assert torch.equal(encode(x.float(), 3, order), positional_encoding(x.float(), 3, order))
    assert torch.equal(encode(x.float(), 12), positional_encoding(x.float(), 12))


def test_which_path(monkeypatch):
    # Its package exports a function of the same name.
    module = importlib.import_module("gridreg.ops.encode")
    calls = []
    launch = module.launch
    monkeypatch.setattr(module, "launch", lambda *a: (calls.append(a[0]), launch(*a)))
    x = draw(30, 5, 0)
    encode(x.double(), 2)
    assert calls == []
    encode(x, 2)
    assert calls == [module._forward]


def test_thread_count_does_not_matter():
    x = draw(5000, 27, 3).requires_grad_()
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found = encode(x, 2)
            results.append((found.detach(), gradient(found, x, 0)))
    finally:
        torch.set_num_threads(threads)
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def test_bad_arguments():
    x = draw(4, 3, 0)
    with pytest.raises(InputError, match="expected at least one"):
        encode_together([])
    with pytest.raises(InputError, match=r"expected \(4, D\)"):
        encode_together([(x, 1), (x[:3], 1)])
    with pytest.raises(InputError, match="octaves"):
        encode(x, -1)
    with pytest.raises(InputError, match="order"):
        encode(x, 1, "random")
