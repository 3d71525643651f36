"""The viewer's controls for a box that a mesh is cut to."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gridreg.export.crop_box import Box, save_crop
from gridreg.scenes import World


class CropControls:
    """A box in the page, by its lower and upper corner, that cuts what is seen, and a button that saves it.

    Args:
        server: a ``viser.ViserServer``, whose world is the field's.
        bounds: ``(2, 3)`` of the field, where the box begins.
        world: where the field lies in the world of the scene's files, in which the corners are shown and saved.
        path: file to save to.
        changed: called whenever the box has changed.
    """

    def __init__(
        self, server: Any, bounds: Tensor, world: World, path: Path, changed: Callable[[], None]
    ) -> None:
        self._server, self._world, self._path, self._changed = server, world, path, changed
        low, high = world.outward(bounds.double().cpu().numpy()).round(6)
        step = float(10.0 ** np.floor(np.log10((high - low).max() / 100)))
        self.shown = server.gui.add_checkbox("Crop box", False, hint="cuts what is seen, and the mesh")
        self.low = server.gui.add_vector3("From", tuple(low), step=step, visible=False)
        self.high = server.gui.add_vector3("To", tuple(high), step=step, visible=False)
        self._button = server.gui.add_button("Save crop box", hint=f"to {path}", visible=False)
        for control in (self.shown, self.low, self.high):
            control.on_update(lambda _: self._draw())
        self._button.on_click(self._save)
        self._lines: Any = None

    @property
    def box(self) -> Box:
        """The box ``(2, 3)``, in the world of the files."""
        return np.array(
            [np.minimum(self.low.value, self.high.value), np.maximum(self.low.value, self.high.value)]
        )

    @property
    def inner(self) -> Box | None:
        """The box in the field's coordinates while it cuts, else None."""
        return (self.box - self._world.origin) / self._world.unit if self.shown.value else None

    def _draw(self) -> None:
        for control in (self.low, self.high, self._button):
            control.visible = bool(self.shown.value)
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        inner = self.inner
        if inner is not None:
            corners = list(product((0, 1), repeat=3))
            pairs = [pair for pair in combinations(corners, 2) if np.abs(np.subtract(*pair)).sum() == 1]
            points = np.array(
                [[[inner[k, axis] for axis, k in enumerate(end)] for end in pair] for pair in pairs]
            )
            self._lines = self._server.scene.add_line_segments(
                "/crop", points.astype(np.float32), (220, 0, 120), thickness=0.006
            )
        self._changed()

    def _save(self, event: Any) -> None:
        # A page must not end the viewer, whatever its disk is like.
        try:
            save_crop(self._path, self.box)
            said = f"gridreg mesh RUN --crop {self._path}"
        except Exception as error:
            said = str(error)
        if event.client is not None:
            event.client.add_notification("Crop box", said)
