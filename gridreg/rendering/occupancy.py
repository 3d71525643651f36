"""Occupancy of the cells of a box: the march skips those that hold nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

Density = Callable[[Tensor], Tensor]


@dataclass
class OccupancyGrid:
    """A box cut into cells, each occupied (1) or empty (0).

    Args:
        bounds: ``(2, 3)`` lower and upper corner of the box, world units.
        cells: ``(X, Y, Z)`` uint8. Cell ``(i, j, k)`` covers ``[i, i + 1) / X`` of the box along x, and so on.
        hull: cells that may ever be occupied, ``(X, Y, Z)`` uint8 or None; see `visual_hull`.
    """

    bounds: Tensor
    cells: Tensor
    hull: Tensor | None = None

    @classmethod
    def full(cls, bounds: Tensor, resolution: tuple[int, int, int]) -> OccupancyGrid:
        """A grid with every cell occupied."""
        return cls(bounds.clone(), torch.ones(resolution, dtype=torch.uint8, device=bounds.device))

    @classmethod
    def restored(cls, saved: dict[str, Tensor]) -> OccupancyGrid:
        """A grid of its attributes, as a checkpoint of anybody's holds them.

        Raises:
            ValueError: if they are no cells in a box.
        """
        grid = cls(**saved)
        box, hull = grid.bounds, grid.cells if grid.hull is None else grid.hull
        if not (
            all(each.ndim == 3 and each.dtype == torch.uint8 and each.numel() for each in (grid.cells, hull))
            and grid.cells.shape == hull.shape
            and tuple(box.shape) == (2, 3)
            and bool(torch.isfinite(box).all() and (box[0] < box[1]).all())
        ):
            raise ValueError("occupancy is no grid of cells in a box")
        return grid

    def to(self, device: torch.device | str) -> OccupancyGrid:
        """The same grid on a device."""
        hull = None if self.hull is None else self.hull.to(device)
        return OccupancyGrid(self.bounds.to(device), self.cells.to(device), hull)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        x, y, z = self.cells.shape
        return x, y, z

    @property
    def fraction(self) -> float:
        """Occupied fraction of the cells, in [0, 1]."""
        return float(self.cells.float().mean())

    def centres(self, index: Tensor) -> Tensor:
        """World positions ``(M, 3)`` of the centres of cells given by flat index ``(M,)``."""
        x, y, z = self.resolution
        ijk = torch.stack([index // (y * z), index // z % y, index % z], dim=-1)
        size = torch.tensor([x, y, z], device=index.device)
        unit = (ijk.to(self.bounds.dtype) + 0.5) / size
        return self.bounds[0] + unit * (self.bounds[1] - self.bounds[0])

    @torch.no_grad()
    def update(
        self, density: Density, step: float, *, threshold: float = 1e-4, dilate: int = 1, chunk: int = 1 << 18
    ) -> None:
        """Keep the cells whose opacity over one ray step exceeds a bound, and their neighbours.

        Only cells that are occupied now are evaluated, at their centres (TensoRF section 4, "alpha mask": occupied
        where ``1 - exp(-density * step) > 1e-4``, dilated by a 3^3 maximum).

        Args:
            density: positions ``(N, 3)`` to densities ``(N,)`` per world unit.
            step: length of a ray step, world units.
            threshold: bound on the opacity, in [0, 1].
            dilate: cells by which the result grows in every direction.
            chunk: positions evaluated at once.
        """
        occupied = self.cells.reshape(-1).nonzero().squeeze(-1)
        bound = -math.log1p(-threshold) / step
        kept = torch.zeros(self.cells.numel(), dtype=torch.uint8, device=self.cells.device)
        for part in torch.split(occupied, chunk):
            kept[part] = (density(self.centres(part)) > bound).to(torch.uint8)
        grown = _dilate(kept.reshape(self.cells.shape), dilate)
        self.cells = grown if self.hull is None else grown * self.hull

    def at(self, bounds: Tensor, resolution: tuple[int, int, int]) -> OccupancyGrid:
        """The same occupancy on another box and resolution: a cell is occupied if any cell it overlaps was."""
        cells = _resized(self.cells, self.bounds, bounds, resolution)
        hull = None if self.hull is None else _resized(self.hull, self.bounds, bounds, resolution)
        return OccupancyGrid(bounds.clone(), cells, hull)

    def tight_bounds(self) -> Tensor:
        """The smallest box ``(2, 3)`` that holds every occupied cell.

        Raises:
            RuntimeError: if no cell is occupied.
        """
        if not bool(self.cells.any()):
            raise RuntimeError("occupancy: no cell is occupied, so there is no box around them")
        size = (self.bounds[1] - self.bounds[0]) / torch.tensor(self.resolution, device=self.bounds.device)
        ranges = [self.cells.amax(dim=tuple(b for b in range(3) if b != a)).nonzero() for a in range(3)]
        lower = torch.stack([r.min() for r in ranges])
        upper = torch.stack([r.max() + 1 for r in ranges])
        return torch.stack([self.bounds[0] + lower * size, self.bounds[0] + upper * size])

    def contains(self, positions: Tensor) -> Tensor:
        """Whether each position ``(N, 3)`` lies in an occupied cell: ``(N,)`` bool."""
        size = torch.tensor(self.resolution, device=positions.device)
        unit = (positions - self.bounds[0]) / (self.bounds[1] - self.bounds[0])
        inside = ((unit >= 0) & (unit <= 1)).all(dim=-1)
        ijk = torch.minimum((unit.clamp(0, 1) * size).long(), size - 1)
        return inside & self.cells[ijk[:, 0], ijk[:, 1], ijk[:, 2]].bool()


def _dilate(cells: Tensor, radius: int) -> Tensor:
    """Maximum over the cube around each cell, one axis after another."""
    for axis in range(3):
        grown, size = cells.clone(), cells.shape[axis]
        for shift in range(1, min(radius, size - 1) + 1):
            for there, here in ((shift, 0), (0, shift)):
                target = grown.narrow(axis, there, size - shift)
                torch.maximum(target, cells.narrow(axis, here, size - shift), out=target)
        cells = grown
    return cells


def _resized(cells: Tensor, old: Tensor, new: Tensor, resolution: tuple[int, int, int]) -> Tensor:
    """Per axis, the range of old cells under each new cell, reduced by maximum."""
    out = cells
    for axis in range(3):
        count, target = cells.shape[axis], resolution[axis]
        edges = torch.linspace(0, 1, target + 1, dtype=torch.float64, device=cells.device)
        world = new[0, axis].double() + edges * (new[1, axis] - new[0, axis]).double()
        scaled = (world - old[0, axis].double()) / (old[1, axis] - old[0, axis]).double() * count
        first = (scaled[:-1] + 1e-6).floor().long().clamp(0, count - 1)
        last = ((scaled[1:] - 1e-6).ceil().long() - 1).clamp(0, count - 1)
        outside = (scaled[1:] <= 1e-6) | (scaled[:-1] >= count - 1e-6)
        # A running count along the axis answers "any occupied between first and last" in two look-ups.
        counted = out.long().cumsum(dim=axis)
        total = torch.cat([torch.zeros_like(counted.narrow(axis, 0, 1)), counted], dim=axis)
        any_inside = total.index_select(axis, last + 1) - total.index_select(axis, first) > 0
        shape = [1, 1, 1]
        shape[axis] = target
        out = (any_inside & ~outside.view(shape)).to(torch.uint8)
    return out


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
