"""Fields whose geometry is known in closed form, for the tests of what leaves the program."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

import gridreg
from gridreg.export.cameras import look_at
from gridreg.rendering.model import Model
from gridreg.scenes import Views

Function = Callable[[Tensor], Tensor]


class AnalyticField:
    """A density function inside a box, 0 outside, coloured by position: ``(x - lower) / (upper - lower)``.

    Args:
        function: positions ``(N, 3)`` to densities ``(N,)`` per world unit.
        half: half an edge of the box around the origin, or three of them.
        colour: positions and directions to colours, instead of the position's.
    """

    def __init__(
        self,
        function: Function,
        half: float | tuple[float, float, float] = 1.0,
        colour: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        corner = torch.tensor([half] * 3 if isinstance(half, float) else half)
        self.function, self.bounds, self._colour = function, torch.stack([-corner, corner]), colour
        self.largest_batch = 0

    def density(self, x: Tensor) -> Tensor:
        self.largest_batch = max(self.largest_batch, len(x))
        inside = ((x >= self.bounds[0]) & (x <= self.bounds[1])).all(dim=-1)
        return torch.where(inside, self.function(x), torch.zeros(len(x)))

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        if self._colour is not None:
            return self._colour(x, d)
        return ((x - self.bounds[0]) / (self.bounds[1] - self.bounds[0])).clamp(0, 1)


def ball(
    radius: float, density: float = 1000.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Function:
    """A solid ball of one density."""
    middle = torch.tensor(centre)
    return lambda x: density * ((x - middle).norm(dim=-1) < radius).float()


def box(half: tuple[float, float, float], density: float = 1000.0) -> Function:
    """A solid box around the origin."""
    corner = torch.tensor(half)
    return lambda x: density * (x.abs() < corner).all(dim=-1).float()


def torus(major: float, minor: float, density: float = 1000.0) -> Function:
    """A solid torus around the z axis."""
    return lambda x: density * (((x[:, :2].norm(dim=-1) - major) ** 2 + x[:, 2] ** 2) < minor**2).float()


def union(*functions: Function) -> Function:
    """Where any of them is, with the largest density."""
    return lambda x: torch.stack([f(x) for f in functions]).amax(dim=0)


def ring_of_views(
    count: int,
    radius: float = 3.0,
    elevation: float | tuple[float, float] = 25.0,
    size: tuple[int, int] = (30, 40),
) -> Views:
    """Cameras around the origin, z up, the first on the x axis; white images.

    Args:
        count: number of views, evenly spread.
        radius: distance from the origin.
        elevation: degrees, or the range over which it swings.
        size: height and width.
    """
    low, high = (elevation, elevation) if isinstance(elevation, float) else elevation
    poses = []
    for i in range(count):
        azimuth = 2 * math.pi * i / count
        height = math.radians((low + high) / 2 + (high - low) / 2 * math.sin(2 * azimuth))
        place = (math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height))
        poses.append(look_at(radius * np.array(place), np.zeros(3), np.array([0.0, 0.0, 1.0])))
    focal = 1.2 * size[1]
    intrinsics = torch.tensor([[focal, focal, size[1] / 2, size[0] / 2]]).repeat(count, 1)
    names = tuple(f"view_{i}" for i in range(count))
    return Views(torch.ones(count, *size, 4), torch.stack(poses), intrinsics, names, tuple(range(count)))


class MaskedBall(nn.Module):
    """A ball of radius 0.6, coloured ``(x + 1) / 2 @ weight``: masking rows of the weight takes colours."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.eye(3))
        self.register_buffer("bounds", torch.tensor([[-1.0] * 3, [1.0] * 3]))

    def density(self, x: Tensor) -> Tensor:
        return 60.0 * (x.norm(dim=-1) < 0.6).float()

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        return ((x + 1) / 2) @ self.weight


def ball_model(step: int, extra: tuple[gridreg.Regularizer, ...] = ()) -> Model:
    """A `MaskedBall` with a mask that opens red, then green, then blue within 100 steps."""
    field = MaskedBall()
    mask = gridreg.FrequencyMask(gridreg.parameters("weight", dim=0), until=1.0, block=1)
    handle = gridreg.apply(field, mask, *extra, total_steps=100)
    handle.step(step)
    plain = Model.of_field(field, resolution=24)
    return Model(field, plain.occupancy, plain.march, plain.background, handle)
