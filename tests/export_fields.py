"""Fields whose geometry is known in closed form, for the tests of what leaves the program."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

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
