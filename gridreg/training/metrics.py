"""PSNR and SSIM, each in a named convention, so that two numbers are compared only if they mean the same.

All metrics take images of shape ``(H, W, C)`` in [0, 1] (clamped to it first, as the published programs do)
and are computed in float64 on the images' own device. SSIM comes in two conventions, which differ by some
hundredths:

``gaussian``
    11x11 Gaussian window, sigma 1.5, population covariance: Wang et al. 2004, "Image quality assessment: from
    error visibility to structural similarity". Used by mip-NeRF, TensoRF and most others. TensoRF's
    ``rgb_ssim`` convolves in 'valid' mode; scikit-image filters with reflected borders and then crops the
    border of 5 pixels, which leaves the same numbers, so this convention equals both.
``uniform``
    7x7 uniform window, sample covariance (divided by 48 instead of 49): the defaults of scikit-image, used by
    FreeNeRF.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from gridreg.errors import InputError

__all__ = [
    "SsimConvention",
    "image_metrics",
    "json_number",
    "json_ready",
    "mean_metrics",
    "mean_psnr",
    "mse_to_psnr",
    "psnr",
    "ssim",
]

SsimConvention = Literal["gaussian", "uniform"]

_K1, _K2 = 0.01, 0.03


def mse_to_psnr(mse: float) -> float:
    """PSNR in dB of a mean squared error of values in [0, 1]: ``-10 log10(mse)``, infinite for 0.

    Example:
        >>> mse_to_psnr(0.01)
        20.0
        >>> mse_to_psnr(0.0)
        inf
    """
    if math.isnan(mse):
        return math.nan
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of one image ``(H, W, C)``; infinite if both are identical.

    The mean of the squared error runs over pixels and channels together, after clamping both to [0, 1].

    Raises:
        InputError: if the shapes differ or are not ``(H, W, C)``.

    Example:
        >>> psnr(torch.full((4, 4, 3), 0.5), torch.full((4, 4, 3), 0.6)) # doctest: +ELLIPSIS
        19.99999...
    """
    a, b = _pair(image, target)
    return mse_to_psnr(float((a - b).square().mean()))


def mean_psnr(images: Iterable[Tensor], targets: Iterable[Tensor]) -> float:
    """Mean over images of the PSNR of each, as papers report it (not the PSNR of the mean error).

    Raises:
        InputError: if there is no image, or the numbers of images or the shapes differ.
    """
    images, targets = list(images), list(targets)
    if len(images) != len(targets) or not images:
        raise InputError(
            f"images, targets: {len(images)} and {len(targets)}; expected equally many, at least one"
        )
    return _mean([psnr(a, b) for a, b in zip(images, targets, strict=True)])


def ssim(image: Tensor, target: Tensor, convention: SsimConvention = "gaussian") -> float:
    """Structural similarity of two images ``(H, W, C)``, mean over pixels and channels, at most 1.

    Equal to ``skimage.metrics.structural_similarity(image, target, data_range=1.0, channel_axis=-1, ...)`` on
    float64 images, with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False`` for
    ``"gaussian"`` and with nothing more for ``"uniform"``.

    Args:
        image: ``(H, W, C)`` in [0, 1].
        target: the same shape.
        convention: ``"gaussian"`` (11x11, TensoRF and most) or ``"uniform"`` (7x7, FreeNeRF), see the module.

    Raises:
        InputError: if the shapes differ, an image is smaller than the window, or the convention is unknown.

    Example:
        >>> ssim(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3))
        1.0
    """
    a, b = _pair(image, target)
    if convention == "gaussian":
        window = _gaussian_window(a)
        correction = 1.0
    elif convention == "uniform":
        window = torch.full((7,), 1 / 7, dtype=a.dtype, device=a.device)
        correction = 49 / 48
    else:
        raise InputError(f"convention: {convention!r}; expected one of {', '.join(get_args(SsimConvention))}")
    if min(a.shape[:2]) < len(window):
        raise InputError(
            f"image: {a.shape[0]}x{a.shape[1]} pixels; {convention} SSIM needs {len(window)} or more each way"
        )
    mean_a, mean_b, mean_aa, mean_bb, mean_ab = _filter(torch.stack([a, b, a * a, b * b, a * b]), window)
    var_a = correction * (mean_aa - mean_a * mean_a)
    var_b = correction * (mean_bb - mean_b * mean_b)
    cov = correction * (mean_ab - mean_a * mean_b)
    c1, c2 = _K1**2, _K2**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    structure = (2 * cov + c2) / (var_a + var_b + c2)
    return float((luminance * structure).mean())


def image_metrics(
    image: Tensor, target: Tensor, more: Mapping[str, Callable[[Tensor, Tensor], float]] | None = None
) -> dict[str, float]:
    """The metrics of one image by name: ``psnr`` (dB), ``ssim_gaussian``, ``ssim_uniform``, and ``more``.

    Args:
        image: ``(H, W, C)`` in [0, 1].
        target: the same shape.
        more: further metrics by name, such as ``{lpips.name: lpips}`` of `gridreg.training.perceptual`.

    Raises:
        InputError: as ``psnr`` and ``ssim``.
    """
    return {
        "psnr": psnr(image, target),
        "ssim_gaussian": ssim(image, target, "gaussian"),
        "ssim_uniform": ssim(image, target, "uniform"),
        **{name: metric(image, target) for name, metric in (more or {}).items()},
    }


def mean_metrics(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean over images of every metric, by name.

    Raises:
        InputError: if there is no row, or the rows do not hold the same metrics.

    Example:
        >>> mean_metrics([{"psnr": 20.0}, {"psnr": 22.0}])
        {'psnr': 21.0}
    """
    if not rows:
        raise InputError("rows: no image was evaluated; expected at least one")
    for row in rows:
        if set(row) != set(rows[0]):
            raise InputError(
                f"rows: {sorted(row)} beside {sorted(rows[0])}; expected the same metrics in all"
            )
    return {name: _mean([row[name] for row in rows]) for name in rows[0]}


def json_number(value: float) -> float | str:
    """The number, or ``"inf"``, ``"-inf"``, ``"nan"`` as text, for which JSON has no number.

    ``float()`` reads both forms back.

    Example:
        >>> json_number(25.5), json_number(math.inf)
        (25.5, 'inf')
    """
    return float(value) if math.isfinite(value) else str(float(value))


def json_ready(value: Any) -> Any:
    """Plain data in which every float is one that JSON has, see ``json_number``; tuples become lists.

    Example:
        >>> json_ready({"psnr": math.inf, "steps": (1, 2)})
        {'psnr': 'inf', 'steps': [1, 2]}
    """
    if isinstance(value, Mapping):
        return {str(key): json_ready(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(inner) for inner in value]
    return json_number(value) if isinstance(value, float) else value


def _pair(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != target.shape:
        raise InputError(
            f"image, target: shapes {tuple(image.shape)} and {tuple(target.shape)}; expected equal"
        )
    if image.ndim != 3 or image.numel() == 0:
        raise InputError(f"image: shape {tuple(image.shape)}; expected (H, W, C)")
    # Apple's GPUs have no float64.
    dtype = torch.float32 if image.device.type == "mps" else torch.float64
    a = image.detach().to(dtype).clamp(0, 1)
    return a, target.detach().to(a).clamp(0, 1)


def _gaussian_window(like: Tensor) -> Tensor:
    """Weights (11,) of sigma 1.5 that sum to 1."""
    x = torch.arange(-5, 6, dtype=like.dtype, device=like.device)
    window = torch.exp(-0.5 * (x / 1.5).square())
    return window / window.sum()


def _filter(stack: Tensor, window: Tensor) -> Tensor:
    """Separable 'valid' convolution of ``(5, H, W, C)`` along H and W with a symmetric window ``(K,)``."""
    weights: list[float] = window.tolist()
    rows, columns = stack.shape[1] - len(weights) + 1, stack.shape[2] - len(weights) + 1
    # Shifted sums: torch's convolutions have no fast float64 path on the CPU.
    vertical = weights[0] * stack[:, :rows]
    for offset, weight in enumerate(weights[1:], start=1):
        vertical.add_(stack[:, offset : offset + rows], alpha=weight)
    result = weights[0] * vertical[:, :, :columns]
    for offset, weight in enumerate(weights[1:], start=1):
        result.add_(vertical[:, :, offset : offset + columns], alpha=weight)
    return result


def _mean(values: Sequence[float]) -> float:
    # math.fsum refuses inf - inf and is not needed: a mean with one infinity is infinite, with a NaN it is
    # NaN.
    return sum(values) / len(values)
