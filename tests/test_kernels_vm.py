"""Lookups in VM grids: the plain version against NumPy, the compiled one against the plain one."""

from __future__ import annotations

import itertools

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
    PLANE_AXES,
    assert_same,
    channels,
    close,
    edges,
    evaluate,
    make_grids,
    make_positions,
    numpy_line,
    numpy_plane,
    seeds,
    threads,
)

FUNCTIONS = [ops.vm_density, ops.vm_features]


def numpy_products(u, planes, lines):
    """The three products, by SciPy and NumPy in float64, ``(3, N, C)``."""
    u = u.double().numpy()
    pairs = zip(planes, lines, PLANE_AXES, LINE_AXES, strict=True)
    return np.stack([numpy_plane(p, u[:, a], u[:, b]) * numpy_line(x, u[:, v]) for p, x, (a, b), v in pairs])


def split(function, u, open_channels=None):
    """``function`` of six grids."""
    return lambda *grids: function(u, grids[:3], grids[3:], open_channels)


@settings(max_examples=25)
@given(seeds, edges, channels, st.integers(0, 12))
def test_plain_version_is_the_formula(seed, shape, count, samples):
    planes, lines = make_grids(seed, shape, count, torch.float64)
    u = make_positions(seed, samples, torch.float64)
    products = numpy_products(u, planes, lines)
    np.testing.assert_allclose(
        ops.vm_density.reference(u, planes, lines).numpy(), products.sum((0, 2)), atol=1e-9
    )
    features = ops.vm_features.reference(u, planes, lines).numpy()
    np.testing.assert_allclose(features, np.concatenate(products, 1), atol=1e-9)


@pytest.mark.parametrize("function", FUNCTIONS)
@settings(max_examples=40)
@given(seed=seeds, shape=edges, count=channels, samples=st.sampled_from([0, 1, 2, 7, 40, 300]))
def test_compiled_equals_plain(function, seed, shape, count, samples):
    planes, lines = make_grids(seed, shape, count)
    assert_same(split(function, make_positions(seed, samples)), [*planes, *lines])


@pytest.mark.parametrize("function", FUNCTIONS)
@settings(max_examples=25)
@given(seed=seeds, shape=edges, count=channels, opened=st.integers(0, 21))
def test_closed_channels(function, seed, shape, count, opened):
    planes, lines = make_grids(seed, shape, count)
    u = make_positions(seed, 30)
    assert_same(split(function, u, opened), [*planes, *lines])
    cut = [x[..., :opened].clone() for x in (*planes, *lines)]
    if 0 < opened < count:
        full, gradients = evaluate("compiled", split(function, u, opened), [*planes, *lines])
        if function is ops.vm_density:
            terms = function(u, [x.abs() for x in cut[:3]], [x.abs() for x in cut[3:]])
            close(full, function(u, cut[:3], cut[3:]), 1e-5, terms)
        else:
            assert bool((full.reshape(30, 3, count)[..., opened:] == 0).all())
        assert all(bool((x[..., opened:] == 0).all()) for x in gradients)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_masked_line_equals_closed_channels(function):
    planes, lines = make_grids(3, (5, 4, 6), 16)
    u = make_positions(3, 50)
    mask = torch.tensor([1.0] * 6 + [0.25] + [0.0] * 9)
    masked = [x * mask for x in lines]
    assert torch.equal(function(u, planes, masked, 7), function(u, planes, masked))


@pytest.mark.parametrize("function", [ops.vm_density.reference, ops.vm_features.reference])
def test_gradcheck(function):
    planes, lines = make_grids(0, (3, 2, 4), 3, torch.float64)
    g = torch.Generator().manual_seed(1)
    # Away from nodes, where the interpolation has a kink.
    u = ((torch.randint(6, (5, 3), generator=g) + 0.37) / 6).double()
    leaves = [x.requires_grad_() for x in (u, *planes, *lines)]
    assert torch.autograd.gradcheck(lambda u, *x: function(u, x[:3], x[3:]), leaves)
    assert torch.autograd.gradcheck(lambda u, *x: function(u, x[:3], x[3:], 2), leaves)


def test_gradient_of_positions_takes_the_plain_path():
    planes, lines = make_grids(5, (4, 5, 6), 8)
    u = torch.rand(9, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    ops.vm_density(u, planes, lines).sum().backward()
    low, high = (u.detach() - 1e-3).clamp(0, 1), (u.detach() + 1e-3).clamp(0, 1)
    for axis in range(3):
        a, b = u.detach().clone(), u.detach().clone()
        a[:, axis], b[:, axis] = low[:, axis], high[:, axis]
        with torch.no_grad():
            slope = (ops.vm_density(b, planes, lines) - ops.vm_density(a, planes, lines)) / 2e-3
        same_cell = (a[:, axis] * 60).floor() == (b[:, axis] * 60).floor()
        torch.testing.assert_close(u.grad[same_cell, axis], slope[same_cell], rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_positions_that_are_not_numbers_stay_visible(function):
    planes, lines = make_grids(7, (3, 3, 3), 9)
    u = torch.tensor([[0.5, float("nan"), 0.5], [float("inf"), 0.5, -float("inf")], [0.5, 0.5, 0.5]])
    for backend in ("torch", "compiled"):
        with use_backend(backend):
            out = function(u, planes, lines)
        assert not bool(out[0].isfinite().all())
        assert bool(out[1:].isfinite().all())
    assert_same(split(function, u[1:]), [*planes, *lines])


@pytest.mark.parametrize("function", FUNCTIONS)
def test_infinite_parameters_stay_visible(function):
    planes, lines = make_grids(7, (3, 3, 3), 9)
    planes[1][1, 1, 4] = float("inf")
    out = function(torch.full((1, 3), 0.5), planes, lines)
    assert not bool(out.isfinite().all())


@pytest.mark.parametrize("function", FUNCTIONS)
def test_same_bits_for_any_number_of_threads(function):
    planes, lines = make_grids(11, (40, 23, 31), 20)
    u = make_positions(11, 5000)
    results = []
    for count in (1, 2, 3):
        with threads(count):
            out, gradients = evaluate("compiled", split(function, u), [*planes, *lines])
        results.append([out, *gradients])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    assert_same(split(function, u), [*planes, *lines])


def test_many_samples_in_few_rows():
    planes, lines = make_grids(2, (2, 2, 50), 8)
    u = make_positions(2, 4000)
    with threads(2):
        assert_same(split(ops.vm_density, u), [*planes, *lines])


@pytest.mark.parametrize("function", FUNCTIONS)
def test_without_gradients_nothing_is_kept(function):
    planes, lines = make_grids(1, (4, 4, 4), 8)
    with torch.no_grad():
        out = function(make_positions(1, 20), [x.requires_grad_() for x in planes], lines)
    assert out.grad_fn is None
    out = function(make_positions(1, 20), planes, lines)
    assert out.grad_fn is not None


@pytest.mark.parametrize("function", FUNCTIONS)
def test_strided_arguments(function):
    planes, lines = make_grids(4, (4, 5, 6), 8)
    u = make_positions(4, 33)
    expected = function(u, planes, lines)
    strided = torch.stack([u, u], 2)[..., 0]
    turned = [x.transpose(0, 1).contiguous().transpose(0, 1) for x in planes]
    assert torch.equal(function(strided, turned, [torch.stack([x, x], 1)[:, 0] for x in lines]), expected)
    assert_same(
        lambda *x: function(u, [y.transpose(0, 1) for y in x[:3]], x[3:]), [*turned_leaves(turned), *lines]
    )


def turned_leaves(planes):
    """Leaves whose transposes are the planes."""
    return [x.transpose(0, 1).contiguous() for x in planes]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_accumulating_in_place_gives_the_same_gradients(function):
    planes, lines = make_grids(6, (6, 5, 7), 16)
    u = make_positions(6, 200)
    _, expected = evaluate("compiled", split(function, u), [*planes, *lines])
    leaves = [x.clone().requires_grad_() for x in (*planes, *lines)]
    leaves[0].grad = torch.ones_like(leaves[0])
    buffer = leaves[0].grad
    mask = torch.full((16,), 1.0, requires_grad=True)
    with ops.accumulate_into_grad():
        _ = evaluate_on(function, u, leaves, mask)
    assert leaves[0].grad is buffer
    torch.testing.assert_close(leaves[0].grad, expected[0] + 1)
    for a, b in itertools.islice(zip(leaves, expected, strict=True), 1, None):
        torch.testing.assert_close(a.grad, b)
    assert mask.grad is not None
    evaluate_on(function, u, leaves, mask)
    torch.testing.assert_close(leaves[1].grad, 2 * expected[1])


def evaluate_on(function, u, leaves, mask):
    """As `kernel_grids.evaluate`, on given leaves, with lines that are no leaves."""
    out = function(u, leaves[:3], [x * mask for x in leaves[3:]])
    g = torch.Generator().manual_seed(0)
    upstream = torch.randn(out.shape, generator=g)
    upstream[torch.rand(out.shape[0], generator=g) < 0.3] = 0
    out.backward(upstream)


def test_accumulating_leaves_planes_that_are_no_leaves_to_autograd():
    planes, lines = make_grids(6, (3, 3, 3), 8)
    leaf = planes[0].requires_grad_()
    with ops.accumulate_into_grad():
        ops.vm_density(make_positions(6, 20), [leaf * 2.0, *planes[1:]], lines).sum().backward()
    with use_backend("torch"):
        twin = leaf.detach().clone().requires_grad_()
        ops.vm_density(make_positions(6, 20), [twin * 2.0, *planes[1:]], lines).sum().backward()
    close(leaf.grad, twin.grad, 1e-5)


def test_second_derivatives_are_refused():
    planes, lines = make_grids(6, (3, 3, 3), 8)
    planes[0].requires_grad_()
    out = ops.vm_density(make_positions(6, 20), planes, lines).square().sum()
    (gradient,) = torch.autograd.grad(out, planes[0], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        gradient.sum().backward()


def test_float64_takes_the_plain_path(monkeypatch):
    planes, lines = make_grids(6, (3, 3, 3), 8, torch.float64)
    monkeypatch.setattr(ops.vm_density, "compiled", lambda *arguments: None)
    assert ops.vm_density(make_positions(6, 5, torch.float64), planes, lines).dtype == torch.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u": torch.zeros(4, 2)}, r"u: found shape \(4, 2\), expected \(N, 3\)"),
        ({"lines": [torch.zeros(3, 4)] * 2}, "lines: found shapes .* expected three"),
        ({"lines": [torch.zeros(1, 4)] * 3}, "lines: found .* nodes along x, y, z, expected at least 2"),
        ({"lines": [torch.zeros(3, 4)] * 2 + [torch.zeros(3, 5)]}, "lines: found shapes"),
        ({"planes": [torch.zeros(3, 3, 4)] * 2}, "planes: found shapes"),
        ({"planes": [torch.zeros(3, 3, 4)] * 2 + [torch.zeros(3, 2, 4)]}, "planes: found shapes"),
        ({"open_channels": -1}, "open_channels: found -1"),
    ],
)
def test_bad_input(change, message):
    arguments = {
        "u": torch.zeros(4, 3),
        "planes": [torch.zeros(3, 3, 4)] * 3,
        "lines": [torch.zeros(3, 4)] * 3,
    }
    for function in FUNCTIONS:
        with pytest.raises(InputError, match=message):
            function(**{**arguments, **change})


@given(seeds, edges, channels)
def test_features_in_bfloat16_are_features_rounded(seed, shape, count):
    planes, lines = make_grids(seed, shape, count)
    u = make_positions(seed, 40)
    slope = torch.randn(40, 3 * count, generator=torch.Generator().manual_seed(seed)).bfloat16()
    results = []
    for dtype in (torch.float32, torch.bfloat16):
        grids = [x.clone().requires_grad_() for x in (*planes, *lines)]
        found = ops.vm_features(u, grids[:3], grids[3:], None, dtype)
        assert found.dtype == dtype
        results.append([found.detach().float(), *torch.autograd.grad(found, grids, slope.to(dtype))])
    (whole, *gradients), (low, *low_gradients) = results
    assert torch.equal(low, whole.bfloat16().float())
    # Gradients come in as bfloat16 and are summed in float32 as always.
    for a, b in zip(low_gradients, gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)
