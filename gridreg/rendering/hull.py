"""The visual hull: cells that no silhouette proves empty."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.rendering.occupancy import OccupancyGrid


def _footprint(total: Tensor, row: Tensor, column: Tensor, radius: Tensor) -> Tensor:
    """Number of pixels that are set within a square around each pixel, from a summed-area table ``(H + 1, W + 1)``."""
    height, width = total.shape[0] - 1, total.shape[1] - 1
    top = (row - radius).floor().long().clamp(0, height)
    bottom = ((row + radius).floor().long() + 1).clamp(0, height)
    left = (column - radius).floor().long().clamp(0, width)
    right = ((column + radius).floor().long() + 1).clamp(0, width)
    return total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]


def _alpha_views(
    alpha: Tensor, poses: Tensor, intrinsics: Tensor
) -> Iterator[tuple[Tensor, bool, Tensor, Tensor]]:
    """For each view: summed-area table of its silhouette, whether that is whole, world-to-camera, intrinsics."""
    for mask, pose, camera in zip(alpha > 0, poses, intrinsics, strict=True):
        total = F.pad(mask.long().cumsum(0).cumsum(1), (1, 0, 1, 0))
        cut = mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any()
        yield total, not bool(cut), torch.linalg.inv(pose.double()), camera.double()


@torch.no_grad()
def visual_hull(
    grid: OccupancyGrid,
    alpha: Tensor,
    poses: Tensor,
    intrinsics: Tensor,
    *,
    margin: float = 1.0,
    chunk: int = 1 << 18,
) -> Tensor:
    """Cells that no view proves empty: space carving from silhouettes (Laurentini 1994).

    A cell is carved when its whole projection, plus a margin, falls on pixels with alpha 0 in some view. A silhouette
    that does not touch the edge of its image is taken for the whole object, so that what lies beyond the edge is
    empty, too; if it does touch the edge, the view carves only what it sees. What is behind a camera it never carves.

    Args:
        grid: box and resolution.
        alpha: ``(V, H, W)`` in [0, 1].
        poses: ``(V, 4, 4)`` camera-to-world.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels.
        margin: pixels added around each projection.

    Returns:
        ``(X, Y, Z)`` uint8, 1 where something may be.
    """
    height, width = alpha.shape[1:]
    resolution = torch.tensor(grid.resolution, device=grid.bounds.device)
    radius = float(((grid.bounds[1] - grid.bounds[0]) / resolution).norm()) / 2
    kept = torch.arange(grid.cells.numel(), device=alpha.device)
    for total, whole, world_to_camera, (fx, fy, cx, cy) in _alpha_views(alpha, poses, intrinsics):
        survivors = []
        for part in torch.split(kept, chunk):
            local = grid.centres(part).double() @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
            depth = -local[:, 2]
            safe = (depth - radius).clamp(min=1e-6)
            column, row = cx + fx * local[:, 0] / depth, cy - fy * local[:, 1] / depth
            pixels = (
                radius * torch.maximum(fx, fy) * (1 + (local[:, :2] / safe[:, None]).norm(dim=-1)) / safe
                + margin
            )
            inside = (column - pixels >= 0) & (column + pixels <= width)
            inside &= (row - pixels >= 0) & (row + pixels <= height)
            judged = (depth > radius) & (inside | whole)
            pixels = pixels.clamp(max=float(max(height, width)))
            empty = judged & (_footprint(total, row.nan_to_num(0), column.nan_to_num(0), pixels) == 0)
            survivors.append(part[~empty])
        kept = torch.cat(survivors)
    hull = torch.zeros(grid.cells.numel(), dtype=torch.uint8, device=alpha.device)
    hull[kept] = 1
    return hull.reshape(grid.cells.shape)
