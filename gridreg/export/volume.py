"""The density of a field on a regular lattice, and the threshold at which its surface is seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Field, OccupancyGrid

Array = NDArray[np.float32]


class SeenDensity:
    """The density as the renderer sees it: that of the field inside occupied cells, 0 elsewhere.

    Args:
        field: density per world unit.
        occupancy: cells that may hold something; None: everywhere.
        chunk: positions evaluated at once; it bounds the memory and changes no value.
    """

    def __init__(self, field: Field, occupancy: OccupancyGrid | None = None, chunk: int = 1 << 18) -> None:
        if chunk < 1:
            raise InputError(f"chunk={chunk}: expected at least 1 position")
        self.field, self.occupancy, self.chunk = field, occupancy, chunk

    @torch.no_grad()
    def __call__(self, positions: Tensor) -> Tensor:
        """World positions ``(N, 3)`` to densities ``(N,)`` per world unit.

        Raises:
            InputError: if the field gives a density that is not finite.
        """
        found = torch.zeros(positions.shape[0], dtype=positions.dtype, device=positions.device)
        for start in range(0, positions.shape[0], self.chunk):
            part = positions[start : start + self.chunk]
            kept = torch.arange(part.shape[0], device=part.device)
            if self.occupancy is not None:
                kept = self.occupancy.contains(part).nonzero().squeeze(-1)
            if kept.numel():
                found[start + kept] = self.field.density(part[kept]).to(found.dtype)
        broken = int((~torch.isfinite(found)).sum())
        if broken:
            raise InputError(f"field: its density is not finite at {broken} of {found.shape[0]} positions")
        return found


@dataclass(frozen=True)
class DensityVolume:
    """Densities at lattice nodes; node ``(i, j, k)`` lies at ``lower + (i, j, k) * spacing``.

    Args:
        values: ``(X, Y, Z)`` float32, per world unit.
        lower: ``(3,)`` position of node 0, world units.
        spacing: ``(3,)`` distance between nodes, world units.
    """

    values: Array
    lower: NDArray[np.float64]
    spacing: NDArray[np.float64]

    def at(self, positions: NDArray[np.float64]) -> Array:
        """Return the values between nodes at positions ``(N, 3)``, linearly interpolated, ``(N,)``."""
        index = (positions - self.lower) / self.spacing
        found = ndimage.map_coordinates(self.values, index.T, order=1, mode="nearest")
        return np.asarray(found, dtype=np.float32)


def lattice_nodes(bounds: Tensor, resolution: int) -> tuple[int, int, int]:
    """Nodes along x, y, z with nearly cubic cells and ``resolution`` nodes along the longest edge.

    Example:
        >>> lattice_nodes(torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 0.5]]), 9)
        (9, 5, 3)
    """
    size = (bounds[1] - bounds[0]).double()
    cell = float(size.max()) / (resolution - 1)
    x, y, z = (max(2, round(float(edge) / cell) + 1) for edge in size)
    return x, y, z


def sample_density(density: SeenDensity, bounds: Tensor, resolution: int) -> DensityVolume:
    """Evaluate a density at the nodes of a lattice whose outer nodes lie on the faces of a box.

    Args:
        density: what to evaluate, in chunks of its own size.
        bounds: ``(2, 3)`` corners of the box, world units.
        resolution: nodes along the longest edge, at least 2.

    Raises:
        InputError: for a resolution below 2, a box without volume, or a density that is not finite.
    """
    if resolution < 2:
        raise InputError(f"resolution={resolution}: expected at least 2 nodes along the longest edge")
    if tuple(bounds.shape) != (2, 3) or not bool((bounds[1] > bounds[0]).all()):
        raise InputError(f"bounds={bounds.tolist()}: expected a lower and a larger upper corner")
    counts = lattice_nodes(bounds, resolution)
    axes = []
    for axis, count in enumerate(counts):
        nodes = torch.linspace(
            float(bounds[0, axis]), float(bounds[1, axis]), count, dtype=torch.float64, device=bounds.device
        )
        # A node a rounding error outside of the box would be empty and open the surface there.
        axes.append(nodes.to(bounds.dtype).clamp(bounds[0, axis], bounds[1, axis]))
    values = np.empty(counts, dtype=np.float32)
    per_layer = counts[1] * counts[2]
    layers = max(1, density.chunk // per_layer)
    for start in range(0, counts[0], layers):
        mesh = torch.meshgrid(axes[0][start : start + layers], axes[1], axes[2], indexing="ij")
        positions = torch.stack([m.reshape(-1) for m in mesh], dim=-1)
        values[start : start + layers] = density(positions).cpu().numpy().reshape(-1, *counts[1:])
    corners = bounds.double().cpu().numpy()
    return DensityVolume(values, corners[0], (corners[1] - corners[0]) / (np.array(counts) - 1))


def surface_threshold(volume: DensityVolume) -> float:
    """The density at which a surface casts the same shadows along the axes as the field does.

    Of all rays along the axes through the nodes, ``k`` lose at least half of their light. A surface at some
    density is hit by the rays whose largest density lies above it; at the density between the k-th and the
    next largest of these, it is hit by ``k`` rays. What is seen against the background is so neither swollen
    nor worn off, and, unlike the density that is half opaque over one voxel, this one does not grow with the
    resolution, at which soft objects vanish.

    A solid of one low density has rays through its rim that lose little light, which would put the surface
    right on that density. So the result is at most half of the density at which rays have lost half of their
    light, in the median.

    Returns:
        Density per world unit.

    Raises:
        InputError: if no ray along an axis loses half of its light: the field is empty.
    """
    half = math.log(2)
    taking, largest, opaque_rays, strongest = [], [], 0, 0.0
    for axis in range(3):
        forwards = np.moveaxis(volume.values, axis, 0)
        largest.append(forwards.max(axis=0).ravel())
        for along in (forwards, forwards[::-1]):
            depth = np.cumsum(along, axis=0, dtype=np.float32)
            depth *= np.float32(volume.spacing[axis])
            opaque = depth[-1] >= half
            first = np.argmax(depth >= half, axis=0)
            taking.append(np.take_along_axis(along, first[None], axis=0)[0][opaque])
        opaque_rays += int(opaque.sum())
        strongest = max(strongest, float(depth[-1].max()))
    if not opaque_rays:
        raise InputError(
            f"field: no ray along an axis of the box is more than {-math.expm1(-strongest):.3g} opaque, "
            "expected 0.5 for a surface; give a threshold (density per world unit) if something is there"
        )
    ordered = np.append(np.sort(np.concatenate(largest))[::-1], np.float32(0))
    shadows = (float(ordered[opaque_rays - 1]) + float(ordered[opaque_rays])) / 2
    return min(shadows, float(np.median(np.concatenate(taking))) / 2)
