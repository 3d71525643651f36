"""Surroundings of the box of a scene: a coarse second field in contracted space, seen through the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gridreg.errors import InputError
from gridreg.ops import RayMarchResult
from gridreg.rendering.occupancy import OccupancyGrid
from gridreg.rendering.rays import Rays, box_intersection
from gridreg.rendering.render import MarchSettings, Rendered, render_rays

CONTRACTED = torch.tensor([[-2.0] * 3, [2.0] * 3])
"""Box ``(2, 3)`` that holds all of contracted space."""

# Rays whose opacity leaves less than this are not asked what is behind them.
_HIDDEN = 1e-3


def contract(x: Tensor, box: Tensor) -> Tensor:
    """Map all of space into the cube [-2, 2]^3, a box into its middle [-1, 1]^3.

    With ``u`` the position in half edges from the middle of the box and ``m`` its largest coordinate: ``u`` inside,
    ``(2 - 1 / m) u / m`` outside. Source: mip-NeRF 360 (Barron et al. 2022), equation 10, with the largest coordinate
    instead of the length.

    Args:
        x: ``(..., 3)`` positions, world units.
        box: ``(2, 3)`` lower and upper corner.

    Example:
        >>> box = torch.tensor([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
        >>> contract(torch.tensor([[1.0, 1.5, 1.0], [5.0, 1.0, 1.0]]), box).tolist()
        [[0.0, 0.5, 0.0], [1.75, 0.0, 0.0]]
    """
    u = (2 * x - box[0] - box[1]) / (box[1] - box[0])
    m = u.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
    return (2 - 1 / m) * u / m


class Surroundings(nn.Module):
    """The colour behind a box: walls, a garden, the sky.

    Rays are sampled from where they leave the box to infinity, evenly in contracted space; rays that miss the box also
    from near on. What is not stopped on the way is stopped by the last sample.

    Args:
        field: a `gridreg.rendering.Field` in the box `CONTRACTED`; lengths are those of contracted space.
        box: ``(2, 3)`` lower and upper corner, world units.
        near: distance, world units, from which rays that miss the box are looked at.
        samples: of each ray.

    Raises:
        InputError: for fewer than 2 samples.
    """

    box: Tensor
    bounds: Tensor
    near: Tensor

    def __init__(self, field: nn.Module, box: Tensor, near: float, *, samples: int = 40) -> None:
        super().__init__()
        if samples < 2:
            raise InputError(f"samples: found {samples}, expected at least 2")
        self.field, self.samples = field, samples
        self.register_buffer("box", box.clone())
        self.register_buffer("near", torch.tensor(float(near)))
        # Nothing of a ray is cut away before it is sampled.
        self.register_buffer("bounds", torch.tensor([[-1e9] * 3, [1e9] * 3]), persistent=False)

    def colour_of_rays(self, x: Tensor, directions: Tensor, ray_indices: Tensor) -> Tensor:
        """Colours of contracted positions, as `march_density` gives them."""
        fields: Any = self.field
        by_ray = getattr(fields, "colour_of_rays", None)
        if by_ray is None:
            return fields.colour(x, directions[ray_indices])  # type: ignore[no-any-return]
        return by_ray(x, directions, ray_indices)  # type: ignore[no-any-return]

    def march_density(
        self,
        rays: Rays,
        t_min: Tensor,
        t_max: Tensor,
        step: float,
        occupancy: Any,
        jitter: Tensor,
        bound: float,
    ) -> RayMarchResult:
        """Samples of the rays, their contracted positions and densities; see the class for where they lie."""
        count, lattice = self.samples, torch.arange(self.samples + 1, device=t_min.device)
        enter, leave = box_intersection(rays, self.box)
        passing = leave <= enter
        middle = ((self.box.mean(dim=0) - rays.origins) * rays.directions).sum(dim=-1)
        leave = torch.where(passing, torch.maximum(middle, self.near), leave)
        start = torch.where(passing, self.near, leave)
        # A third of the samples of a ray that passes by are before its middle.
        before = torch.where(passing, 1 / 3, 0.0)[:, None]
        fraction = (lattice + jitter[:, None]) / (count + 1)
        t = start[:, None] + (leave - start)[:, None] * (3 * fraction).clamp(max=1)
        beyond = ((fraction - before) / (1 - before)).clamp(min=0, max=1 - 1e-4)
        reach = (self.box[1] - self.box[0]).mean() / 2
        t = t + reach * beyond / (1 - beyond)
        x = contract(rays.origins[:, None] + t[..., None] * rays.directions[:, None], self.box)
        delta = (x[:, 1:] - x[:, :-1]).norm(dim=-1)
        delta[:, -1] = 1e6
        fields: Any = self.field
        positions = x[:, :-1].reshape(-1, 3).contiguous()
        return RayMarchResult(
            torch.arange(0, count * len(rays) + 1, count, device=t.device),
            lattice[:-1].repeat(len(rays)),
            t[:, :-1].reshape(-1).contiguous(),
            positions,
            fields.density(positions),
            delta.reshape(-1),
            torch.full((len(rays),), count, device=t.device),
        )

    def behind(
        self,
        rendered: Rendered,
        rays: Rays,
        *,
        jitter: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Rendered:
        """The pixels of a field that was rendered on black, with what is behind it; differentiable in both.

        Args:
            rendered: of the field in the box.
            rays: the same rays, or the first of them, if the others' colours do not count.
            jitter, generator: as of `render_rays`, for training.
        """
        seen = (rendered.opacity[: len(rays)] < 1 - _HIDDEN).nonzero().squeeze(-1)
        if not len(seen):
            return rendered
        grey = torch.full((3,), 0.5, device=self.box.device)
        nothing = OccupancyGrid.full(self.bounds, (1, 1, 1))
        found = render_rays(
            self,
            rays[seen],
            nothing,
            MarchSettings(step=1.0, weight_bound=1e-5, merge_weight=0.05, transmittance_bound=0.0),
            background=grey,
            jitter=None if jitter is None else jitter[seen],
            generator=generator,
        )
        left = (1 - rendered.opacity[seen])[:, None]
        return replace(rendered, colour=rendered.colour.index_add(0, seen, left * found.colour))


class JoinedSurroundings(nn.Module):
    """The mean of several surroundings of one scene, for an ensemble.

    Args:
        members: one or more.
    """

    def __init__(self, members: Sequence[Surroundings]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def behind(self, rendered: Rendered, rays: Rays) -> Rendered:
        """The pixels of a field that was rendered on black, with the mean of what is behind it."""
        colours = [member.behind(rendered, rays).colour for member in self.members]  # type: ignore[operator]
        return replace(rendered, colour=torch.stack(colours).mean(dim=0))
