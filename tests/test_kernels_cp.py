"""Lookups in CP grids: the plain version against NumPy, the compiled one against the plain one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg import ops
from gridreg.errors import InputError
from gridreg.ops import use_backend
from tests.kernel_grids import (
    LINE_AXES,
    assert_same,
    channels,
    edges,
    evaluate,
    make_grids,
    make_positions,
    numpy_line,
    seeds,
    threads,
)

FUNCTIONS = [ops.cp_density, ops.cp_features]


def fixed(function, u, open_channels=None):
    """``function`` of three lines."""
    return lambda *lines: function(u, lines, open_channels)


@settings(max_examples=25)
@given(seeds, edges, channels, st.integers(0, 12))
def test_plain_version_is_the_formula(seed, shape, count, samples):
    _, lines = make_grids(seed, shape, count, torch.float64)
    u = make_positions(seed, samples, torch.float64)
    parts = [numpy_line(line, u[:, axis].numpy()) for line, axis in zip(lines, LINE_AXES, strict=True)]
    product = parts[0] * parts[1] * parts[2]
    np.testing.assert_allclose(ops.cp_features.reference(u, lines).numpy(), product, atol=1e-9)
    np.testing.assert_allclose(ops.cp_density.reference(u, lines).numpy(), product.sum(1), atol=1e-9)


@pytest.mark.parametrize("function", FUNCTIONS)
@settings(max_examples=40)
@given(seed=seeds, shape=edges, count=channels, samples=st.sampled_from([0, 1, 2, 7, 40, 300]))
def test_compiled_equals_plain(function, seed, shape, count, samples):
    _, lines = make_grids(seed, shape, count)
    assert_same(fixed(function, make_positions(seed, samples)), lines)


@pytest.mark.parametrize("function", FUNCTIONS)
@settings(max_examples=25)
@given(seed=seeds, shape=edges, count=channels, opened=st.integers(0, 21))
def test_closed_channels(function, seed, shape, count, opened):
    _, lines = make_grids(seed, shape, count)
    u = make_positions(seed, 30)
    assert_same(fixed(function, u, opened), lines)
    out, gradients = evaluate("compiled", fixed(function, u, opened), lines)
    assert all(bool((x[:, opened:] == 0).all()) for x in gradients)
    if function is ops.cp_features:
        assert bool((out[:, opened:] == 0).all())


@pytest.mark.parametrize("function", [ops.cp_density.reference, ops.cp_features.reference])
def test_gradcheck(function):
    _, lines = make_grids(0, (3, 2, 4), 3, torch.float64)
    g = torch.Generator().manual_seed(1)
    # Away from nodes, where the interpolation has a kink.
    u = ((torch.randint(6, (5, 3), generator=g) + 0.37) / 6).double()
    leaves = [x.requires_grad_() for x in (u, *lines)]
    assert torch.autograd.gradcheck(lambda u, *x: function(u, x), leaves)
    assert torch.autograd.gradcheck(lambda u, *x: function(u, x, 2), leaves)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_same_bits_for_any_number_of_threads(function):
    _, lines = make_grids(11, (40, 23, 31), 20)
    u = make_positions(11, 5000)
    results = []
    for count in (1, 2, 3):
        with threads(count):
            out, gradients = evaluate("compiled", fixed(function, u), lines)
        results.append([out, *gradients])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    assert_same(fixed(function, u), lines)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_positions_that_are_not_numbers_stay_visible(function):
    _, lines = make_grids(7, (3, 3, 3), 9)
    u = torch.tensor([[0.5, float("nan"), 0.5], [0.5, 0.5, 0.5]])
    for backend in ("torch", "compiled"):
        with use_backend(backend):
            out = function(u, lines)
        assert not bool(out[0].isfinite().all())
        assert bool(out[1].isfinite().all())


@pytest.mark.parametrize("function", FUNCTIONS)
def test_gradient_of_positions(function):
    _, lines = make_grids(7, (3, 4, 5), 6)
    u = torch.rand(8, 3, generator=torch.Generator().manual_seed(2))
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf = u.to(dtype, copy=True).requires_grad_()
        function(leaf, [x.to(dtype) for x in lines]).sum().backward()
        grads.append(leaf.grad.double())
    torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-4)


def test_bad_input():
    lines = [torch.zeros(3, 4)] * 3
    for function in FUNCTIONS:
        with pytest.raises(InputError, match=r"u: found shape \(4, 2\)"):
            function(torch.zeros(4, 2), lines)
        with pytest.raises(InputError, match="lines: found shapes"):
            function(torch.zeros(4, 3), lines[:2])
        with pytest.raises(InputError, match="open_channels: found -2"):
            function(torch.zeros(4, 3), lines, -2)
