"""Compiled compositing against the plain versions: values, gradients, and no dependence on threads."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg import ops
from gridreg.ops.composite import _depth_before
from gridreg.ops.cpu import composite

counts_lists = st.lists(st.sampled_from([0, 0, 1, 2, 7, 40]), max_size=150)


def random_packed(seed: int, counts: list[int], channels: int = 3):
    g = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    samples = int(offsets[-1])
    tau = torch.rand(samples, generator=g) ** 4 * 3
    return tau, torch.rand(samples, channels, generator=g), offsets


def colours_of(weights, values, offsets):
    rays = len(offsets) - 1
    return composite.pixels(weights, values, torch.zeros(len(weights)), torch.zeros(rays, 3), offsets)[0]


def gradients(outputs, inputs, seed: int):
    g = torch.Generator().manual_seed(seed)
    return torch.autograd.grad(outputs, inputs, torch.randn(outputs.shape, generator=g).to(outputs.dtype))


@settings(max_examples=60, deadline=None)
@given(counts=counts_lists, seed=st.integers(0, 2**31))
def test_weights(counts, seed):
    tau, _, offsets = random_packed(seed, counts)
    tau.requires_grad_()
    exact = tau.detach().double().requires_grad_()
    found, expected = (
        composite.composite_weights(tau, offsets),
        ops.composite_weights.reference(exact, offsets),
    )
    torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-12)
    (a,), (b,) = gradients(found, (tau,), seed), gradients(expected, (exact,), seed)
    torch.testing.assert_close(a, b.float(), rtol=1e-4, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(counts=counts_lists, seed=st.integers(0, 2**31))
def test_pixels(counts, seed):
    weights, colours, offsets = random_packed(seed, counts)
    g = torch.Generator().manual_seed(seed)
    t, background = torch.rand(len(weights), generator=g), torch.rand(len(counts), 3, generator=g)
    results = []
    for pixels, kind in ((composite.pixels, torch.float32), (ops.pixels.reference, torch.float64)):
        given_ = [x.to(kind).requires_grad_() for x in (weights.clone(), colours.clone())]
        out = pixels(*given_, t.to(kind), background.to(kind), offsets)
        results.append([*out, *gradients(torch.cat([x.reshape(-1) for x in out]), given_, seed)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b.float(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("place", [2, 3])
def test_distances_and_backgrounds_may_need_gradients(place):
    weights, colours, offsets = random_packed(1, [3, 0, 4])
    given_ = [weights, colours, torch.rand(7), torch.rand(3, 3)]
    given_[place].requires_grad_()
    found = torch.cat([x.reshape(-1) for x in ops.pixels(*given_, offsets)])
    expected = torch.cat([x.reshape(-1) for x in ops.pixels.reference(*given_, offsets)])
    torch.testing.assert_close(
        *(gradients(x, (given_[place],), 0)[0] for x in (found, expected)), rtol=1e-5, atol=1e-6
    )


@settings(max_examples=60, deadline=None)
@given(counts=counts_lists, seed=st.integers(0, 2**31), bound=st.sampled_from([0.0, 1e-4, 0.013, 0.5, 1.0]))
def test_terminate(counts, seed, bound):
    tau, _, offsets = random_packed(seed, counts)
    found, expected = composite.terminate(tau, offsets, bound), ops.terminate.reference(tau, offsets, bound)
    assert found.dtype == torch.bool
    before = torch.exp(-_depth_before(tau.double(), offsets))
    undecided = (before - bound).abs() <= 1e-5 * bound
    assert torch.equal(found | undecided, expected | undecided)
    assert bool(found.all()) or bound > 0


def test_opaque_and_strided():
    tau = torch.tensor([[0.5, 9.0], [math.inf, 9.0], [1.0, 9.0], [2.0, 9.0]])[:, 0].requires_grad_()
    offsets = torch.tensor([[0, 0], [3, 0], [4, 0]])[:, 0]
    found, expected = composite.composite_weights(tau, offsets), ops.composite_weights.reference(tau, offsets)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(gradients(found, (tau,), 0), gradients(expected, (tau,), 0))


def test_inputs_stay_as_they_were():
    tau, values, offsets = random_packed(0, [30] * 9)
    copies = tau.clone(), values.clone(), offsets.clone()
    colours_of(composite.composite_weights(tau, offsets), values, offsets)
    composite.terminate(tau, offsets, 0.1)
    for a, b in zip((tau, values, offsets), copies, strict=True):
        assert torch.equal(a, b)


def test_thread_count_does_not_matter():
    tau, values, offsets = random_packed(7, [13, 0, 55] * 200)
    tau.requires_grad_()
    values.requires_grad_()
    threads = torch.get_num_threads()

    def everything():
        weights = composite.composite_weights(tau, offsets)
        sums = colours_of(weights, values, offsets)
        return weights, sums, composite.terminate(tau, offsets, 0.3), *gradients(sums, (tau, values), 1)

    try:
        torch.set_num_threads(1)
        alone = everything()
        torch.set_num_threads(2)
        for a, b in zip(everything(), alone, strict=True):
            assert torch.equal(a, b)
    finally:
        torch.set_num_threads(threads)


def test_two_python_threads_at_once():
    """As a viewer renders beside a trainer."""
    tau, values, offsets = random_packed(7, [13, 0, 55] * 300)
    expected = colours_of(composite.composite_weights(tau, offsets), values, offsets)

    def work(_):
        return colours_of(composite.composite_weights(tau, offsets), values, offsets)

    with ThreadPoolExecutor(2) as pool:
        assert all(torch.equal(found, expected) for found in pool.map(work, range(60)))


def test_registered():
    tau, values, offsets = random_packed(7, [5, 0, 9])
    weights = ops.composite_weights(tau, offsets)
    assert torch.equal(weights, composite.composite_weights(tau, offsets))
    with ops.use_backend("torch"):
        plain = ops.composite_weights.reference(tau, offsets)
        assert torch.equal(ops.composite_weights(tau, offsets), plain)
    given_ = (weights, values, torch.rand(14), torch.rand(3, 3), offsets)
    assert all(map(torch.equal, ops.pixels(*given_), composite.pixels(*given_)))
    assert torch.equal(ops.terminate(tau, offsets, 0.4), composite.terminate(tau, offsets, 0.4))
