"""Random backgrounds, space annealing and distance gradient scaling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gridreg.base import Clock, Context
from gridreg.errors import InputError
from gridreg.regularizers.backgrounds import (
    ExpectedBackground,
    RandomBackground,
    opacity_error,
    random_background,
)
from gridreg.regularizers.gradient_scaling import DistanceGradientScaling, scale_gradients_by_distance
from gridreg.regularizers.sample_space import SampleSpaceAnnealing, anneal_space
from gridreg.samples import RaySamples
from tests.oracles import make_batch


def at_step(step: int) -> Context:
    context = Context(Clock(100, seed=0))
    context.clock.step = step
    return context


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TestRandomBackground:
    def test_one_colour_per_ray_or_one_for_all(self) -> None:
        rays = random_background(1000, seeded())
        assert rays.shape == (1000, 3)
        assert ((rays >= 0) & (rays < 1)).all()
        np.testing.assert_allclose(rays.mean(0), 0.5, atol=0.05)
        assert len(rays.unique(dim=0)) == 1000
        batch = random_background(7, seeded(), per="batch")
        assert batch.shape == (7, 3)
        assert len(batch.unique(dim=0)) == 1

    def test_the_generator_alone_decides(self) -> None:
        torch.manual_seed(1)
        first = random_background(5, seeded(3))
        torch.manual_seed(2)
        assert torch.equal(first, random_background(5, seeded(3)))
        generator = seeded(3)
        random_background(5, generator)
        assert not torch.equal(first, random_background(5, generator))

    def test_until_the_end_then_the_default(self) -> None:
        regularizer, default = RandomBackground(until=0.5), torch.ones(4, 3, dtype=torch.float64)
        drawn = regularizer.background(4, seeded(), default, at_step(49))
        assert drawn is not None
        assert drawn.dtype == torch.float64
        assert not torch.equal(drawn, default)
        assert regularizer.background(4, seeded(), default, at_step(50)) is default
        assert [regularizer.value(at_step(step)) for step in (49, 50)] == [1, 0]
        assert RandomBackground().background(2, seeded(), None, at_step(0)) is not None

    def test_bad_arguments(self) -> None:
        for make in (RandomBackground, lambda per: random_background(1, seeded(), per)):
            with pytest.raises(InputError, match="per='pixel': expected 'ray' or 'batch'"):
                make(per="pixel")  # type: ignore[arg-type]


class TestExpectedBackground:
    def pixels(self) -> tuple[RaySamples, Tensor, Tensor, Tensor]:
        """Samples of 5 rays, and the densities behind them; their colour before black, and that of their pixels."""
        generator = seeded(4)
        density = 2 * torch.rand(5, 3, generator=generator, dtype=torch.float64)
        density.requires_grad_()
        alpha = torch.rand(5, generator=generator, dtype=torch.float64)
        t = torch.arange(3, dtype=torch.float64)
        samples = RaySamples.from_dense(t, torch.ones_like(t), density, target_opacity=alpha)
        colours = torch.rand(15, 3, generator=generator, dtype=torch.float64)
        seen = samples.sum_per_ray(samples.weights[:, None] * colours)
        wanted = torch.rand(5, 3, generator=generator, dtype=torch.float64) * alpha[:, None]
        return samples, density, seen, wanted

    def test_it_is_the_mean_over_all_backgrounds(self) -> None:
        samples, density, seen, wanted = self.pixels()
        alpha = samples.target_opacity
        assert alpha is not None

        def error(background: Tensor) -> Tensor:
            render = seen + (1 - samples.opacity[:, None]) * background
            return (render - wanted - (1 - alpha[:, None]) * background).square().mean()

        regularizer, context = ExpectedBackground(), at_step(3)
        grey = regularizer.background(5, seeded(), torch.ones(3, dtype=torch.float64), context)
        assert grey is not None
        assert grey.dtype == torch.float64
        found = error(grey) + regularizer.penalty(samples, context)
        # Of a polynomial of degree 2 in each channel, two nodes of Gauss and Legendre give the integral exactly.
        nodes = 0.5 + torch.tensor([-1, 1], dtype=torch.float64) / 12**0.5
        integral = torch.stack([error(node.expand(3)) for node in nodes]).mean()
        torch.testing.assert_close(found, integral)
        slopes = [torch.autograd.grad(value, density, retain_graph=True)[0] for value in (found, integral)]
        torch.testing.assert_close(*slopes)
        drawn = torch.stack([error(random_background(5, seeded(k)).double()) for k in range(4000)]).detach()
        assert abs(float(drawn.mean() - found.detach())) < 4 * float(drawn.std()) / 4000**0.5
        assert float(drawn.std()) > 0.01 * float(found.detach())

    def test_unknown_pixels_count_as_met_and_none_is_refused(self) -> None:
        samples, *_ = self.pixels()
        alpha = samples.target_opacity
        assert alpha is not None
        some = alpha.clone()
        some[1:] = float("nan")
        expected = (samples.opacity[0] - alpha[0]).square() / 5
        torch.testing.assert_close(opacity_error(samples.replace(target_opacity=some)), expected)
        with pytest.raises(InputError, match="target_opacity, found none"):
            opacity_error(samples.replace(target_opacity=None))
        assert ExpectedBackground().needs() == ("target_opacity",)

    def test_until_the_end_then_the_default(self) -> None:
        regularizer, default = ExpectedBackground(weight=2.0, until=0.5), torch.ones(3)
        samples, *_ = self.pixels()
        assert regularizer.background(4, seeded(), default, at_step(50)) is default
        assert regularizer.penalty(samples, at_step(50)).item() == 0
        assert regularizer.penalty(samples, at_step(49)).item() > 0
        assert [regularizer.value(at_step(step)) for step in (49, 50)] == [2, 0]
        generator = seeded(1)
        before = generator.get_state()
        assert regularizer.background(4, generator, None, at_step(0)).tolist() == [[0.5] * 3] * 4  # type: ignore[union-attr]
        assert torch.equal(generator.get_state(), before)

    def test_a_weight_below_0_is_refused(self) -> None:
        with pytest.raises(InputError, match="weight"):
            ExpectedBackground(weight=-1.0)


class TestSampleSpaceAnnealing:
    @given(st.floats(0, 5), st.floats(0.1, 5), st.floats(0, 1.2), st.floats(0, 1), st.floats(0, 1))
    def test_matches_regnerf(
        self, near: float, length: float, progress: float, start: float, middle: float
    ) -> None:
        begin, end = torch.tensor([near]).double(), torch.tensor([near + length]).double()
        found = anneal_space(begin, end, progress, start=start, middle=middle)
        t_m = near + middle * length
        eta = min(max(progress, start), 1.0)
        expected = t_m + (near - t_m) * eta, t_m + (near + length - t_m) * eta
        np.testing.assert_allclose([x.item() for x in found], expected, atol=1e-9)
        assert begin - 1e-9 <= found[0] <= found[1] + 1e-9 <= end + 2e-9

    def test_opens_with_the_step_and_ends_with_the_very_tensors(self) -> None:
        regularizer = SampleSpaceAnnealing(until=50, start=0.2)
        near, far = torch.full((3,), 2.0), torch.full((3,), 6.0)
        lengths = []
        for step in (0, 10, 20, 49):
            low, high = regularizer.near_far(near, far, at_step(step))
            lengths.append(float(high[0] - low[0]))
            assert regularizer.value(at_step(step)) == pytest.approx(lengths[-1] / 4)
        assert lengths == sorted(lengths)
        assert lengths[:2] == pytest.approx([0.8, 0.8])
        low, high = regularizer.near_far(near, far, at_step(50))
        assert low is near
        assert high is far

    @pytest.mark.parametrize("arguments", [{"start": 1.5}, {"middle": -0.1}, {"until": -1}])
    def test_bad_arguments(self, arguments: dict[str, Any]) -> None:
        with pytest.raises(InputError, match=next(iter(arguments))):
            SampleSpaceAnnealing(**arguments)


def colour_loss(samples: RaySamples) -> Tensor:
    """A loss that depends on density through the weights, on colour, and on density itself."""
    assert samples.colours is not None
    pixels = samples.sum_per_ray(samples.weights[:, None] * samples.colours)
    return (pixels - 0.3).square().sum() + 0.1 * samples.density.square().sum()


class TestDistanceGradientScaling:
    @pytest.mark.parametrize("distance", [0.5, 2.4, 10.0])
    def test_gradients_are_scaled_and_values_are_not(self, distance: float) -> None:
        batch = make_batch(0, 5, 8)
        t, delta, density, colours, valid = (
            torch.tensor(x) for x in (batch.t, batch.delta, batch.density, batch.colours, batch.valid)
        )
        density.requires_grad_()
        colours.requires_grad_()
        plain = RaySamples.from_dense(t, delta, density, colours=colours, valid=valid)
        scaled = scale_gradients_by_distance(plain, distance)
        for name in ("density", "weights", "colours", "t"):
            assert torch.equal(getattr(scaled, name), getattr(plain, name))
        expected = torch.autograd.grad(colour_loss(plain), (density, colours), retain_graph=True)
        found = torch.autograd.grad(colour_loss(scaled), (density, colours))
        factor = ((t / distance) ** 2).clamp(0, 1)
        torch.testing.assert_close(found[0], expected[0] * factor)
        torch.testing.assert_close(found[1], expected[1] * factor[..., None])

    def test_class_reads_its_schedule(self) -> None:
        samples = make_batch(1, 2, 3, kept=1.0).samples(grad=True).replace(colours=None)
        scaled = DistanceGradientScaling(distance=lambda step: 1.0 + step).on_samples(samples, at_step(9))
        (gradient,) = torch.autograd.grad(scaled.density.sum(), samples.density)
        torch.testing.assert_close(gradient, ((samples.t / 10) ** 2).clamp(0, 1))
        assert scaled.colours is None
        assert DistanceGradientScaling(distance=3.0).value(at_step(0)) == 3

    def test_bad_arguments(self) -> None:
        for distance in (0.0, -1.0, float("nan")):
            with pytest.raises(InputError, match="distance="):
                DistanceGradientScaling(distance=distance)
            with pytest.raises(InputError, match="distance="):
                scale_gradients_by_distance(make_batch(2, 1, 1).samples(), distance)
