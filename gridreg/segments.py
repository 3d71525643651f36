"""Packed samples: sums along their rays, which do not depend on the timing of threads, and checks of their shapes."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from gridreg.errors import InputError

_PER_SAMPLE = ("t", "delta", "index", "density", "weights")
_PER_SAMPLE_3 = ("positions", "colours", "gradients")
_PER_RAY_3 = ("directions", "background")
_PER_RAY = ("ray_start", "ray_steps", "target_opacity", "target_depth", "images")
_INTEGERS = ("offsets", "index", "ray_steps", "images")


def _running(values: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """The sum over all rays before each sample, and after the last, ``(N + 1,)``; the same where rays begin and end.

    In float32 the differences between these would lose the digits that the earlier rays have used up; float64 keeps
    them.
    """
    running = values.new_zeros(values.shape[0] + 1, dtype=torch.float64)
    torch.cumsum(values, 0, dtype=torch.float64, out=running[1:])
    return running, running.index_select(0, offsets)


class _SumPerRay(torch.autograd.Function):
    """Sums of consecutive segments; its transpose is `_Spread`, so neither needs atomic additions."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
        """``(N, ...)`` to ``(R, ...)``."""
        ctx.save_for_backward(offsets, ray_indices)
        if values.shape[0] == 0:
            return values.new_zeros((offsets.shape[0] - 1, *values.shape[1:]))
        return torch.segment_reduce(values.contiguous(), "sum", offsets=offsets, axis=0, unsafe=True)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """``(R, ...)`` to ``(N, ...)``."""
        return spread(gradients[0], *ctx.saved_tensors), None, None


class _Spread(torch.autograd.Function):
    """The value of each ray, repeated for each of its samples."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
        """``(R, ...)`` to ``(N, ...)``."""
        ctx.save_for_backward(offsets, ray_indices)
        return values.index_select(0, ray_indices)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """``(N, ...)`` to ``(R, ...)``."""
        return sum_per_ray(gradients[0], *ctx.saved_tensors), None, None


class _SumBefore(torch.autograd.Function):
    """Sum over the earlier samples of the same ray (exclusive prefix sum)."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
        """``(N,)`` to ``(N,)``."""
        ctx.save_for_backward(offsets, ray_indices)
        running, ends = _running(values, offsets)
        return (running[:-1] - ends[:-1].index_select(0, ray_indices)).to(values.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """The sum over the later samples of the same ray."""
        gradient = gradients[0]
        total = spread(sum_per_ray(gradient, *ctx.saved_tensors), *ctx.saved_tensors)
        return total - gradient - sum_before(gradient, *ctx.saved_tensors), None, None


def sum_per_ray(values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
    """Add ``(N, ...)`` along each ray.

    Args:
        values: ``(N, ...)``, packed.
        offsets: ``(R + 1,)`` int64, where the samples of each ray begin.
        ray_indices: ``(N,)`` int64, ray of each sample.

    Returns:
        ``(R, ...)``; 0 for a ray without samples.
    """
    result: Tensor = _SumPerRay.apply(values, offsets, ray_indices)  # type: ignore[no-untyped-call]
    return result


def spread(values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
    """Give each sample the value of its ray, the transpose of `sum_per_ray`: ``(R, ...)`` to ``(N, ...)``."""
    result: Tensor = _Spread.apply(values, offsets, ray_indices)  # type: ignore[no-untyped-call]
    return result


def sum_before(values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
    """Add over the earlier samples of the same ray (exclusive prefix sum): ``(N,)`` to ``(N,)``."""
    result: Tensor = _SumBefore.apply(values, offsets, ray_indices)  # type: ignore[no-untyped-call]
    return result


def before_less_behind(values: Tensor, offsets: Tensor, ray_indices: Tensor) -> Tensor:
    """Add over the earlier samples of the same ray and subtract the later ones: ``(N,)`` in float64; no gradient."""
    running, ends = _running(values, offsets)
    # Twice the sum up to here, itself included, less itself, less what was before the ray and after it.
    return (running[1:] + running[:-1]).sub_((ends[:-1] + ends[1:]).index_select(0, ray_indices))


def optical_depth_to_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Weights ``w_i = T_i (1 - exp(-tau_i))`` with the transmittance ``T_i = exp(-sum_{j<i} tau_j)``.

    Args:
        optical_depth: ``(N,)`` density times interval length, packed; no unit.
        offsets: ``(R + 1,)`` int64, where the samples of each ray begin.

    Returns:
        ``(N,)`` weights in [0, 1]; along a ray they add to its opacity. Source: NeRF (Mildenhall et al.
        2020), equation 3.

    Example:
        >>> import torch
        >>> optical_depth_to_weights(torch.tensor([0.0, 200.0, 1.0]), torch.tensor([0, 3]))
        tensor([0., 1., 0.])
    """
    rays = torch.arange(offsets.shape[0] - 1, device=offsets.device)
    ray_indices = torch.repeat_interleave(
        rays, offsets[1:] - offsets[:-1], output_size=optical_depth.shape[0]
    )
    # Behind a depth of 1e3 nothing is seen; the 1e10 that closes a ray would use up the digits of all later ones.
    transmittance = torch.exp(-sum_before(optical_depth.clamp(max=1e3), offsets, ray_indices))
    return transmittance * -torch.expm1(-optical_depth)


def check_samples(samples: Any) -> None:
    """Refuse `RaySamples` whose shapes, types or devices do not fit together.

    Raises:
        InputError: naming the field, what it is and what it must be.
    """
    offsets, t = samples.offsets, samples.t
    if offsets.ndim != 1 or offsets.shape[0] < 1:
        raise InputError(f"offsets must have shape (rays + 1,), found {tuple(offsets.shape)}")
    rays, count = offsets.shape[0] - 1, t.shape[0] if t.ndim else -1
    expected = {
        **dict.fromkeys(_PER_SAMPLE, (count,)),
        **dict.fromkeys(_PER_SAMPLE_3, (count, 3)),
        **dict.fromkeys(_PER_RAY_3, (rays, 3)),
        **dict.fromkeys(_PER_RAY, (rays,)),
    }
    for name in (item.name for item in fields(samples)):
        value = getattr(samples, name)
        if not isinstance(value, Tensor):
            continue
        if name in expected and tuple(value.shape) != expected[name]:
            raise InputError(
                f"{name} must have shape {expected[name]} for {count} samples on {rays} rays, "
                f"found {tuple(value.shape)}"
            )
        integer = name in _INTEGERS
        if not (value.dtype == torch.int64 if integer else value.is_floating_point()):
            wanted = "int64" if integer else "a floating-point type"
            raise InputError(f"{name} must be {wanted}, found {value.dtype}")
        if value.device != t.device:
            raise InputError(f"{name} is on {value.device}, but t is on {t.device}: one device for all")
    # Reading the values would stop a GPU's queue, so elsewhere only the shapes are checked.
    if offsets.device.type == "cpu":
        ends = int(offsets[0]), int(offsets[-1])
        if ends != (0, count) or bool((offsets[1:] < offsets[:-1]).any()):
            raise InputError(f"offsets must rise from 0 to the {count} samples, found {ends[0]} to {ends[1]}")
    patch = samples.patch
    if patch is not None and (min(patch) < 1 or patch[0] * patch[1] * patch[2] > rays):
        needed = patch[0] * patch[1] * patch[2]
        raise InputError(f"patch {patch} needs {needed} rays at the end of the {rays} given")
    if any(proposal.offsets.shape != offsets.shape for proposal in samples.proposals or ()):
        raise InputError(f"proposals must have samples on the same {rays} rays")


def rectangle(
    t: Tensor, delta: Tensor, density: Tensor, valid: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whole rectangles `t` and `delta` ``(R, S)``, offsets ``(R + 1,)``, and indices of the samples that are kept.

    Raises:
        InputError: a shape differs, or `valid` is not bool.
    """
    if density.ndim != 2:
        raise InputError(f"density must have shape (rays, samples), found {tuple(density.shape)}")
    shape = tuple(density.shape)
    if valid is None:
        valid = torch.ones(shape, dtype=torch.bool, device=density.device)
    if valid.dtype != torch.bool or valid.shape != density.shape:
        raise InputError(f"valid must be bool of shape {shape}, found {valid.dtype} {tuple(valid.shape)}")
    try:
        t, delta = t.expand(shape), delta.expand(shape)
    except RuntimeError as error:
        raise InputError(
            f"t and delta must have shape {shape} like density, "
            f"found {tuple(t.shape)} and {tuple(delta.shape)}"
        ) from error
    offsets = torch.cat([valid.new_zeros(1, dtype=torch.int64), valid.sum(1).cumsum(0)])
    return t, delta, offsets, valid.flatten().nonzero()[:, 0]
