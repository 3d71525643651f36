"""Eikonal and normal smoothness against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from gridreg.regularizers.density import eikonal
from gridreg.regularizers.patches import normal_smoothness
from tests import oracles

seeds = st.integers(0, 10_000)


def with_gradients(
    seed: int, count: int, height: int, width: int
) -> tuple[gridreg.RaySamples, oracles.Batch]:
    """Rays with gradients of any length, and the batch behind them; two rays at the front are in no patch."""
    batch = oracles.make_batch(seed, 2 + count * height * width, 5, kept=0.8)
    batch.colours = np.random.default_rng(seed).normal(size=batch.colours.shape)
    samples = batch.samples(gradients=torch.tensor(batch.colours), patch=(count, height, width))
    return samples, batch


@given(seeds)
def test_eikonal_is_the_mean_squared_error_of_lengths(seed: int) -> None:
    samples, batch = with_gradients(seed, 1, 2, 2)
    lengths = np.linalg.norm(batch.colours[batch.valid], axis=-1)
    np.testing.assert_allclose(eikonal(samples).item(), np.mean((lengths - 1) ** 2), rtol=1e-9)


def test_eikonal_of_a_signed_distance_is_zero() -> None:
    x = torch.randn(
        1, 50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ).requires_grad_()
    (gradients,) = torch.autograd.grad(x.norm(dim=-1).sum(), x)
    t = torch.arange(50.0, dtype=torch.float64)
    samples = gridreg.RaySamples.from_dense(
        t, torch.ones_like(t), torch.ones_like(t)[None], gradients=gradients
    )
    assert eikonal(samples).item() == pytest.approx(0, abs=1e-20)


def test_eikonal_has_finite_gradients_where_a_gradient_is_zero() -> None:
    gradients = torch.zeros(1, 1, 3, requires_grad=True)
    samples = gridreg.RaySamples.from_dense(
        torch.ones(1), torch.ones(1), torch.ones(1, 1), gradients=gradients
    )
    (found,) = torch.autograd.grad(eikonal(samples), gradients)
    assert found.isfinite().all()


@given(seeds, st.integers(1, 3), st.integers(2, 4), st.integers(2, 3))
def test_normal_smoothness_matches_numpy(seed: int, count: int, height: int, width: int) -> None:
    samples, batch = with_gradients(seed, count, height, width)
    units = batch.colours / np.linalg.norm(batch.colours, axis=-1, keepdims=True)
    summed = (batch.weights[..., None] * units).sum(1)
    lengths = np.linalg.norm(summed, axis=-1, keepdims=True)
    normals = (summed / np.maximum(lengths, 1e-12))[2:].reshape(count, height, width, 3)
    expected = oracles.normal_smoothness(normals)
    np.testing.assert_allclose(normal_smoothness(samples).item(), expected, rtol=1e-7)


def test_a_plane_has_one_normal() -> None:
    samples, _ = with_gradients(1, 1, 3, 3)
    flat = samples.replace(
        gradients=torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64).expand(len(samples), 3)
    )
    seen = flat.opacity.min() > 0
    assert seen
    assert normal_smoothness(flat).item() == pytest.approx(0, abs=1e-9)


def test_what_is_missing_is_named() -> None:
    samples = oracles.make_batch(0, 4, 3).samples()
    with pytest.raises(gridreg.InputError, match="eikonal needs samples with gradients, found None"):
        eikonal(samples)
    with pytest.raises(gridreg.InputError, match="NormalSmoothness needs samples with gradients, found None"):
        normal_smoothness(samples.replace(patch=(1, 2, 2)))
    with pytest.raises(gridreg.InputError, match=r"NormalSmoothness needs samples.patch.*at least 2x2"):
        normal_smoothness(samples.replace(gradients=torch.ones(len(samples), 3, dtype=torch.float64)))
