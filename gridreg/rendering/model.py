"""A field with all it takes to render it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gridreg.attach.handle import Handle
from gridreg.errors import InputError
from gridreg.rendering.cameras import Camera
from gridreg.rendering.ensemble import deviation_of
from gridreg.rendering.occupancy import OccupancyGrid
from gridreg.rendering.rays import Rays, camera_rays
from gridreg.rendering.render import MarchSettings, Rendered, render_rays
from gridreg.rendering.surroundings import JoinedSurroundings, Surroundings


def _white() -> Tensor:
    return torch.ones(3)


@dataclass(frozen=True)
class Model:
    """A field with its occupied cells, the march through it, and what lies behind it.

    Args:
        field: a `gridreg.rendering.Field`.
        occupancy: cells that may hold something.
        march: step and range of the rays.
        background: ``(3,)`` colour behind the field.
        handle: of the regularizers attached to the field, if any.
        warp: maps rays of cameras to the field's coordinates, such as normalised device coordinates
            (`gridreg.scenes.ndc_rays`) for forward-facing scenes; distances are then those of the mapped
            rays. None: they are the world's.
        surroundings: what is outside the field's box, instead of the background; None: nothing.
        members: the models that an ensemble is made of, else none.
    """

    field: Any
    occupancy: OccupancyGrid
    march: MarchSettings
    background: Tensor = field(default_factory=_white)
    handle: Handle | None = None
    warp: Callable[[Rays], Rays] | None = None
    surroundings: Surroundings | JoinedSurroundings | None = None
    members: tuple[Model, ...] = ()

    @classmethod
    def of_field(cls, field: Any, *, resolution: int = 256, background: Tensor | None = None) -> Model:
        """A model of a field of which nothing else is known: every cell counts, the step is half a cell.

        Args:
            field: a `gridreg.rendering.Field`.
            resolution: cells along the longest edge of the box that the step follows.
            background: ``(3,)``; None: white.
        """
        if resolution < 1:
            raise InputError(f"resolution={resolution}: expected at least 1 cell")
        bounds: Tensor = field.bounds
        step = 0.5 * float((bounds[1] - bounds[0]).max()) / resolution
        colour = torch.ones(3, device=bounds.device) if background is None else background.to(bounds.device)
        return cls(field, OccupancyGrid.full(bounds, (1, 1, 1)), MarchSettings(step), colour)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        *,
        chunk: int = 1 << 13,
        stop: Callable[[], bool] | None = None,
        deviation: bool = False,
    ) -> Rendered | None:
        """An image; the result does not depend on ``chunk``.

        Args:
            camera: from where.
            chunk: rays at once.
            stop: asked between chunks; True gives the image up.
            deviation: also how far members are apart, which an ensemble alone has.

        Returns:
            colour ``(H, W, 3)`` in [0, 1], opacity and depth ``(H, W)``, on the CPU wherever the field is; None if it
            was given up.

        Raises:
            InputError: for the deviation of what is no ensemble.
        """
        if deviation and not self.members:
            raise InputError("deviation: found one run, expected an ensemble (gridreg ensemble RUN RUN ...)")
        device = self.field.bounds.device
        lens = camera.lens
        rays = camera_rays(
            camera.pose.to(device), torch.tensor(lens.intrinsics, device=device), lens.height, lens.width
        )
        rays = rays if self.warp is None else self.warp(rays)
        parts = []
        for start in range(0, len(rays), chunk):
            if stop is not None and stop():
                return None
            parts.append(self._render(rays[start : start + chunk]))
        apart = None
        if deviation:
            images = [member.render(camera, chunk=chunk, stop=stop) for member in self.members]
            colours = [image.colour for image in images if image is not None]
            if len(colours) < len(images):
                return None
            apart = deviation_of(torch.stack(colours))
        shape = (lens.height, lens.width)
        return Rendered(
            torch.cat([p.colour for p in parts]).clamp(0, 1).reshape(*shape, 3),
            torch.cat([p.opacity for p in parts]).reshape(shape),
            torch.cat([p.depth for p in parts]).reshape(shape),
            deviation=apart,
        )

    def _render(self, rays: Rays) -> Rendered:
        around = self.surroundings
        background = self.background if around is None else torch.zeros_like(self.background)
        rendered = render_rays(self.field, rays, self.occupancy, self.march, background=background)
        if around is not None:
            rendered = around.behind(rendered, rays)
        # The samples would be kept for the whole image.
        return Rendered(rendered.colour.cpu(), rendered.opacity.cpu(), rendered.depth.cpu())
