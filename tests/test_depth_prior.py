"""Depth priors against NumPy, and what they do not depend on."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import gridreg
from gridreg.base import Clock, Context
from gridreg.regularizers.depth_prior import DepthPrior, depth_correlation, depth_ranking, depth_residual
from tests import oracles

seeds = st.integers(0, 10_000)


def rays(
    seed: int, count: int = 12, images: int = 1, unknown: int = 0, grad: bool = False
) -> gridreg.RaySamples:
    """Opaque rays of random depth, with a random target."""
    rng = np.random.default_rng(seed)
    t = torch.tensor(2 + np.cumsum(rng.uniform(0.1, 0.5, (count, 4)), 1))
    density = torch.tensor(rng.uniform(0.0, 3.0, (count, 4))).requires_grad_(grad)
    target = torch.tensor(rng.normal(size=count))
    target[torch.tensor(rng.permutation(count)[:unknown], dtype=torch.int64)] = float("nan")
    return gridreg.RaySamples.from_dense(
        t,
        torch.full((4,), 0.3, dtype=torch.float64),
        density,
        target_depth=target,
        images=torch.tensor(rng.permutation(np.arange(count) % images)) * 7,
    )


def groups(samples: gridreg.RaySamples) -> list[tuple[np.ndarray, np.ndarray]]:
    """Known depth and target by image, in NumPy."""
    depth, target, image = (x.numpy() for x in (samples.depth, samples.target_depth, samples.images))  # type: ignore[union-attr]
    known = ~np.isnan(target)
    return [(depth[known & (image == i)], target[known & (image == i)]) for i in np.unique(image[known])]


@given(seeds, st.integers(1, 3), st.integers(0, 2))
def test_correlation_and_residual_are_numpys(seed: int, images: int, unknown: int) -> None:
    samples = rays(seed, images=images, unknown=unknown)
    for function, oracle in (
        (depth_correlation, oracles.depth_correlation),
        (depth_residual, oracles.depth_residual),
    ):
        expected = np.mean([oracle(d, z) for d, z in groups(samples)])
        np.testing.assert_allclose(function(samples).item(), expected, rtol=1e-6, atol=1e-9)


@given(seeds, st.integers(1, 3), st.floats(0, 0.999))
def test_ranking_is_a_mean_over_pairs(seed: int, images: int, offset: float) -> None:
    samples = rays(seed, images=images)
    found = []
    for depth, target in groups(samples):
        order = np.argsort(target)
        shift = 1 + int(np.float64(offset) * (len(order) - 1))
        for k in range(len(order)):
            a, b = sorted((k, (k + shift) % len(order)))
            found.append(max(0.0, depth[order[a]] - depth[order[b]] + 0.01))
    np.testing.assert_allclose(depth_ranking(samples, offset, 0.01).item(), np.mean(found), rtol=1e-9)


def test_ranking_over_all_offsets_is_the_mean_over_all_pairs() -> None:
    samples = rays(3, count=6)
    ((depth, target),) = groups(samples)
    pairs = [(i, j) for i, j in permutations(range(6), 2) if target[i] < target[j]]
    expected = np.mean([max(0.0, depth[i] - depth[j] + 0.1) for i, j in pairs])
    found = np.mean([depth_ranking(samples, k / 5, 0.1).item() for k in range(5)])
    assert found == pytest.approx(expected)


@given(seeds, st.floats(0.1, 10.0), st.floats(-5.0, 5.0))
def test_scale_and_shift_of_the_target_do_not_matter(seed: int, scale: float, shift: float) -> None:
    samples = rays(seed, images=2)
    assert samples.target_depth is not None
    other = samples.replace(target_depth=samples.target_depth * scale + shift)
    torch.testing.assert_close(depth_correlation(other), depth_correlation(samples), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(depth_ranking(other), depth_ranking(samples))
    torch.testing.assert_close(
        depth_residual(other), depth_residual(samples) * scale**2, rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("form", ["pearson", "ranking", "scale_shift"])
def test_depth_that_agrees_costs_nothing_and_unknown_depth_neither(form: str) -> None:
    samples, penalty = rays(1, grad=True), DepthPrior(form=form, margin=0.0)  # type: ignore[arg-type]
    context = Context(Clock(10, seed=0))
    right = samples.replace(target_depth=3 * samples.depth.detach() - 1)
    assert penalty.penalty(right, context).item() == pytest.approx(0.0, abs=1e-6)
    nothing = samples.replace(target_depth=torch.full((12,), float("nan"), dtype=torch.float64))
    loss = penalty.penalty(nothing, context)
    (gradient,) = torch.autograd.grad(loss, samples.density)
    assert loss.item() == 0
    assert (gradient == 0).all()


@pytest.mark.parametrize("form", ["pearson", "ranking", "scale_shift"])
def test_flat_depth_has_finite_gradients(form: str) -> None:
    density = torch.zeros(6, 4, requires_grad=True)
    flat = gridreg.RaySamples.from_dense(
        torch.arange(1.0, 5.0), torch.ones(4), density, target_depth=torch.arange(6.0)
    )
    loss = DepthPrior(form=form).penalty(flat, Context(Clock(10, seed=0)))  # type: ignore[arg-type]
    (gradient,) = torch.autograd.grad(loss, density)
    assert gradient.isfinite().all()


def test_pairs_change_with_the_step_and_are_the_same_at_one_step() -> None:
    penalty, samples = DepthPrior(form="ranking"), rays(5, count=40)
    found: list[Tensor] = []
    for step in (0, 0, 1, 2):
        clock = Clock(10, seed=4)
        clock.step = step
        found.append(penalty.penalty(samples, Context(clock)))
    assert found[0] == found[1]
    assert len({value.item() for value in found}) > 1


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(gridreg.InputError, match="form='l1': expected 'pearson', 'ranking' or 'scale_shift'"):
        DepthPrior(form="l1")  # type: ignore[arg-type]
    with pytest.raises(gridreg.InputError, match="margin=-1"):
        DepthPrior(margin=-1)
    with pytest.raises(gridreg.InputError, match="needs samples with target_depth, found None"):
        depth_correlation(rays(0).replace(target_depth=None))
