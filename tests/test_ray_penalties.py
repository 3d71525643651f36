"""Entropies, distortion, depth smoothness and ray divergence against NumPy, and their gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from gridreg.base import Clock, Context, Regularizer
from gridreg.errors import InputError
from gridreg.regularizers.patches import DepthSmoothness, RayKL, depth_smoothness, ray_kl
from gridreg.regularizers.rays import (
    DistortionLoss,
    OpacityEntropy,
    RayEntropy,
    distortion,
    opacity_entropy,
    ray_entropy,
)
from gridreg.samples import RaySamples
from tests import oracles
from tests.oracles import Batch, batches, make_batch

CONTEXT = Context(Clock(100, seed=0))
PATCH = (2, 2, 3)
FUNCTIONS: list[Callable[[RaySamples], Tensor]] = [
    opacity_entropy,
    ray_entropy,
    distortion,
    depth_smoothness,
    ray_kl,
]


@given(batches)
def test_opacity_entropy_matches_numpy(batch: Batch) -> None:
    found = opacity_entropy(batch.samples())
    np.testing.assert_allclose(found, oracles.opacity_entropy(batch), rtol=1e-7, atol=1e-10)


@given(batches, st.sampled_from([0.0, 0.1, 0.5]))
def test_ray_entropy_matches_numpy(batch: Batch, threshold: float) -> None:
    found = ray_entropy(batch.samples(), threshold)
    np.testing.assert_allclose(found, oracles.ray_entropy(batch, threshold), rtol=1e-7, atol=1e-10)


@given(batches)
def test_distortion_in_one_pass_matches_the_double_sum(batch: Batch) -> None:
    samples = batch.samples()
    np.testing.assert_allclose(distortion(samples), oracles.distortion(batch), rtol=1e-7, atol=1e-10)
    scaled = distortion(samples, near=2.0, far=6.0)
    np.testing.assert_allclose(scaled, oracles.distortion(batch, 2.0, 6.0), rtol=1e-7, atol=1e-10)


def test_distortion_keeps_its_digits_in_float32() -> None:
    batch = make_batch(0, 200, 300, kept=1.0, scale=0.05)
    t, delta, density = (torch.tensor(x, dtype=torch.float32) for x in (batch.t, batch.delta, batch.density))
    found = distortion(RaySamples.from_dense(t, delta, density))
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found, oracles.distortion(batch), rtol=1e-4)


@given(st.integers(0, 1000), st.sampled_from([0.4, 1.0]))
def test_patch_penalties_match_numpy(seed: int, kept: float) -> None:
    batch = make_batch(seed, 14, 6, kept)
    samples = batch.samples(patch=PATCH)
    depth = (batch.weights * batch.t).sum(1)[2:].reshape(PATCH)
    np.testing.assert_allclose(depth_smoothness(samples), oracles.depth_smoothness(depth), rtol=1e-9)
    alpha = batch.alpha[2:].reshape(*PATCH, 6)
    np.testing.assert_allclose(ray_kl(samples), oracles.ray_kl(alpha), rtol=1e-9, atol=1e-12)


def test_pairs_of_rays_are_patches_of_one_by_two() -> None:
    batch = make_batch(1, 8, 5)
    found = ray_kl(batch.samples(patch=(4, 1, 2)))
    p = batch.alpha / (batch.alpha.sum(1, keepdims=True) + 1e-10) + 1e-10
    expected = [np.sum(p[i] * np.log(p[i] / p[i + 1])) for i in range(0, 8, 2)]
    np.testing.assert_allclose(found, np.mean(expected))


@pytest.mark.parametrize("function", FUNCTIONS)
def test_empty_steps_may_be_skipped_or_kept(function: Callable[[RaySamples], Tensor]) -> None:
    batch = make_batch(2, 12, 20, kept=0.5)
    batch.density[~batch.valid] = 0.0
    kept = replace(batch, valid=np.ones_like(batch.valid))
    torch.testing.assert_close(function(batch.samples(patch=PATCH)), function(kept.samples(patch=PATCH)))


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("kept", [0.6, 1.0])
def test_gradcheck(function: Callable[[RaySamples], Tensor], kept: float) -> None:
    batch = make_batch(3, 12, 4, kept, scale=1.0)
    t, delta, valid = (torch.tensor(x) for x in (batch.t, batch.delta, batch.valid))

    def of_density(density: Tensor) -> Tensor:
        return function(RaySamples.from_dense(t, delta, density, valid=valid, patch=PATCH))

    # Near 1e-10 the logarithm in ray_kl bends faster than a finite difference can follow.
    density = torch.tensor(batch.density + 0.1, requires_grad=True)
    if function is ray_kl:
        valid = torch.ones_like(valid)
    assert gradcheck(of_density, (density,))


def test_distortion_reaches_weights_distances_and_lengths() -> None:
    batch = make_batch(4, 6, 5, kept=0.7, scale=1.0)
    whole = batch.samples()

    def of_all(weights: Tensor, t: Tensor, delta: Tensor) -> Tensor:
        return distortion(whole.replace(weights=weights, t=t, delta=delta), near=1.0, far=3.0)

    given = tuple(x.detach().clone().requires_grad_() for x in (whole.weights, whole.t, whole.delta))
    assert gradcheck(of_all, given)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_rays_without_matter_give_finite_gradients(function: Callable[[RaySamples], Tensor]) -> None:
    density = torch.zeros(12, 3, requires_grad=True)
    samples = RaySamples.from_dense(torch.arange(3.0), torch.ones(3), density, patch=PATCH)
    value = function(samples)
    assert value.shape == ()
    (gradient,) = torch.autograd.grad(value, density)
    assert torch.isfinite(gradient).all()
    opaque = torch.full((12, 3), 1e4, requires_grad=True)
    samples = RaySamples.from_dense(torch.arange(3.0), torch.ones(3), opaque, patch=PATCH)
    (gradient,) = torch.autograd.grad(function(samples), opaque)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("function", FUNCTIONS[:3])
def test_no_samples_and_no_rays_give_zero(function: Callable[[RaySamples], Tensor]) -> None:
    for shape in ((0, 4), (3, 0), (0, 0)):
        empty = torch.zeros(shape)
        value = function(RaySamples.from_dense(empty, empty, empty))
        assert value.shape == ()
        assert math.isclose(value.item(), 0.0, abs_tol=2e-5)


def test_values_known_in_closed_form() -> None:
    half = RaySamples.from_dense(torch.ones(1), torch.ones(1), torch.full((3, 1), math.log(2.0)))
    assert opacity_entropy(half).item() == pytest.approx(math.log(2))
    even = RaySamples.from_dense(torch.arange(8.0), torch.ones(8), torch.ones(2, 8))
    assert ray_entropy(even).item() == pytest.approx(math.log(8))
    # Two thin slabs of weight 1/2 at a distance of 3, and 1/3 (1/4 + 1/4) inside them.
    slabs = torch.tensor([[math.log(2.0), 50.0]])
    two = RaySamples.from_dense(torch.tensor([1.0, 4.0]), torch.ones(2), slabs)
    assert distortion(two).item() == pytest.approx(2 * 3 / 4 + 1 / 6)


def test_ray_entropy_leaves_clear_rays_alone() -> None:
    density = torch.tensor([[0.01, 0.01], [5.0, 5.0]], requires_grad=True)
    samples = RaySamples.from_dense(torch.arange(2.0), torch.ones(2), density)
    (gradient,) = torch.autograd.grad(ray_entropy(samples), density)
    assert (gradient[0] == 0).all()


@pytest.mark.parametrize(
    ("regularizer", "function"),
    [
        (OpacityEntropy(), opacity_entropy),
        (RayEntropy(threshold=0.3), lambda s: ray_entropy(s, 0.3)),
        (DistortionLoss(), distortion),
        (DistortionLoss(near=1.0, far=3.0), lambda s: distortion(s, 1.0, 3.0)),
        (DepthSmoothness(), depth_smoothness),
        (RayKL(), ray_kl),
    ],
)
def test_classes_give_what_their_functions_give(
    regularizer: Regularizer, function: Callable[[RaySamples], Tensor]
) -> None:
    samples = make_batch(4, 12, 5).samples(patch=PATCH)
    assert regularizer.penalty(samples, CONTEXT) == function(samples)


@pytest.mark.parametrize(
    ("function", "patch", "message"),
    [
        (depth_smoothness, None, r"DepthSmoothness needs samples.patch.*at least 2x2 rays, found None"),
        (depth_smoothness, (6, 1, 2), r"found \(6, 1, 2\)"),
        (ray_kl, (6, 2, 1), r"RayKL needs samples.patch.*at least 1x2 rays, found \(6, 2, 1\)"),
    ],
)
def test_missing_patches(function: Callable[[RaySamples], Tensor], patch: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        function(make_batch(5, 12, 3).samples(patch=patch))


@pytest.mark.parametrize("interval", [(1.0, None), (None, 2.0), (2.0, 2.0), (3.0, 2.0)])
def test_bad_intervals(interval: tuple[float | None, float | None]) -> None:
    with pytest.raises(InputError, match="expected both with far beyond near"):
        distortion(make_batch(6, 1, 3).samples(), *interval)
    with pytest.raises(InputError, match="near="):
        DistortionLoss(near=interval[0], far=interval[1])


def test_bad_numbers() -> None:
    for make in (OpacityEntropy, RayEntropy, DistortionLoss, DepthSmoothness, RayKL):
        with pytest.raises(InputError, match=r"weight=-1"):
            make(weight=-1)
    with pytest.raises(InputError, match=r"threshold=1\.5"):
        RayEntropy(threshold=1.5)
