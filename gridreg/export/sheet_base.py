"""An object on the sheet, closed where it stood: down there no photograph saw it."""

from __future__ import annotations

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Field, OccupancyGrid
from gridreg.scenes import World


class OnSheet:
    """A field that goes on below a height as it is there, straight down to the sheet, and has nothing below that.

    Args:
        field: the field.
        occupancy: cells that count; None: everywhere.
        world: where its coordinates lie in the world of the sheet, whose z is 0.
        height: over the sheet, metres.

    Raises:
        InputError: for a height that is not within the field's box.
    """

    def __init__(self, field: Field, occupancy: OccupancyGrid | None, world: World, height: float) -> None:
        self._field, self._occupancy = field, occupancy
        self._ground, self._low = ((z - world.origin[2]) / world.unit for z in (0.0, height))
        self.bounds = field.bounds.clone()
        # Where the outline is taken must be in the box itself, whose faces belong to it.
        lowest, top = float(field.bounds[0, 2]), float(field.bounds[1, 2])
        self._low = max(self._low, lowest)
        if not (height > 0 and self._ground < self._low < top):
            reach = (top * world.unit + world.origin[2]) * 1000
            raise InputError(
                f"base: found {1000 * height:g} mm over the sheet, expected above 0 and below {reach:.4g}"
            )
        self.bounds[0, 2] = self._ground

    def density(self, x: Tensor) -> Tensor:
        """Densities ``(N,)`` at positions ``(N, 3)``."""
        lifted = self._lifted(x)
        found = self._field.density(lifted)
        return found if self._occupancy is None else torch.where(self._occupancy.contains(lifted), found, 0)

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        """Colours ``(N, 3)`` at positions seen along directions ``(N, 3)``."""
        return self._field.colour(self._lifted(x), d)

    def _lifted(self, x: Tensor) -> Tensor:
        return torch.cat([x[:, :2], x[:, 2:].clamp(min=self._low)], dim=-1)
