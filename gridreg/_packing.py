"""Checks of packed samples, and rectangles of samples on their way to be packed."""

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
