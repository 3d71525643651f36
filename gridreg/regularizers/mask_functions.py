"""Channel masks as functions: vectors in [0, 1] that open during training, low channels first."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from gridreg.errors import InputError


def frequency_mask(channels: int, step: float, total_steps: float, *, block: int = 3) -> Tensor:
    """FreeNeRF's frequency mask in block form: channels open from the first, a block at a time.

    With L channels, block B, step t and end T: p = min(L/B * t/T + 1, L/B); the first B * floor(p) channels
    are 1, the next B are p - floor(p), the rest 0; from T on all are 1. It never closes a channel that it
    opened.

    Args:
        channels: number of channels, L.
        step: current step t, iterations from 0.
        total_steps: step T from which all channels are open, iterations.
        block: channels that open together, B.

    Returns:
        Mask of shape `(channels,)`, float32, with exact zeros and ones.

    Raises:
        InputError: channels, block or total_steps are not above 0, or the step is negative or not a number.

    Source: FreeNeRF (Yang et al., CVPR 2023), the released program; it clips to [1e-8, 1 - 1e-8], we do not,
    because a channel at exactly 0 need not be computed.

    >>> frequency_mask(9, 25, 100)
    tensor([1.0000, 1.0000, 1.0000, 0.7500, 0.7500, 0.7500, 0.0000, 0.0000, 0.0000])
    """
    return authors_frequency_mask(channels, step, total_steps, block=block, tail=block)


def authors_frequency_mask(
    channels: int, step: float, total_steps: float, *, block: int = 5, tail: int = 3
) -> Tensor:
    """The mask of the Few TensoRF program: as `frequency_mask`, but only `tail` channels of a block fade in.

    The other channels of the block jump from 0 to 1 when it is complete. Kept for comparison; the program
    uses block 5 and tail 3, later 4 and 4. Arguments, result and errors as in `frequency_mask`.

    >>> authors_frequency_mask(8, 25, 100, block=4, tail=2)
    tensor([1.0000, 1.0000, 1.0000, 1.0000, 0.5000, 0.5000, 0.0000, 0.0000])
    """
    _check(channels=channels, block=block, tail=tail)
    _check_step(step, total_steps)
    if step >= total_steps:
        return torch.ones(channels)
    # p = 1 + L t / (B T) up to L / B, by division with remainder: exact for whole numbers, so that an integer
    # p leaves no 1e-16 in the next block.
    whole, rest = divmod(channels * step, block * total_steps)
    whole, fraction = int(whole) + 1, rest / (block * total_steps)
    if whole + fraction > channels / block:
        whole, fraction = channels // block, channels % block / block
    mask = torch.zeros(channels)
    mask[: block * whole] = 1
    mask[block * whole : block * whole + tail] = fraction
    return mask


def printed_frequency_mask(channels: int, step: float, total_steps: float) -> Tensor:
    """The equation printed in FreeNeRF and Few TensoRF, which closes channels again; only for comparison.

    With a = t L / T and channels numbered i = 1, ..., L: 1 if i <= a + 3; a - floor(a) if i <= a + 6; else 0.
    When `a` passes an integer, channels drop from almost 1 to 0, so training with it takes detail away again
    and again. Arguments, result and errors as in `frequency_mask`.

    >>> printed_frequency_mask(10, 19, 100)[5:7], printed_frequency_mask(10, 20, 100)[5:7]
    (tensor([0.9000, 0.9000]), tensor([0., 0.]))
    """
    _check(channels=channels)
    _check_step(step, total_steps)
    if step >= total_steps:
        return torch.ones(channels)
    position = step * channels / total_steps
    number = torch.arange(1, channels + 1, dtype=torch.float64)
    mask = torch.where(number <= position + 6, position - math.floor(position), 0.0)
    return torch.where(number <= position + 3, 1.0, mask).float()


def fixed_mask(channels: int, visible_ratio: float) -> Tensor:
    """The first `int(channels * visible_ratio)` channels are 1, the rest 0, at all steps.

    Args:
        channels: number of channels.
        visible_ratio: fraction that stays open, in [0, 1]; the human-body runs of Few TensoRF use 0.8.

    Returns:
        Mask of shape `(channels,)`, float32.

    Raises:
        InputError: channels are not above 0, or the ratio is outside [0, 1].

    >>> fixed_mask(5, 0.8)
    tensor([1., 1., 1., 1., 0.])
    """
    _check(channels=channels)
    if not 0 <= visible_ratio <= 1:
        raise InputError(f"visible_ratio={visible_ratio}: expected a share of the channels in [0, 1]")
    return (torch.arange(channels) < int(channels * visible_ratio)).float()


def cosine_mask(octaves: int, step: float, total_steps: float) -> Tensor:
    """BARF's window: octave k opens along half a cosine while the window passes it.

    mask[k] = (1 - cos(pi clamp(L t / T - k, 0, 1))) / 2 for octave k of L. At step 0 all octaves are closed.

    Args:
        octaves: number of octaves, L.
        step: current step t, iterations from 0.
        total_steps: step T from which all octaves are open, iterations.

    Returns:
        Mask of shape `(octaves,)`, float32.

    Raises:
        InputError: octaves or total_steps are not above 0, or the step is negative or not a number.

    Source: BARF (Lin et al., ICCV 2021), equation 14; Nerfies (Park et al., ICCV 2021), equation 8.

    >>> cosine_mask(4, 3, 8)
    tensor([1.0000, 0.5000, 0.0000, 0.0000])
    """
    _check(octaves=octaves)
    _check_step(step, total_steps)
    if step >= total_steps:
        return torch.ones(octaves)
    position = octaves * step / total_steps
    window = (position - torch.arange(octaves, dtype=torch.float64)).clamp(0, 1)
    return ((1 - torch.cos(math.pi * window)) / 2).float()


def level_mask(levels: int, step: float, *, start: float = 4, begin: float = 0, every: float) -> Tensor:
    """Levels of a multi-resolution grid, coarse first: level l is open if l < start + floor((t - begin) /
    every).

    Args:
        levels: number of levels.
        step: current step t, iterations from 0.
        start: levels open up to `begin`.
        begin: step at which opening begins, iterations.
        every: iterations between two levels.

    Returns:
        Mask of shape `(levels,)`, float32.

    Raises:
        InputError: levels or every are not above 0, or the step is negative or not a number.

    Source: Neuralangelo (Li et al., CVPR 2023), section 3.2, and its program: 4 levels, one more every 5,000
    of 500,000.

    >>> level_mask(6, 10_000, every=5000, start=2)
    tensor([1., 1., 1., 1., 0., 0.])
    """
    _check(levels=levels)
    _check_step(step, every, "every")
    opened = start + max(0, math.floor((step - begin) / every))
    return (torch.arange(levels) < opened).float()


@lru_cache(maxsize=256)
def channel_ranks(octaves: tuple[int, ...]) -> tuple[int, ...]:
    """Rank of each channel among the octaves that occur: equal octaves open together, whatever their order.

    >>> channel_ranks((-1, 0, 2, 0, 2))
    (0, 1, 2, 1, 2)
    """
    order = {octave: rank for rank, octave in enumerate(sorted(set(octaves)))}
    return tuple(order[octave] for octave in octaves)


@lru_cache(maxsize=256)
def spherical_bands(channels: int, coefficients: int | None = None) -> tuple[int, ...]:
    """Band (degree) of each channel of spherical-harmonics coefficients: 0, 1, 1, 1, 2, 2, 2, 2, 2, ...

    Args:
        channels: number of channels.
        coefficients: coefficients per colour, if the channels are colour by colour; all by default.

    >>> spherical_bands(8, coefficients=4)
    (0, 1, 1, 1, 0, 1, 1, 1)
    """
    return tuple(math.isqrt(channel % (coefficients or channels)) for channel in range(channels))


def _check(**counts: int) -> None:
    """Counts are ints above 0."""
    for name, count in counts.items():
        if isinstance(count, bool) or not hasattr(count, "__index__") or count <= 0:
            raise InputError(f"{name}={count!r}: expected a number of {name}, an int above 0")


def _check_step(step: float, total_steps: float, name: str = "total_steps") -> None:
    """Step from 0, length above 0; NaN fails both comparisons."""
    if not total_steps > 0 or math.isinf(total_steps):
        raise InputError(f"{name}={total_steps}: expected a number of iterations above 0")
    if not step >= 0:
        raise InputError(f"step={step}: expected a number of iterations from 0")
