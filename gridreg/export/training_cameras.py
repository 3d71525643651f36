"""The training cameras in the viewer: where they stand, and the render beside the photograph from one of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor
from torch.nn import functional as F

from gridreg.export.browser import add_frustums, go_to
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model
from gridreg.scenes import Views
from gridreg.training.images import ImageArray, row, to_uint8

# Longer edge of what is compared, pixels.
_EDGE = 400


class TrainingCameras:
    """Cameras of the training views; whoever clicks one stands there, and its photograph makes room.

    Args:
        server: a ``viser.ViserServer``.
        views: the training views; None: there are none.
        background: ``(3,)`` behind photographs and renders.
        depth: length of a camera's pyramid, world units.
        visited: called with the number of the view that somebody goes to.
    """

    def __init__(
        self, server: Any, views: Views | None, background: Tensor, depth: float, visited: Any
    ) -> None:
        self._views, self._background, self._visited = views, background, visited
        self._root = server.scene.add_frame("/cameras", show_axes=False)
        self._near = 0.05 * depth
        self._left: int | None = None
        self.frustums: dict[int, Any] = {}
        if views is not None and len(views):
            self.frustums = add_frustums(server, views, background, depth, self.visit)

    def show(self, wanted: bool) -> None:
        """Show all, or none."""
        self._root.visible = wanted

    def visit(self, client: Any, number: int) -> None:
        """Move a browser's camera to a view, and take that view's pyramid out of the way."""
        assert self._views is not None
        self.come_back()
        self._left = number
        self.frustums[number].visible = False
        go_to(client, self._views.poses[number])
        self._visited(number)

    def come_back(self, position: Any = None) -> None:
        """Show the pyramid that made room, once nobody stands in it (no position: in any case)."""
        if self._left is None or self._views is None:
            return
        place = self._views.poses[self._left, :3, 3].double().cpu().numpy()
        if position is None or np.linalg.norm(np.asarray(position) - place) > self._near:
            self.frustums[self._left].visible, self._left = True, None

    def comparison(self, model: Model, number: int, stop: Any) -> tuple[ImageArray, str] | None:
        """The render beside the photograph, and their PSNR in words; None if it was given up."""
        assert self._views is not None
        views = self._views
        lens = Lens.from_tensor(views.intrinsics[number], views.height, views.width)
        if max(views.height, views.width) > _EDGE:
            lens = lens.resized(max(1, round(views.width * _EDGE / max(views.height, views.width))))
        rendered = model.render(Camera(views.poses[number], lens), stop=stop)
        if rendered is None:
            return None
        # Colours weigh as much as they cover, so they are averaged on their background.
        seen = views.over(number, self._background).permute(2, 0, 1)[None]
        seen = F.interpolate(seen, (lens.height, lens.width), mode="area")
        target = seen[0].permute(1, 2, 0)
        error = float((rendered.colour.to(target) - target).square().mean())
        psnr = -10 * math.log10(max(error, 1e-12))
        text = f"**{views.names[number]}**: render, photograph; {psnr:.2f} dB at {lens.width}x{lens.height}"
        return row([to_uint8(rendered.colour), to_uint8(target)]), text
