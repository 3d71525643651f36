"""Alpha compositing along packed rays: weights (TensoRF's ``raw2alpha``), weighted sums, early ray termination.

The samples of ray r are ``offsets[r] : offsets[r + 1]`` of ``N`` samples in all.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops.dispatch import is_cpu_float32, operation

# Elements of a padded rectangle (rays, samples): bounds the temporary memory to some tens of megabytes.
_BLOCK = 1 << 20


def check_packed(values: Tensor, offsets: Tensor, name: str = "optical_depth") -> None:
    """Raise `InputError` unless ``values`` is ``(N,)`` and ``offsets`` ``(R + 1,)`` int64 that ends at N."""
    if values.dim() != 1:
        raise InputError(f"{name}: found shape {tuple(values.shape)}, expected (N,)")
    if offsets.dim() != 1 or offsets.numel() == 0 or offsets.dtype != torch.int64:
        raise InputError(
            f"offsets: found {offsets.dtype} of shape {tuple(offsets.shape)}, expected (R + 1,) int64"
        )
    if offsets.device.type == "cpu" and int(offsets[-1]) != values.shape[0]:
        raise InputError(
            f"offsets: found the end {int(offsets[-1])}, expected {values.shape[0]}, the length of {name}"
        )


def ray_of_sample(offsets: Tensor, samples: int) -> Tensor:
    """The ray of each of ``samples``, ``(N,)`` int64."""
    rays = torch.arange(offsets.numel() - 1, device=offsets.device)
    return rays.repeat_interleave(offsets.diff(), output_size=samples)


def _blocks(offsets: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Groups of whole rays whose padded rectangle is small: their samples, and offsets that start at 0."""
    longest = int(offsets.diff().max()) if offsets.numel() > 1 else 0
    block = max(1, _BLOCK // max(1, longest))
    for first in range(0, offsets.numel() - 1, block):
        part = offsets[first : first + block + 1]
        yield slice(int(part[0]), int(part[-1])), part - part[0]


def _depth_before(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Optical depth that lies in front of every sample, ``(N,)``.

    A padded rectangle, as the rounding of one running sum over all rays would grow with the number of rays.
    """
    # Above this exp(-tau) is 0 in float64, and inf * 0 in a derivative would be NaN.
    finite = optical_depth.clamp(max=1e3)
    parts = [finite[:0]]
    for samples, part in _blocks(offsets):
        tau = finite[samples]
        ray = ray_of_sample(part, tau.numel())
        index = torch.arange(tau.numel(), device=tau.device) - part[ray]
        longest = int(part.diff().max())
        padded = tau.new_zeros(part.numel() - 1, longest + 1).index_put((ray, index + 1), tau)
        parts.append(padded.cumsum(1)[ray, index])
    return torch.cat(parts)


@operation(check=check_packed)
def composite_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Volume rendering weights ``w_i = T_i (1 - exp(-tau_i))``, ``T_i = exp(-sum_{j < i} tau_j)``.

    Args:
        optical_depth: ``tau (N,)``, density x interval length, at least 0; ``inf`` is an opaque sample.
        offsets: ``(R + 1,)`` int64; the samples of ray r are ``offsets[r] : offsets[r + 1]``.

    Returns:
        ``(N,)`` weights, differentiable once.

    Raises:
        InputError: if ``offsets`` does not end at N.

    References:
        Max, "Optical models for direct volume rendering" (1995); Mildenhall et al., "NeRF" (2020), equation
        3; TensoRF's program calls it ``raw2alpha``.

    Example:
        >>> composite_weights(torch.tensor([0.6931472, 0.6931472]), torch.tensor([0, 2])).tolist()
        [0.5, 0.25]
    """
    return torch.exp(-_depth_before(optical_depth, offsets)) * -torch.expm1(-optical_depth)


def accumulate(weights: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """Weighted sum of ``values`` along every ray (nerfacc's ``accumulate_along_rays``, a ``scatter_add`` elsewhere).

    Args:
        weights: ``(N,)``.
        values: ``(N, K)``.
        offsets: ``(R + 1,)`` int64.

    Returns:
        ``(R, K)``, 0 for rays without samples; differentiable in both.

    Raises:
        InputError: if the shapes do not fit.

    Example:
        >>> accumulate(torch.tensor([0.5, 0.25]), torch.ones(2, 1), torch.tensor([0, 2, 2])).tolist()
        [[0.75], [0.0]]
    """
    check_packed(weights, offsets, "weights")
    if values.dim() != 2 or values.shape[0] != weights.shape[0]:
        raise InputError(f"values: found shape {tuple(values.shape)}, expected ({weights.shape[0]}, K)")
    ray = ray_of_sample(offsets, weights.numel())
    sums = values.new_zeros(offsets.numel() - 1, values.shape[1])
    return sums.index_add(0, ray, weights[:, None] * values)


def _check_pixels(weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor) -> None:
    check_packed(weights, offsets, "weights")
    for name, value, shape in (
        ("colours", colours, (len(weights), 3)),
        ("t", t, (len(weights),)),
        ("background", background, (len(offsets) - 1, 3)),
    ):
        if tuple(value.shape) != shape:
            raise InputError(f"{name}: found shape {tuple(value.shape)}, expected {shape}")


@operation(check=_check_pixels)
def pixels(
    weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, opacity and depth of every ray.

    Args:
        weights: ``(N,)``.
        colours: ``(N, 3)``.
        t: ``(N,)`` distance along the ray, world units.
        background: ``(R, 3)``, seen through what is left.
        offsets: ``(R + 1,)`` int64.

    Returns:
        ``sum w c + (1 - sum w) background (R, 3)``, ``sum w (R,)`` and ``sum w t (R,)``, differentiable once.

    Raises:
        InputError: if the shapes do not fit.

    Example:
        >>> w, c, t = torch.tensor([0.5, 0.25]), torch.ones(2, 3), torch.tensor([1.0, 2.0])
        >>> [x.tolist() for x in pixels(w, c, t, torch.zeros(1, 3), torch.tensor([0, 2]))]
        [[[0.75, 0.75, 0.75]], [0.75], [1.0]]
    """
    stacked = torch.cat([colours, t[:, None], torch.ones_like(t[:, None])], dim=-1)
    total = accumulate(weights, stacked, offsets)
    opacity = total[:, 4]
    return total[:, :3] + (1 - opacity)[:, None] * background, opacity, total[:, 3]


def pixels_suit_cpu(weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor) -> bool:
    """Whether the compiled `pixels`, which has no gradient for distances and background, takes these."""
    constant = not (t.requires_grad or background.requires_grad)
    return constant and is_cpu_float32(weights, colours, t, background, offsets)


def _check_terminate(optical_depth: Tensor, offsets: Tensor, bound: float) -> None:
    check_packed(optical_depth, offsets)


@operation(check=_check_terminate)
@torch.no_grad()
def terminate(optical_depth: Tensor, offsets: Tensor, bound: float) -> Tensor:
    """Early ray termination: mask of the samples that are still seen (nerfacc's ``early_stop_eps``).

    Args:
        optical_depth: ``(N,)``, as for `composite_weights`.
        offsets: ``(R + 1,)`` int64.
        bound: in [0, 1], on the transmittance before a sample; dropping the rest changes a colour in [0, 1] by
            less than this.

    Returns:
        ``(N,)`` bool; along a ray it never turns from False to True.

    Raises:
        InputError: if ``offsets`` does not end at N.

    Example:
        >>> terminate(torch.tensor([1.0, 9.0, 1.0]), torch.tensor([0, 3]), 1e-3).tolist()
        [True, True, False]
    """
    return torch.exp(-_depth_before(optical_depth, offsets)) >= bound
