"""The mean of several fields of one scene: what they agree on stays, what one of them invented fades."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gridreg.errors import InputError
from gridreg.rendering.occupancy import OccupancyGrid


def deviation_of(images: Tensor) -> Tensor:
    """Return how far images of several members are apart, by pixel: the root mean square, over the channels, of their
    standard deviation.

    Args:
        images: ``(M, ..., C)`` of at least two members.

    Example:
        >>> deviation_of(torch.tensor([[[0.0, 0.5]], [[0.2, 0.5]]])).tolist()
        [0.10000000149011612]
    """
    return images.var(dim=0).mean(dim=-1).sqrt()


class Ensemble(nn.Module):
    """Several fields as one, to be rendered to images, videos and meshes like any other `Field`.

    Density is the mean of the members', colour their mean weighted by density, which is what a mixture of their matter
    emits. A member has nothing outside its occupied cells.

    Args:
        members: fields of one scene, in the same coordinates.
        occupancies: of each member, the cells that may hold something.

    Raises:
        InputError: without members, or with another number of occupancies.

    References:
        Lakshminarayanan et al., "Simple and scalable predictive uncertainty estimation using deep ensembles" (2017);
        Suenderhauf et al., "Density-aware NeRF ensembles" (2023), who take the mean of images instead.
    """

    bounds: Tensor

    def __init__(self, members: Sequence[nn.Module], occupancies: Sequence[OccupancyGrid]) -> None:
        super().__init__()
        if not members or len(members) != len(occupancies):
            raise InputError(
                f"ensemble: found {len(members)} members with {len(occupancies)} occupancies, expected at least one "
                "with its own"
            )
        self.members = nn.ModuleList(members)
        self.occupancies = tuple(occupancies)
        corners = torch.stack([occupancy.bounds for occupancy in occupancies])
        self.register_buffer("bounds", torch.stack([corners[:, 0].amin(0), corners[:, 1].amax(0)]))

    def occupancy(self) -> OccupancyGrid:
        """Cells of the common box in which any member may have something, as many along each axis as any member has."""
        x, y, z = (max(sizes) for sizes in zip(*(one.resolution for one in self.occupancies), strict=True))
        placed = [one.at(self.bounds, (x, y, z)) for one in self.occupancies]
        hulls = [one.hull for one in placed if one.hull is not None]
        return OccupancyGrid(
            self.bounds.clone(),
            torch.stack([one.cells for one in placed]).amax(0),
            torch.stack(hulls).amax(0) if len(hulls) == len(placed) else None,
        )

    def density(self, x: Tensor) -> Tensor:
        """Positions ``(N, 3)`` to densities ``(N,)`` per world unit."""
        return self._densities(x).mean(0)

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        """Positions and directions ``(N, 3)`` to colours ``(N, 3)`` in [0, 1]; the plain mean where nothing is."""
        densities = self._densities(x)
        total = densities.sum(0)
        fractions = torch.where(total > 0, densities / total.clamp(min=1e-12), 1 / len(densities))
        fields: list[Any] = list(self.members)
        return torch.stack(
            [s[:, None] * field.colour(x, d) for s, field in zip(fractions, fields, strict=True)]
        ).sum(0)

    def _densities(self, x: Tensor) -> Tensor:
        fields: list[Any] = list(self.members)
        return torch.stack(
            [
                torch.where(occupancy.contains(x), field.density(x), 0.0)
                for field, occupancy in zip(fields, self.occupancies, strict=True)
            ]
        )
