"""Linear interpolation in the planes and lines of factored grids, in plain PyTorch, and the checks of their shapes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.errors import InputError
from gridreg.ops.dispatch import is_cpu_float32

PLANE_AXES = ((0, 1), (0, 2), (1, 2))
LINE_AXES = (2, 1, 0)


def check_grids(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None
) -> None:
    """Raise `InputError` unless positions, planes (none for a CP grid) and lines fit each other."""
    if u.dim() != 2 or u.shape[1] != 3:
        raise InputError(f"u: found shape {tuple(u.shape)}, expected (N, 3)")
    if len(lines) != 3 or lines[0].dim() != 2:
        raise InputError(f"lines: found shapes {[tuple(x.shape) for x in lines]}, expected three (M, C)")
    edges, channels = [lines[2 - axis].shape[0] for axis in range(3)], lines[0].shape[1]
    if min(edges) < 2:
        raise InputError(f"lines: found {edges} nodes along x, y, z, expected at least 2")
    expected: dict[str, list[tuple[int, ...]]] = {
        "lines": [(edges[axis], channels) for axis in LINE_AXES],
        "planes": [(edges[a], edges[b], channels) for a, b in PLANE_AXES] if planes else [],
    }
    for name, grids in (("lines", lines), ("planes", planes)):
        shapes = [tuple(x.shape) for x in grids]
        if shapes != expected[name]:
            raise InputError(f"{name}: found shapes {shapes}, expected {expected[name]}")
    if open_channels is not None and open_channels < 0:
        raise InputError(f"open_channels: found {open_channels}, expected None or a number from 0 on")


def suits_cpu(u: Tensor, *arguments: object, **named: object) -> bool:
    """Whether compiled code takes these; it has no gradient for positions."""
    return not u.requires_grad and is_cpu_float32(u, *arguments, **named)


def close_channels(features: Tensor, open_channels: int | None) -> Tensor:
    """Features ``(N, C)`` with the channels at and beyond ``open_channels`` set to 0."""
    if open_channels is None or open_channels >= features.shape[1]:
        return features
    return torch.cat([features[:, :open_channels], torch.zeros_like(features[:, open_channels:])], dim=1)


def _nodes(u: Tensor, edge: int) -> tuple[Tensor, Tensor]:
    """The node below each coordinate ``(N,)`` of [0, 1] on ``edge`` nodes, and the weight of the node above it."""
    scaled = u.clamp(0, 1) * (edge - 1)
    lower = scaled.detach().nan_to_num(nan=0.0).floor().long().clamp(0, edge - 2)
    return lower, scaled - lower


def interpolate_line(line: Tensor, u: Tensor) -> Tensor:
    """Line ``(M, C)`` at coordinates ``(N,)``: ``(N, C)``."""
    lower, weight = _nodes(u, line.shape[0])
    weight = weight[:, None]
    return F.embedding(lower, line) * (1 - weight) + F.embedding(lower + 1, line) * weight


def interpolate_plane(plane: Tensor, ua: Tensor, ub: Tensor) -> Tensor:
    """Plane ``(A, B, C)`` at coordinates ``(N,)`` along its first and second axis: ``(N, C)``."""
    edge = plane.shape[1]
    (a, weight_a), (b, weight_b) = _nodes(ua, plane.shape[0]), _nodes(ub, edge)
    weight_a, weight_b = weight_a[:, None], weight_b[:, None]
    rows = plane.reshape(-1, plane.shape[2])
    corner = a * edge + b
    below = F.embedding(corner, rows) * (1 - weight_b) + F.embedding(corner + 1, rows) * weight_b
    corner = corner + edge
    above = F.embedding(corner, rows) * (1 - weight_b) + F.embedding(corner + 1, rows) * weight_b
    return below * (1 - weight_a) + above * weight_a
