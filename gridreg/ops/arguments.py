"""What a march and a density need to know, besides grids."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

__all__ = ["Activation", "MarchArguments"]


class Activation(NamedTuple):
    """``density = scale * softplus(feature + shift)`` inside a box, 0 outside.

    Args:
        bounds: ``(2, 3)`` corners of the box, world units.
        shift: added to features.
        scale: per world unit.
    """

    bounds: Tensor
    shift: float
    scale: float


class MarchArguments(NamedTuple):
    """Arguments of `gridreg.ops.rays.march`, which explains them."""

    origins: Tensor
    directions: Tensor
    t_min: Tensor
    t_max: Tensor
    step: float
    cells: Tensor
    bounds: Tensor
    jitter: Tensor | float
