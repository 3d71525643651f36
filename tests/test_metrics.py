"""PSNR and SSIM against TensoRF's own SSIM, and against their definitions."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import convolve2d
from skimage.metrics import peak_signal_noise_ratio

from gridreg.errors import InputError
from gridreg.training import metrics


def image_pair(
    seed: int, height: int = 24, width: int = 31, noise: float = 0.1
) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture and a noisy copy, both within [0, 1], float64."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 10
    phase = rng.uniform(0, 6, 3)
    target = 0.5 + 0.4 * np.sin(x[..., None] + phase) * np.cos(y[..., None] - phase)
    return np.clip(target + noise * rng.standard_normal(target.shape), 0, 1), target


def tensorf_rgb_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM as the public TensoRF program computes it ('valid' convolution, clipped covariances)."""
    x = np.arange(11) - 5
    taps = np.exp(-0.5 * (x / 1.5) ** 2)
    taps /= taps.sum()

    def blur(z: np.ndarray) -> np.ndarray:
        channels = [
            convolve2d(convolve2d(z[..., i], taps[:, None], mode="valid"), taps[None, :], mode="valid")
            for i in range(z.shape[-1])
        ]
        return np.stack(channels, -1)

    mu0, mu1 = blur(a), blur(b)
    s00 = np.maximum(0, blur(a**2) - mu0**2)
    s11 = np.maximum(0, blur(b**2) - mu1**2)
    s01 = blur(a * b) - mu0 * mu1
    s01 = np.sign(s01) * np.minimum(np.sqrt(s00 * s11), np.abs(s01))
    numerator = (2 * mu0 * mu1 + 1e-4) * (2 * s01 + 9e-4)
    return float((numerator / ((mu0**2 + mu1**2 + 1e-4) * (s00 + s11 + 9e-4))).mean())


def uniform_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, equation 13, over every whole window of 7x7, with sample covariances."""
    x, y = (np.lib.stride_tricks.sliding_window_view(z, (7, 7), axis=(0, 1)) for z in (a, b))
    mx, my = x.mean((-1, -2)), y.mean((-1, -2))
    vx, vy = x.var((-1, -2), ddof=1), y.var((-1, -2), ddof=1)
    cov = ((x - mx[..., None, None]) * (y - my[..., None, None])).sum((-1, -2)) / 48
    return float(
        ((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()
    )


@pytest.mark.parametrize("convention", ["gaussian", "uniform"])
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    height=st.integers(11, 40),
    width=st.integers(11, 40),
    noise=st.floats(0, 1),
)
def test_ssim_is_what_the_papers_compute(convention, seed, height, width, noise):
    a, b = image_pair(seed, height, width, noise)
    reference = tensorf_rgb_ssim if convention == "gaussian" else uniform_ssim
    got = metrics.ssim(torch.from_numpy(a), torch.from_numpy(b), convention)
    assert got == pytest.approx(reference(a, b), abs=1e-11)


def test_the_conventions_are_different_numbers():
    a, b = map(torch.from_numpy, image_pair(0))
    assert abs(metrics.ssim(a, b, "gaussian") - metrics.ssim(a, b, "uniform")) > 0.01


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.floats(0.001, 1))
def test_psnr_equals_scikit_image(seed, noise):
    a, b = image_pair(seed, noise=noise)
    got = metrics.psnr(torch.from_numpy(a), torch.from_numpy(b))
    assert got == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1.0), abs=1e-9)


@pytest.mark.parametrize("function", [metrics.psnr, metrics.ssim])
def test_values_outside_the_range_are_clamped(function):
    a, b = map(torch.from_numpy, image_pair(3))
    assert function(a * 4 - 1, b) == function((a * 4 - 1).clamp(0, 1), b)


@pytest.mark.parametrize("function", [metrics.psnr, metrics.ssim])
def test_float32_images_are_measured_in_float64(function):
    a, b = (torch.from_numpy(x).float() for x in image_pair(4, noise=1e-4))
    assert function(a, b) == function(a.double(), b.double())


def test_identical_images():
    a = torch.from_numpy(image_pair(5)[0])
    assert metrics.psnr(a, a.clone()) == math.inf
    assert metrics.ssim(a, a.clone(), "gaussian") == pytest.approx(1.0, abs=1e-12)
    assert metrics.ssim(a, a.clone(), "uniform") == pytest.approx(1.0, abs=1e-12)


def test_symmetry_and_order():
    a, b = map(torch.from_numpy, image_pair(6, noise=0.05))
    worse = torch.from_numpy(image_pair(6, noise=0.3)[0])
    for name, value in metrics.image_metrics(a, b).items():
        assert value == pytest.approx(metrics.image_metrics(b, a)[name], abs=1e-12)
        assert value > metrics.image_metrics(worse, b)[name]


def test_nan_is_not_hidden():
    a, b = map(torch.from_numpy, image_pair(7))
    a[12, 12, 0] = math.nan
    assert math.isnan(metrics.psnr(a, b))
    assert math.isnan(metrics.ssim(a, b))
    assert math.isnan(metrics.mean_metrics([{"psnr": 20.0}, {"psnr": metrics.psnr(a, b)}])["psnr"])


def test_inputs_and_gradients_are_left_alone():
    a, b = map(torch.from_numpy, image_pair(8))
    a.requires_grad_()
    before = a.detach().clone()
    assert isinstance(metrics.ssim(a, b), float)
    assert isinstance(metrics.psnr(a, b), float)
    assert torch.equal(a.detach(), before)
    assert a.grad is None


def test_image_and_mean_metrics():
    rows = [metrics.image_metrics(*map(torch.from_numpy, image_pair(s))) for s in range(3)]
    assert list(rows[0]) == ["psnr", "ssim_gaussian", "ssim_uniform"]
    mean = metrics.mean_metrics(rows)
    for name in rows[0]:
        assert mean[name] == pytest.approx(np.mean([r[name] for r in rows]), abs=1e-12)


def test_further_metrics_stand_under_their_names():
    a, b = map(torch.from_numpy, image_pair(1))
    got = metrics.image_metrics(a, b, {"largest": lambda x, y: float((x - y).abs().max())})
    assert list(got) == ["psnr", "ssim_gaussian", "ssim_uniform", "largest"]
    assert got["largest"] == float((a - b).abs().max())


def test_numbers_for_json():
    values = [25.0, math.inf, -math.inf, 1e-300]
    text = json.dumps(metrics.json_ready(values), allow_nan=False)
    assert [float(v) for v in json.loads(text)] == values
    assert math.isnan(float(metrics.json_ready(math.nan)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: metrics.psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3)), r"\(4, 4, 3\) and \(4, 5, 3\)"),
        (lambda: metrics.psnr(torch.zeros(4, 4), torch.zeros(4, 4)), r"expected \(H, W, C\)"),
        (lambda: metrics.psnr(torch.zeros(0, 4, 3), torch.zeros(0, 4, 3)), r"expected \(H, W, C\)"),
        (lambda: metrics.ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3)), "11 or more each way"),
        (lambda: metrics.ssim(torch.zeros(9, 6, 3), torch.zeros(9, 6, 3), "uniform"), "7 or more each way"),
        (lambda: metrics.ssim(torch.zeros(9, 9, 3), torch.zeros(9, 9, 3), "box"), "gaussian, uniform"),
        (lambda: metrics.mean_metrics([]), "at least one"),
        (lambda: metrics.mean_metrics([{"psnr": 1.0}, {"ssim": 1.0}]), "expected the same"),
    ],
)
def test_bad_input_is_one_line(call, message):
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
