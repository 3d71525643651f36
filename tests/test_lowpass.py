"""Filters against NumPy's FFT, and low-passes attached to a field whose grids grow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn
from torch.autograd import gradcheck

import gridreg
from gridreg.base import Clock, Context
from gridreg.errors import InputError
from gridreg.regularizers.filters import fourier_low_pass, gaussian_blur, low_pass_response
from gridreg.regularizers.low_pass import FourierLowPass, GridBlur, annealed_radius
from gridreg.schedules import Linear
from tests import oracles

BOUNDARIES = ["periodic", "mirror"]
shapes = st.lists(st.integers(1, 9), min_size=1, max_size=4)


def random(*shape: int, seed: int = 0, **more: Any) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, dtype=torch.float64, generator=generator, **more)


class TestFourierLowPass:
    @given(shapes, st.floats(0, 1), st.sampled_from(BOUNDARIES), st.data())
    def test_matches_the_fast_transform(
        self, shape: list[int], keep: float, boundary: Any, data: st.DataObject
    ) -> None:
        axes = tuple(data.draw(st.sets(st.sampled_from(range(len(shape))))))
        values = random(*shape)
        found = fourier_low_pass(values, axes, keep, boundary)
        expected = oracles.fourier_low_pass(values.numpy(), axes, keep, boundary)
        np.testing.assert_allclose(found, expected, atol=1e-7)

    @given(shapes, st.floats(0, 1), st.sampled_from(BOUNDARIES))
    def test_keeps_the_mean(self, shape: list[int], keep: float, boundary: Any) -> None:
        values = random(*shape, seed=1)
        axes = tuple(range(len(shape)))
        found = fourier_low_pass(values, axes, keep, boundary)
        torch.testing.assert_close(found.mean(), values.mean(), rtol=0, atol=1e-12)
        only_the_mean = fourier_low_pass(values, axes, 0.0, boundary)
        torch.testing.assert_close(only_the_mean, values.mean().expand(shape))

    def test_the_mean_in_float32_is_kept_to_rounding(self) -> None:
        values = torch.full((64, 64, 8), 3.7) + 1e-2 * random(64, 64, 8).float()
        found = fourier_low_pass(values, (0, 1), 0.2)
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.mean((0, 1)), values.mean((0, 1)), rtol=1e-6, atol=0)

    @pytest.mark.parametrize("boundary", BOUNDARIES)
    def test_all_or_nothing_in_between(self, boundary: Any) -> None:
        values = random(16, 16)
        assert fourier_low_pass(values, (0, 1), 1.0, boundary) is values
        almost = fourier_low_pass(values, (0, 1), 1 - 1e-9, boundary)
        torch.testing.assert_close(almost, values, atol=1e-7, rtol=0)
        energies = [fourier_low_pass(values, (0, 1), k / 20, boundary).square().sum() for k in range(21)]
        assert energies == sorted(energies)

    def test_a_wave_passes_or_does_not(self) -> None:
        nodes = torch.arange(40, dtype=torch.float64)
        wave = torch.cos(2 * torch.pi * 5 * nodes / 40)
        torch.testing.assert_close(fourier_low_pass(wave, (0,), 5 / 20), wave)
        torch.testing.assert_close(fourier_low_pass(wave, (0,), 4 / 20), torch.zeros_like(wave))
        torch.testing.assert_close(fourier_low_pass(wave, (0,), 4.5 / 20), wave / 2)

    def test_layout_does_not_matter(self) -> None:
        last = random(6, 7, 4)
        first = last.permute(2, 0, 1)[None].contiguous()
        found = fourier_low_pass(first, (2, 3), 0.4)[0].permute(1, 2, 0)
        torch.testing.assert_close(found, fourier_low_pass(last, (0, 1), 0.4))

    @pytest.mark.parametrize("keep", [0.2, 0.9])
    def test_gradcheck(self, keep: float) -> None:
        values = random(5, 6, 2, requires_grad=True)
        assert gradcheck(lambda x: fourier_low_pass(x, (0, 1), keep), (values,))

    def test_closed_frequencies_get_no_gradient(self) -> None:
        values = random(32, requires_grad=True)
        (gradient,) = torch.autograd.grad(fourier_low_pass(values, (0,), 0.25).pow(3).sum(), values)
        spectrum = np.abs(np.fft.rfft(gradient.numpy()))
        assert (spectrum[:5] > 1e-6).all()
        np.testing.assert_allclose(spectrum[5:], 0, atol=1e-9)

    def test_a_tensor_for_the_share_gives_the_same(self) -> None:
        values = random(9, 8, 2)
        for keep in (0.0, 0.3, 0.8, 1.0):
            found = fourier_low_pass(values, (0, 1), torch.tensor(keep, dtype=torch.float64))
            torch.testing.assert_close(found, fourier_low_pass(values, (0, 1), keep))
            found = gaussian_blur(values, (0, 1), torch.tensor(keep, dtype=torch.float64))
            torch.testing.assert_close(found, gaussian_blur(values, (0, 1), keep), atol=1e-6, rtol=0)

    def test_response_never_falls_with_the_share(self) -> None:
        frequencies = torch.arange(11)
        responses = torch.stack([low_pass_response(frequencies, 10, k / 30) for k in range(31)])
        assert ((responses >= 0) & (responses <= 1)).all()
        assert (responses.diff(dim=0) >= 0).all()
        assert (responses.diff(dim=1) <= 0).all()
        assert (responses[:, 0] == 1).all()
        assert (responses[-1] == 1).all()

    @pytest.mark.parametrize("keep", [-0.1, 1.1, float("nan")])
    def test_bad_arguments(self, keep: float) -> None:
        with pytest.raises(InputError, match="keep="):
            fourier_low_pass(random(4), (0,), keep)
        with pytest.raises(InputError, match="boundary='zero'"):
            fourier_low_pass(random(4), (0,), 0.5, "zero")  # type: ignore[arg-type]


class TestGaussianBlur:
    @given(shapes, st.floats(0, 3), st.data())
    def test_matches_the_fast_transform(self, shape: list[int], radius: float, data: st.DataObject) -> None:
        axes = tuple(data.draw(st.sets(st.sampled_from(range(len(shape))))))
        values = random(*shape)
        found = gaussian_blur(values, axes, radius)
        np.testing.assert_allclose(found, oracles.gaussian_blur(values.numpy(), axes, radius), atol=1e-7)

    @pytest.mark.parametrize("sigma", [1.0, 2.5])
    def test_matches_a_sampled_gaussian(self, sigma: float) -> None:
        values = random(41).numpy()
        found = gaussian_blur(torch.tensor(values), (0,), sigma / 40)
        expected = gaussian_filter1d(values, sigma, mode="reflect", truncate=8)
        np.testing.assert_allclose(found, expected, atol=0.02 if sigma == 1 else 1e-6)

    @given(shapes, st.floats(0, 3))
    def test_keeps_the_mean(self, shape: list[int], radius: float) -> None:
        values = random(*shape, seed=2)
        found = gaussian_blur(values, tuple(range(len(shape))), radius)
        torch.testing.assert_close(found.mean(), values.mean(), rtol=0, atol=1e-12)

    def test_means_the_same_length_on_a_finer_grid(self) -> None:
        def blurred(size: int) -> Tensor:
            x = torch.linspace(0, 1, size, dtype=torch.float64)
            return gaussian_blur(torch.sin(12 * x) + (x > 0.4), (0,), 0.05)

        fine = nn.functional.interpolate(blurred(65)[None, None], 257, mode="linear", align_corners=True)
        torch.testing.assert_close(fine[0, 0], blurred(257), atol=0.06, rtol=0)

    def test_identity_gradcheck_and_errors(self) -> None:
        values = random(5, 4, requires_grad=True)
        assert gaussian_blur(values, (0, 1), 0.0) is values
        assert gradcheck(lambda x: gaussian_blur(x, (0, 1), 0.3), (values,))
        for radius in (-1.0, float("nan")):
            with pytest.raises(InputError, match="radius="):
                gaussian_blur(values, (0,), radius)


def test_constants_made_in_inference_mode_serve_training_too() -> None:
    values = random(13, 3)
    with torch.inference_mode():
        previews = fourier_low_pass(values, (0,), 0.37), gaussian_blur(values, (0,), 0.123)
    values.requires_grad_()
    trained = fourier_low_pass(values, (0,), 0.37), gaussian_blur(values, (0,), 0.123)
    for preview, result in zip(previews, trained, strict=True):
        assert torch.equal(preview, result.detach())
        (gradient,) = torch.autograd.grad(result.square().sum(), values)
        assert torch.isfinite(gradient).all()


class TestAnnealedRadius:
    def test_matches_the_formula_and_falls(self) -> None:
        radii = [annealed_radius(t, 300, start=0.15, rounds=30, rate=0.2, floor=0.01) for t in range(301)]
        expected = [0.01 + 0.15 / 2 ** (0.2 * (30 * t // 300)) for t in range(300)] + [0.01]
        np.testing.assert_allclose(radii, expected)
        assert radii == sorted(radii, reverse=True)


class Planes(nn.Module):
    """A field with a line and a plane, channels last."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.grids = nn.ParameterList(
            [nn.Parameter(random(size, 3).float()), nn.Parameter(random(size, size, 3, seed=1).float())]
        )

    def forward(self) -> Tensor:
        return torch.einsum("xr,yzr->xyzr", self.grids[0], self.grids[1])


LINES = gridreg.parameters("grids.0", dim=-1, spatial=(0,))
PLANES = gridreg.parameters("grids.1", dim=-1)


class TestAttached:
    @pytest.mark.parametrize(
        "regularizer",
        [FourierLowPass(PLANES, Linear(0.1, 1.0, until=0.5)), GridBlur(PLANES, until=50)],
    )
    def test_fully_open_is_bit_identical(self, regularizer: gridreg.Regularizer) -> None:
        field = Planes(8)
        before = field()
        handle = gridreg.apply(field, regularizer, total_steps=100)
        changes = []
        for step in (0, 20, 40):
            handle.step(step)
            changes.append((field() - before).abs().mean().item())
        assert changes[0] > changes[1] > changes[2] > 0
        handle.step(50)
        assert torch.equal(field(), before)
        handle.step(10)
        handle.remove()
        assert torch.equal(field(), before)

    def test_the_share_survives_resampling(self) -> None:
        field = Planes(8)
        handle = gridreg.apply(field, FourierLowPass(PLANES, 0.5), total_steps=100)
        for size in (8, 20, 33):
            with handle.suspended():
                field.grids[1] = nn.Parameter(random(size, size, 3).float())
            spectrum = np.abs(np.fft.fft2(field.grids[1].detach().numpy(), axes=(0, 1)))
            frequencies = np.abs(np.fft.fftfreq(size, 1 / size))
            closed = frequencies > 0.5 * (size // 2) + 1
            np.testing.assert_allclose(spectrum[closed], 0, atol=1e-4)
            np.testing.assert_allclose(spectrum[:, closed], 0, atol=1e-4)
            assert spectrum[0, 1].max() > 1e-2

    def test_it_filters_only_the_channels_that_take_part(self) -> None:
        field = Planes(8)
        before = field.grids[1].detach().clone()
        site = gridreg.parameters("grids.1", dim=-1, channels=[0, 2])
        handle = gridreg.apply(field, FourierLowPass(site, 0.25), total_steps=100)
        after = field.grids[1].detach()
        assert torch.equal(after[..., 1], before[..., 1])
        expected = fourier_low_pass(before[..., [0, 2]], (0, 1), 0.25)
        torch.testing.assert_close(after[..., [0, 2]], expected)
        handle.remove()

    def test_a_compiled_field_follows_the_step(self) -> None:
        field = Planes(8)
        handle = gridreg.apply(
            field, FourierLowPass(PLANES, Linear(0.1, 1.0)), GridBlur(LINES, until=4), total_steps=10
        )
        compiled = torch.compile(field, backend="eager")
        for step in (0, 2, 5):
            handle.step(step)
            torch.testing.assert_close(compiled(), field())

    def test_values_for_tables(self) -> None:
        field = Planes(8)
        handle = gridreg.apply(
            field,
            FourierLowPass(LINES, Linear(0.2, 1.0)),
            GridBlur(PLANES, until=100, start=0.2, rounds=10, rate=1.0),
            total_steps=100,
        )
        handle.step(50)
        assert list(handle.values().values()) == [pytest.approx(0.6), pytest.approx(0.2 / 2**5)]

    def test_a_place_without_spatial_axes_is_an_error(self) -> None:
        field = nn.Sequential(nn.Linear(4, 5))
        with pytest.raises(
            InputError, match=r"has no spatial axis longer than 1 \(in a table.*name its axes"
        ):
            gridreg.apply(field, FourierLowPass(gridreg.parameters("0.bias", dim=0)), total_steps=10)

    @pytest.mark.parametrize(
        ("cls", "arguments", "message"),
        [
            (FourierLowPass, {"keep": 1.5}, r"keep=1\.5"),
            (FourierLowPass, {"boundary": "zero"}, "boundary='zero'"),
            (GridBlur, {"start": -1.0}, r"start=-1\.0"),
            (GridBlur, {"rate": "fast"}, "rate='fast'"),
            (GridBlur, {"until": -3}, "until=-3"),
        ],
    )
    def test_bad_arguments(self, cls: Any, arguments: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            cls("density", **arguments)
        with pytest.raises(InputError, match="site=None"):
            cls(None)

    def test_a_schedule_that_leaves_the_range_is_refused_when_it_does(self) -> None:
        context = Context(Clock(10, seed=0))
        context.clock.step = 3
        with pytest.raises(InputError, match="keep=3 at step 3"):
            FourierLowPass("density", keep=lambda step: float(step)).number(context)


@pytest.mark.parametrize("shape", [(1, 4, 5, 6), (1, 4, 5, 6, 7)])
@pytest.mark.parametrize("keep", [0.2, 0.9])
def test_a_filter_keeps_the_dtype_under_autocast_and_the_memory_format(
    shape: tuple[int, ...], keep: float
) -> None:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    form = torch.channels_last if len(shape) == 4 else torch.channels_last_3d
    axes = tuple(range(2, len(shape)))
    expected = fourier_low_pass(values, axes, keep)
    last = values.to(memory_format=form)
    with torch.autocast("cpu", torch.bfloat16):
        found, blurred = fourier_low_pass(last, axes, keep), gaussian_blur(last, axes, 0.1)
        plain = fourier_low_pass(values, axes, keep)
    torch.testing.assert_close(found, expected)
    assert torch.equal(plain, expected)
    assert found.dtype == blurred.dtype == torch.float32
    assert found.is_contiguous(memory_format=form)
    assert blurred.is_contiguous(memory_format=form)
    assert plain.is_contiguous()
