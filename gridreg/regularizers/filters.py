"""Linear filters along the spatial axes of a grid, given by what they do to each frequency."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import lru_cache
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from gridreg.errors import InputError

Boundary: TypeAlias = Literal["periodic", "mirror"]

_CHANNELS_LAST = ((4, torch.channels_last), (5, torch.channels_last_3d))

# A response below this fraction leaves nothing that float32 could see next to the rest of the spectrum.
_NOTHING = 1e-8


def low_pass_response(frequencies: Tensor, highest: int, keep: float | Tensor) -> Tensor:
    """Factor of each frequency: 1 up to ``keep * highest``, fading to 0 within the next one.

    Args:
        frequencies: numbers of the frequencies, from 0, any shape.
        highest: number of the highest frequency.
        keep: fraction of the spectrum in [0, 1]; frequency 0, the mean, has factor 1 at any fraction.

    Returns:
        In [0, 1], shape of `frequencies`; all ones at ``keep=1``, and nowhere lower for a larger fraction.

    Example:
        >>> low_pass_response(torch.arange(5), 4, 0.375)
        tensor([1.0000, 1.0000, 0.5000, 0.0000, 0.0000])
    """
    return (keep * highest - frequencies + 1).clamp(0, 1)


def fourier_low_pass(
    values: Tensor, axes: Sequence[int], keep: float | Tensor, boundary: Boundary = "periodic"
) -> Tensor:
    """Keep the lowest fraction of the frequencies along each axis.

    Args:
        values: a grid, any shape.
        axes: its spatial axes.
        keep: fraction of the spectrum that stays, in [0, 1]: at 0 only the mean, at 1 the values themselves. A
            scalar tensor is not checked, and costs more; compiled code need not be compiled anew for it.
        boundary: "periodic" is the discrete Fourier transform, where opposite borders are neighbours;
            "mirror" the cosine transform, where the grid is continued by its mirror image.

    Returns:
        Same shape and dtype, same mean along each axis; `values` itself at ``keep=1``. Source: FourieRF
        (Gomez et al. 2025), with a fading edge in place of its sharp one.

    Raises:
        InputError: keep lies outside [0, 1], or the boundary is unknown.

    Example:
        >>> fourier_low_pass(torch.tensor([1.0, 0.0, 1.0, 2.0]), (0,), keep=0.0)
        tensor([1., 1., 1., 1.])
    """
    if boundary not in ("periodic", "mirror"):
        raise InputError(f"boundary={boundary!r}: expected 'periodic' or 'mirror'")
    if isinstance(keep, Tensor):
        return _filter(values, axes, lambda size: _whole(*_low_pass(size, keep, boundary)))
    if not 0 <= keep <= 1:
        raise InputError(f"keep={keep}: expected a share of the spectrum in [0, 1]")
    if keep == 1:
        return values
    return _filter(values, axes, lambda size: _low_pass_factors(size, keep, boundary))


def gaussian_blur(values: Tensor, axes: Sequence[int], radius: float | Tensor) -> Tensor:
    """Gaussian blur along each axis, the grid continued by its mirror image.

    Args:
        values: a grid, any shape.
        axes: its spatial axes.
        radius: standard deviation as a fraction of the grid's edge: ``n - 1`` voxels times it on an axis of `n`
            nodes, so that it means the same length after the grid has grown. A scalar tensor is not checked.

    Returns:
        Same shape and dtype, same mean along each axis; `values` itself at radius 0.

    Raises:
        InputError: the radius is negative or not a number.

    Example:
        >>> gaussian_blur(torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0]), (0,), radius=10.0)
        tensor([0.2000, 0.2000, 0.2000, 0.2000, 0.2000])
    """
    if isinstance(radius, Tensor):
        return _filter(values, axes, lambda size: _whole(*_gaussian(size, radius)))
    if not radius >= 0:
        raise InputError(f"radius={radius}: expected a share of the grid's edge, at least 0")
    if radius == 0:
        return values
    return _filter(values, axes, lambda size: _gaussian_factors(size, radius))


def _basis(size: int, boundary: Boundary) -> tuple[Tensor, Tensor, int]:
    """Orthonormal rows ``(size, size)``, the number of the frequency of each, and the highest number."""
    nodes = rows = torch.arange(size, dtype=torch.float64, device="cpu")
    if boundary == "mirror":
        basis = torch.cos(math.pi * rows[:, None] * (nodes + 0.5) / size)
        return basis / basis.norm(dim=1, keepdim=True), rows, size - 1
    # Row 0 is constant; then a cosine and a sine of each frequency; an even size ends with a cosine.
    frequencies = torch.div(rows + 1, 2, rounding_mode="floor")
    angle = 2 * math.pi * frequencies[:, None] * nodes / size
    basis = torch.where(
        rows[:, None] % 2 == 1, angle.cos(), torch.where(rows[:, None] == 0, 1.0, angle.sin())
    )
    return basis / basis.norm(dim=1, keepdim=True), frequencies, size // 2


def _low_pass(size: int, keep: float | Tensor, boundary: Boundary) -> tuple[Tensor, Tensor]:
    """Basis and the factor of each of its rows."""
    basis, frequencies, highest = _basis(size, boundary)
    return basis, low_pass_response(frequencies, highest, keep)


def _gaussian(size: int, radius: float | Tensor) -> tuple[Tensor, Tensor]:
    """Basis and the factor of each of its rows."""
    basis, frequencies, _ = _basis(size, "mirror")
    angles = frequencies * (math.pi / size) * (radius * (size - 1))
    return basis, torch.exp(-(angles**2) / 2)


@lru_cache(maxsize=16)
def _low_pass_factors(size: int, keep: float, boundary: Boundary) -> tuple[Tensor, ...]:
    # A preview may ask first, in inference mode, for what training has to differentiate through.
    with torch.inference_mode(False):
        return _factors(*_low_pass(size, keep, boundary))


@lru_cache(maxsize=16)
def _gaussian_factors(size: int, radius: float) -> tuple[Tensor, ...]:
    with torch.inference_mode(False):
        return _factors(*_gaussian(size, radius))


def _factors(basis: Tensor, response: Tensor) -> tuple[Tensor, ...]:
    """The filter as one matrix, or, if few frequencies pass, as two narrow ones: analysis and synthesis."""
    passing = response > _NOTHING
    analysis = basis[passing] * response[passing].sqrt()[:, None]
    return (analysis.T @ analysis,) if 2 * len(analysis) > analysis.shape[1] else (analysis, analysis.T)


def _whole(basis: Tensor, response: Tensor) -> tuple[Tensor, ...]:
    """The filter as one matrix, whatever the response."""
    return ((basis.T * response) @ basis,)


def _filter(values: Tensor, axes: Sequence[int], factors_of: Callable[[int], tuple[Tensor, ...]]) -> Tensor:
    """`values` multiplied along each axis by factors; in the dtype and the memory format that they have."""
    syntheses: list[tuple[Tensor, int]] = []
    form = next(
        (f for n, f in _CHANNELS_LAST if values.ndim == n and values.is_contiguous(memory_format=f)), None
    )
    contiguous = values.is_contiguous()
    device = values.device.type
    with torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext():
        for axis in axes:
            first, *second = factors_of(values.shape[axis])
            # Narrow factors first on all axes: each makes the grid smaller for the next.
            syntheses += [(matrix, axis) for matrix in second]
            values = _along(first, values, axis)
        for matrix, axis in reversed(syntheses):
            values = _along(matrix, values, axis)
    return values if form is None or contiguous else values.contiguous(memory_format=form)


def _along(matrix: Tensor, values: Tensor, axis: int) -> Tensor:
    """Multiply ``(m, n)`` into axis `axis` of length `n`, which becomes `m`."""
    matrix = matrix.to(values)
    shape = list(values.shape)
    before, after = math.prod(shape[:axis]), math.prod(shape[axis + 1 :])
    flat = values.reshape(before, shape[axis], after)
    # Without a trailing axis there would be `before` tiny products instead of one large one.
    product = (flat[..., 0] @ matrix.T) if after == 1 else torch.matmul(matrix, flat)
    shape[axis] = matrix.shape[0]
    return product.reshape(shape)
