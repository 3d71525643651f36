"""Occlusion loss and Cauchy sparsity against NumPy, gradients, and what they do with skipped samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck

from gridreg.base import Clock, Context
from gridreg.errors import InputError
from gridreg.regularizers.density import CauchySparsity, cauchy_sparsity
from gridreg.regularizers.occlusion import OcclusionLoss, occlusion_loss
from gridreg.samples import RaySamples
from gridreg.schedules import Linear
from tests import oracles
from tests.oracles import Batch, batches, make_batch


def at_step(step: int, total_steps: int = 100) -> Context:
    clock = Clock(total_steps, seed=0)
    clock.step = step
    return Context(clock)


class TestOcclusion:
    @given(batches, st.integers(0, 12), st.sampled_from(["density", "weights"]))
    def test_count_matches_the_mean_over_the_rectangle(self, batch: Batch, count: int, on: Any) -> None:
        mask = np.arange(batch.t.shape[1])[None, :] < count
        found = occlusion_loss(batch.samples(), count, on=on)
        np.testing.assert_allclose(found, oracles.occlusion(batch, mask, on), rtol=1e-9, atol=1e-12)

    @given(batches, st.floats(0.01, 2.0))
    def test_distance_counts_from_the_entry(self, batch: Batch, distance: float) -> None:
        mask = batch.t - batch.t[:, :1] < distance
        found = occlusion_loss(batch.samples(), distance=distance)
        np.testing.assert_allclose(found, oracles.occlusion(batch, mask), rtol=1e-9, atol=1e-12)

    @given(batches, st.floats(0.01, 2.0), st.floats(1.0, 4.0))
    def test_distance_counts_from_near(self, batch: Batch, distance: float, near: float) -> None:
        mask = batch.t < near + distance
        found = occlusion_loss(batch.samples(), distance=distance, near=near)
        np.testing.assert_allclose(found, oracles.occlusion(batch, mask), rtol=1e-9, atol=1e-12)

    @given(batches, st.integers(0, 4), st.integers(0, 9))
    def test_colour_prior_adds_white_and_black_samples(self, batch: Batch, count: int, prior: int) -> None:
        rng = np.random.default_rng(0)
        kinds = rng.integers(0, 4, batch.t.shape)
        batch.colours[kinds == 0] = 0.995
        batch.colours[kinds == 1] = 0.002
        batch.colours[kinds == 2] = 0.0  # not evaluated
        steps = np.arange(batch.t.shape[1])[None, :]
        mask = (steps < count) | ((kinds < 2) & (steps < prior))
        found = occlusion_loss(batch.samples(), count, colour_prior=prior)
        np.testing.assert_allclose(found, oracles.occlusion(batch, mask), rtol=1e-9, atol=1e-12)

    def test_twenty_steps_by_default(self) -> None:
        samples = make_batch(0, 3, 40, kept=1.0).samples()
        assert occlusion_loss(samples) == occlusion_loss(samples, 20)
        assert occlusion_loss(samples) != occlusion_loss(samples, 21)

    def test_empty_steps_may_be_skipped_or_kept(self) -> None:
        batch = make_batch(1, 5, 30, kept=0.5)
        batch.density[~batch.valid] = 0.0
        skipped, kept = batch.samples(), replace(batch, valid=np.ones_like(batch.valid)).samples()
        for arguments in ({"count": 7}, {"distance": 0.8}, {"count": 3, "colour_prior": 9}):
            torch.testing.assert_close(
                occlusion_loss(skipped, **arguments),  # type: ignore[arg-type]
                occlusion_loss(kept, **arguments),  # type: ignore[arg-type]
            )

    def test_a_distance_means_the_same_at_any_step_length(self) -> None:
        values = []
        for width in (50, 100, 400):
            t = (torch.arange(width, dtype=torch.float64) + 0.5) / width
            samples = RaySamples.from_dense(t, torch.full_like(t, 1 / width), torch.ones(2, width) * t)
            values.append(occlusion_loss(samples, distance=0.3).item())
        np.testing.assert_allclose(values, 0.3**2 / 2, rtol=0.05)

    @pytest.mark.parametrize("on", ["density", "weights"])
    @pytest.mark.parametrize("arguments", [{"count": 4}, {"distance": 0.5}])
    def test_gradcheck(self, on: Any, arguments: dict[str, float]) -> None:
        def function(density: torch.Tensor) -> torch.Tensor:
            samples = RaySamples.from_dense(t, delta, density, valid=valid)
            return occlusion_loss(samples, on=on, **arguments)  # type: ignore[arg-type]

        batch = make_batch(2, 3, 6)
        t, delta, valid = (torch.tensor(x) for x in (batch.t, batch.delta, batch.valid))
        assert gradcheck(function, (torch.tensor(batch.density, requires_grad=True),))

    def test_only_masked_samples_get_a_gradient(self) -> None:
        batch = make_batch(3, 2, 5, kept=1.0)
        samples = batch.samples(grad=True)
        (gradient,) = torch.autograd.grad(occlusion_loss(samples, 2), samples.density)
        np.testing.assert_array_equal(gradient.reshape(2, 5) != 0, np.arange(5) < np.array([[2], [2]]))

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"count": 3, "distance": 0.1}, "count=3, distance=0.1: expected one of them"),
            ({"on": "colour"}, "on='colour': expected 'density' or 'weights'"),
        ],
    )
    def test_bad_arguments(self, arguments: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            occlusion_loss(make_batch(0, 1, 2).samples(), **arguments)

    def test_prior_without_colours(self) -> None:
        with pytest.raises(InputError, match="colour_prior needs samples with colours"):
            occlusion_loss(make_batch(0, 1, 2).samples().replace(colours=None), colour_prior=2)


class TestOcclusionLoss:
    def test_schedules_drive_the_numbers(self) -> None:
        samples = make_batch(4, 4, 30, kept=1.0).samples()
        loss = OcclusionLoss(samples=Linear(0, 20))
        assert loss.penalty(samples, at_step(0)) == 0
        assert loss.penalty(samples, at_step(50)) == occlusion_loss(samples, 10)
        by_distance = OcclusionLoss(distance=lambda step: step / 10, on="weights", near=2.0)
        expected = occlusion_loss(samples, distance=0.5, on="weights", near=2.0)
        assert by_distance.penalty(samples, at_step(5)) == expected

    def test_it_says_when_it_needs_colours(self) -> None:
        assert OcclusionLoss().needs() == ()
        assert OcclusionLoss(colour_prior=20).needs() == ("colours",)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"weight": -1.0}, "weight=-1.0"),
            ({"weight": float("nan")}, "weight=nan"),
            ({"samples": 5, "distance": 0.1}, "samples=5, distance=0.1: expected one of them"),
            ({"distance": -0.1}, "distance=-0.1"),
            ({"samples": "20"}, "samples='20'"),
            ({"on": "alpha"}, "on='alpha'"),
        ],
    )
    def test_bad_arguments(self, arguments: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            OcclusionLoss(**arguments)


class TestCauchySparsity:
    @given(batches)
    def test_matches_numpy_and_skipped_samples_add_nothing(self, batch: Batch) -> None:
        expected = np.log(1 + 2 * batch.density[batch.valid] ** 2).sum()
        np.testing.assert_allclose(cauchy_sparsity(batch.samples()), expected, rtol=1e-9)

    def test_class_and_gradcheck(self) -> None:
        samples = make_batch(5, 3, 4).samples(grad=True)
        assert CauchySparsity().penalty(samples, at_step(0)) == cauchy_sparsity(samples)
        density = samples.density.detach().requires_grad_()
        assert gradcheck(lambda x: cauchy_sparsity(samples.replace(density=x)), (density,))
        with pytest.raises(InputError, match="weight=-1"):
            CauchySparsity(weight=-1)


def test_dtype_and_shape_of_scalars() -> None:
    samples = RaySamples.from_dense(torch.arange(3.0), torch.ones(3), torch.rand(2, 3))
    for value in (occlusion_loss(samples, 2), cauchy_sparsity(samples)):
        assert value.shape == ()
        assert value.dtype == torch.float32
