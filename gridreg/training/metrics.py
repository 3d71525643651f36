"""PSNR and SSIM, each in a named convention, so that two numbers are compared only if they mean the same.

All metrics take images of shape ``(H, W, C)`` in [0, 1] (clamped to it first, as the published programs do)
and are computed in float64. SSIM comes in two conventions, which differ by some
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
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

from skimage.metrics import structural_similarity
from torch import Tensor

from gridreg.errors import InputError

SsimConvention = Literal["gaussian", "uniform"]

# Keywords of scikit-image, and the smallest image that its window fits into, pixels.
_SSIM: dict[str, tuple[dict[str, Any], int]] = {
    "gaussian": ({"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}, 11),
    "uniform": ({}, 7),
}


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of one image ``(H, W, C)``; infinite if both are identical.

    The mean of the squared error runs over pixels and channels together, after clamping both to [0, 1].

    Raises:
        InputError: if the shapes differ or are not ``(H, W, C)``.

    Example:
        >>> import torch
        >>> psnr(torch.full((4, 4, 3), 0.5), torch.full((4, 4, 3), 0.6)) # doctest: +ELLIPSIS
        19.99999...
    """
    a, b = _pair(image, target)
    mse = float((a - b).square().mean())
    return math.inf if mse == 0 else mse if math.isnan(mse) else -10.0 * math.log10(mse)


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
        >>> import torch
        >>> ssim(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3))
        1.0
    """
    a, b = _pair(image, target)
    if convention not in _SSIM:
        raise InputError(f"convention: {convention!r}; expected one of {', '.join(get_args(SsimConvention))}")
    options, least = _SSIM[convention]
    if min(a.shape[:2]) < least:
        raise InputError(
            f"image: {a.shape[0]}x{a.shape[1]} pixels; {convention} SSIM needs {least} or more each way"
        )
    found = structural_similarity(  # type: ignore[no-untyped-call]
        a.numpy(), b.numpy(), data_range=1.0, channel_axis=-1, **options
    )
    return float(found)


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
    # math.fsum refuses inf - inf and is not needed: a mean with one infinity is infinite, with a NaN it is NaN.
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def json_ready(value: Any) -> Any:
    """Plain data in which floats that JSON has no number for are text, which ``float`` reads; tuples become lists.

    Example:
        >>> json_ready({"psnr": math.inf, "steps": (1, 2)})
        {'psnr': 'inf', 'steps': [1, 2]}
    """
    if isinstance(value, Mapping):
        return {str(key): json_ready(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(inner) for inner in value]
    return str(float(value)) if isinstance(value, float) and not math.isfinite(value) else value


def _pair(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != target.shape:
        raise InputError(
            f"image, target: shapes {tuple(image.shape)} and {tuple(target.shape)}; expected equal"
        )
    if image.ndim != 3 or image.numel() == 0:
        raise InputError(f"image: shape {tuple(image.shape)}; expected (H, W, C)")
    a, b = (x.detach().cpu().double().clamp(0, 1) for x in (image, target))
    return a, b
