"""Chooses the compiled or the plain version of a lookup, after checking its arguments."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from backbones.kernels import autograd, reference
from gridreg.errors import InputError
from gridreg.rendering.backends import chosen_backend

__all__ = ["cp_density", "cp_features", "vm_density", "vm_features"]


def _check(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None) -> None:
    if u.dim() != 2 or u.shape[1] != 3:
        raise InputError(f"u: found shape {tuple(u.shape)}, expected (N, 3)")
    for name, grids, axes in (("planes", planes, 3), ("lines", lines, 2)):
        if len(grids) != 3 and (name == "lines" or grids):
            raise InputError(f"{name}: found {len(grids)} of them, expected 3")
        for k, grid in enumerate(grids):
            shape = tuple(grid.shape)
            if len(shape) != axes or min(shape[:-1]) < 2 or shape[-1] != lines[0].shape[-1]:
                raise InputError(
                    f"{name}[{k}]: found shape {shape}, expected {axes - 1} edges of at least 2 nodes and "
                    f"{lines[0].shape[-1]} channels"
                )
    if open_channels is not None and open_channels < 0:
        raise InputError(f"open_channels: found {open_channels}, expected None or a number from 0 on")


def _takes_compiled(*tensors: Tensor) -> bool:
    if chosen_backend() == "torch" or tensors[0].requires_grad:
        return False
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


def _count(lines: Sequence[Tensor], open_channels: int | None) -> int:
    channels = lines[0].shape[-1]
    return channels if open_channels is None else min(channels, open_channels)


def vm_density(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """Sum over planes and channels of plane times line (TensoRF, Chen et al. 2022, equation 10).

    Args:
        u: ``(N, 3)`` in [0, 1]^3, clamped to it. If it requires a gradient, the plain path is taken.
        planes: three, ``(A, B, C)``, along axes (0, 1), (0, 2), (1, 2); ``C`` the same for all.
        lines: three, ``(M, C)``, along axes 2, 1, 0. Nodes of an edge of n lie at ``i / (n - 1)``.
        open_channels: channels at and beyond this index count as 0, are not read and get no gradient.

    Returns:
        ``(N,)``, differentiable in planes and lines.

    Raises:
        InputError: if shapes do not fit.

    Example:
        >>> grids = [torch.ones(2, 2, 4)] * 3, [torch.full((2, 4), 0.5)] * 3
        >>> vm_density(torch.rand(2, 3), *grids).tolist(), vm_density(torch.rand(1, 3), *grids, 1).tolist()
        ([6.0, 6.0], [1.5])
    """
    _check(u, planes, lines, open_channels)
    if _takes_compiled(u, *planes, *lines):
        return autograd.vm_density(u, planes, lines, _count(lines, open_channels))
    return reference.vm_density(u, planes, lines, open_channels)


def vm_features(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """Products of planes and lines, concatenated: ``(N, 3 C)``. Arguments as for `vm_density`."""
    _check(u, planes, lines, open_channels)
    if _takes_compiled(u, *planes, *lines):
        return autograd.vm_features(u, planes, lines, _count(lines, open_channels))
    return reference.vm_features(u, planes, lines, open_channels)


def cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Sum over channels of the product of three lines, ``(N,)``. Arguments as for `vm_density`."""
    _check(u, (), lines, open_channels)
    return reference.cp_density(u, lines, open_channels)


def cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Products of three lines, ``(N, C)``. Arguments as for `vm_density`."""
    _check(u, (), lines, open_channels)
    return reference.cp_features(u, lines, open_channels)
