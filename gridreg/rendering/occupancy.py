"""Occupancy of the cells of a box: the march skips those that hold nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Density = Callable[[Tensor], Tensor]


@dataclass
class OccupancyGrid:
    """A box cut into cells, each occupied (1) or empty (0).

    Args:
        bounds: ``(2, 3)`` lower and upper corner of the box, world units.
        cells: ``(X, Y, Z)`` uint8. Cell ``(i, j, k)`` covers ``[i, i + 1) / X`` of the box along x, and so on.
        hull: cells that may ever be occupied, ``(X, Y, Z)`` uint8 or None; see `gridreg.rendering.hull.visual_hull`.
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
