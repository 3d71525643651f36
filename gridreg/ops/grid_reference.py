"""Lookups in factored grids, in plain PyTorch: any device, any float dtype, differentiable in every tensor.

The compiled kernels are tested against these functions; `gridreg.ops` documents the arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops import ray_reference as plain
from gridreg.ops.arguments import Activation, MarchArguments

__all__ = [
    "LINE_AXES",
    "PLANE_AXES",
    "cp_density",
    "cp_features",
    "march_density",
    "vm_density",
    "vm_features",
]

PLANE_AXES = ((0, 1), (0, 2), (1, 2))
LINE_AXES = (2, 1, 0)


def _nodes(u: Tensor, edge: int) -> tuple[Tensor, Tensor]:
    """The node below each coordinate ``(N,)`` of [0, 1] on ``edge`` nodes, and the share of the node above it."""
    scaled = u.clamp(0, 1) * (edge - 1)
    lower = scaled.detach().nan_to_num(nan=0.0).floor().long().clamp(0, edge - 2)
    return lower, scaled - lower


def _interpolated_line(line: Tensor, u: Tensor) -> Tensor:
    """Line ``(M, C)`` at coordinates ``(N,)``: ``(N, C)``."""
    lower, share = _nodes(u, line.shape[0])
    share = share[:, None]
    return F.embedding(lower, line) * (1 - share) + F.embedding(lower + 1, line) * share


def _interpolated_plane(plane: Tensor, ua: Tensor, ub: Tensor) -> Tensor:
    """Plane ``(A, B, C)`` at coordinates ``(N,)`` along its first and second axis: ``(N, C)``."""
    edge = plane.shape[1]
    (a, share_a), (b, share_b) = _nodes(ua, plane.shape[0]), _nodes(ub, edge)
    share_a, share_b = share_a[:, None], share_b[:, None]
    rows = plane.reshape(-1, plane.shape[2])
    corner = a * edge + b
    below = F.embedding(corner, rows) * (1 - share_b) + F.embedding(corner + 1, rows) * share_b
    corner = corner + edge
    above = F.embedding(corner, rows) * (1 - share_b) + F.embedding(corner + 1, rows) * share_b
    return below * (1 - share_a) + above * share_a


def _opened(features: Tensor, open_channels: int | None) -> Tensor:
    """Features ``(N, C)`` with the channels at and beyond ``open_channels`` set to 0."""
    if open_channels is None or open_channels >= features.shape[1]:
        return features
    return torch.cat([features[:, :open_channels], torch.zeros_like(features[:, open_channels:])], dim=1)


def _vm_products(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None
) -> list[Tensor]:
    return [
        _opened(
            _interpolated_plane(plane, u[:, a], u[:, b]) * _interpolated_line(line, u[:, v]), open_channels
        )
        for plane, line, (a, b), v in zip(planes, lines, PLANE_AXES, LINE_AXES, strict=True)
    ]


def vm_density(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """See `gridreg.ops.vm_density`."""
    return torch.stack([p.sum(1) for p in _vm_products(u, planes, lines, open_channels)]).sum(0)


def vm_features(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """See `gridreg.ops.vm_features`."""
    return torch.cat(_vm_products(u, planes, lines, open_channels), dim=1)


def cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """See `gridreg.ops.cp_features`."""
    first, second, third = (
        _interpolated_line(line, u[:, axis]) for line, axis in zip(lines, LINE_AXES, strict=True)
    )
    return _opened(first * second * third, open_channels)


def cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """See `gridreg.ops.cp_density`."""
    return cp_features(u, lines, open_channels).sum(1)


def march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    features: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """See `gridreg.ops.vm_march_density`; ``features`` maps normalised positions to density features."""
    offsets, index, t, positions = plain.march(*march)
    lower, upper = activation.bounds
    u = (positions - lower) / (upper - lower)
    inside = ((u >= 0) & (u <= 1)).all(dim=1)
    density = activation.scale * F.softplus(features(u) + activation.shift)
    density = torch.where(inside, density, torch.zeros_like(density))
    if transmittance_bound > 0:
        seen = plain.terminate(density.detach() * march.step, offsets, transmittance_bound)
        offsets = F.pad(seen.cumsum(0), (1, 0))[offsets]
        index, t, positions, density = index[seen], t[seen], positions[seen], density[seen]
    return offsets, index, t, positions, density
