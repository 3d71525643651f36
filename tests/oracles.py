"""Independent NumPy versions of the formulas, written from the papers, and batches to try them on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import strategies as st
from numpy.typing import NDArray

from gridreg.samples import RaySamples

Array = NDArray[np.float64]


@dataclass
class Batch:
    """A rectangle of rays in NumPy; where `valid` is False the sample is skipped and counts as density 0."""

    t: Array
    delta: Array
    density: Array
    colours: Array
    valid: NDArray[np.bool_]

    @property
    def alpha(self) -> Array:
        return np.where(self.valid, 1 - np.exp(-self.density * self.delta), 0.0)

    @property
    def weights(self) -> Array:
        result = np.zeros_like(self.t)
        for ray, alphas in enumerate(self.alpha):
            transmittance = 1.0
            for i, alpha in enumerate(alphas):
                result[ray, i] = transmittance * alpha
                transmittance *= 1 - alpha
        return result

    def samples(self, *, grad: bool = False, **extra: object) -> RaySamples:
        """The batch as the toolkit sees it, packed, in float64."""
        dense = {name: torch.tensor(getattr(self, name)) for name in ("t", "delta", "density", "colours")}
        dense["density"].requires_grad_(grad)
        valid = torch.tensor(self.valid)
        return RaySamples.from_dense(**dense, valid=valid, **extra)  # type: ignore[arg-type]

    def rays(self) -> Iterator[tuple[Array, Array, Array]]:
        """Distances, interval lengths and weights of the kept samples of each ray."""
        weights = self.weights
        for ray, kept in enumerate(self.valid):
            yield self.t[ray, kept], self.delta[ray, kept], weights[ray, kept]


def make_batch(seed: int, rays: int, width: int, kept: float = 0.7, scale: float = 2.0) -> Batch:
    """Random rays; about a share `kept` of the samples is valid."""
    rng = np.random.default_rng(seed)
    delta = rng.uniform(0.05, 0.3, (rays, width))
    t = 2.0 + np.cumsum(delta, 1) - delta / 2
    density = rng.exponential(scale, (rays, width))
    return Batch(
        t, delta, density, rng.uniform(0, 1, (rays, width, 3)), rng.uniform(size=(rays, width)) < kept
    )


batches = st.builds(
    make_batch,
    seed=st.integers(0, 2**16),
    rays=st.integers(0, 6),
    width=st.integers(0, 9),
    kept=st.sampled_from([0.0, 0.3, 0.8, 1.0]),
    scale=st.sampled_from([0.1, 3.0, 100.0]),
)


def occlusion(batch: Batch, mask: NDArray[np.bool_], on: str = "density") -> float:
    """FreeNeRF: the mean over the whole rectangle of value times mask."""
    values = batch.density if on == "density" else batch.weights
    return float(np.mean(values * mask * batch.valid)) if values.size else 0.0


def opacity_entropy(batch: Batch) -> float:
    """DVGO's entropy of the last transmittance."""
    clear = np.clip(1 - batch.weights.sum(1), 1e-6, 1 - 1e-6)
    return mean(-(clear * np.log(clear) + (1 - clear) * np.log(1 - clear)))


def ray_entropy(batch: Batch, threshold: float) -> float:
    """InfoNeRF: entropy of the normalised opacities of rays that hit something."""
    result = []
    for alpha, opacity in zip(batch.alpha, batch.weights.sum(1), strict=True):
        share = alpha / (alpha.sum() + 1e-10)
        result.append(-sum(p * np.log(p + 1e-10) for p in share) if opacity > threshold else 0.0)
    return mean(result)


def distortion(batch: Batch, near: float = 0.0, far: float = 1.0) -> float:
    """mip-NeRF 360 equation 15, the double sum as printed."""
    result = []
    for t, delta, weights in batch.rays():
        s, lengths = (t - near) / (far - near), delta / (far - near)
        pairs = np.abs(s[:, None] - s[None, :]) * weights[:, None] * weights[None, :]
        result.append(pairs.sum() + (weights**2 * lengths).sum() / 3)
    return mean(result)


def depth_smoothness(depth: Array) -> float:
    """RegNeRF's geometry regularization on depth maps (count, height, width)."""
    count, height, width = depth.shape
    total = 0.0
    for n in range(count):
        for i in range(height - 1):
            for j in range(width - 1):
                total += (depth[n, i, j] - depth[n, i + 1, j]) ** 2
                total += (depth[n, i, j] - depth[n, i, j + 1]) ** 2
    return total / (count * (height - 1) * (width - 1))


def ray_kl(alpha: Array) -> float:
    """InfoNeRF's divergence of opacities (count, height, width, steps): each ray and the one to its right."""
    share = alpha / (alpha.sum(-1, keepdims=True) + 1e-10) + 1e-10
    p, q = share[:, :, :-1], share[:, :, 1:]
    return float(np.mean((p * np.log(p / q)).sum(-1)))


def proposal_loss(fine: Batch, coarse: Batch) -> float:
    """mip-NeRF 360 equation 13: what exceeds the sum of the overlapping intervals of the proposal."""
    result = []
    for (t, delta, weights), (s, length, allowed) in zip(fine.rays(), coarse.rays(), strict=True):
        total = 0.0
        for i in range(len(t)):
            a, b = t[i] - delta[i] / 2, t[i] + delta[i] / 2
            overlap = [
                min(b, x + d / 2) - max(a, x - d / 2) > 1e-3 * delta[i]
                for x, d in zip(s, length, strict=True)
            ]
            total += max(0.0, weights[i] - allowed[np.array(overlap, dtype=bool)].sum()) ** 2 / (
                weights[i] + 1e-7
            )
        result.append(total)
    return mean(result)


def normal_smoothness(normals: Array) -> float:
    """The absolute differences of normals (count, height, width, 3) to the ray below and to the one on the right."""
    count, height, width, _ = normals.shape
    found = [
        np.abs(normals[n, i, j] - normals[n, i + di, j + dj]).sum()
        for n in range(count)
        for i in range(height - 1)
        for j in range(width - 1)
        for di, dj in ((1, 0), (0, 1))
    ]
    return float(np.sum(found)) / (count * (height - 1) * (width - 1))


def depth_correlation(depth: Array, target: Array) -> float:
    """One less NumPy's own correlation coefficient."""
    return 1 - float(np.corrcoef(depth, target)[0, 1])


def depth_residual(depth: Array, target: Array) -> float:
    """What the best straight line leaves, by NumPy's least squares."""
    columns = np.stack([depth, np.ones_like(depth)], axis=1)
    best = np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(np.mean((columns @ best - target) ** 2))


def time_smoothness(values: Array, axis: int) -> float:
    """K-Planes: squared second differences along time, one cell after another."""
    lines = np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis])
    return mean([(v[i - 1] - 2 * v[i] + v[i + 1]) ** 2 for v in lines for i in range(1, len(v) - 1)])


def mean(values: Array | list[float]) -> float:
    return float(np.mean(values)) if len(values) else 0.0


def huber(x: float, delta: float) -> float:
    """Huber's function: a parabola in the middle, straight lines beyond."""
    return x * x / 2 if abs(x) <= delta else delta * (abs(x) - delta / 2)


def total_variation(values: Array, axes: set[int], form: Callable[[float], float] = lambda x: x**2) -> float:
    """Sum over axes of the mean squared difference of neighbours, or of another function of it."""
    total = 0.0
    for axis in axes:
        lines = np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis])
        squares = [form(line[i + 1] - line[i]) for line in lines for i in range(len(line) - 1)]
        total += mean(squares)
    return total


def orthogonality(lines: Array) -> float:
    """TensoRF's vectorDiffs: the mean absolute dot product of different rows."""
    dots = [abs(float(a @ b)) for i, a in enumerate(lines) for j, b in enumerate(lines) if i != j]
    return mean(dots)


def fourier_low_pass(values: Array, axes: tuple[int, ...], keep: float, boundary: str = "periodic") -> Array:
    """Axis by axis: transform, multiply each frequency, transform back. A mirror doubles the signal first."""
    for axis in axes:
        lines = np.moveaxis(values, axis, -1)
        size = lines.shape[-1]
        highest = size // 2 if boundary == "periodic" else size - 1
        signal = lines if boundary == "periodic" else np.concatenate([lines, lines[..., ::-1]], -1)
        spectrum = np.fft.rfft(signal)
        factors = np.clip(keep * highest - np.arange(spectrum.shape[-1]) + 1, 0, 1)
        values = np.moveaxis(np.fft.irfft(spectrum * factors, signal.shape[-1])[..., :size], -1, axis)
    return values


def gaussian_blur(values: Array, axes: tuple[int, ...], radius: float) -> Array:
    """Axis by axis: the continued Gaussian's transform, on the signal followed by its mirror image."""
    for axis in axes:
        lines = np.moveaxis(values, axis, -1)
        size = lines.shape[-1]
        spectrum = np.fft.rfft(np.concatenate([lines, lines[..., ::-1]], -1))
        angles = 2 * np.pi * np.arange(spectrum.shape[-1]) / (2 * size)
        factors = np.exp(-((angles * radius * (size - 1)) ** 2) / 2)
        values = np.moveaxis(np.fft.irfft(spectrum * factors, 2 * size)[..., :size], -1, axis)
    return values
