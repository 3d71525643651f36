"""One browser of the viewer: what it has seen, and the image that it is sent."""

from __future__ import annotations

from typing import Any

from gridreg.export.images import colour_bar, depth_range, to_image
from gridreg.export.viewer_panel import Look
from gridreg.rendering import Rendered
from gridreg.training.images import ImageArray

__all__ = ["Screen", "composed"]


class Screen:
    """State of one browser: it is drawn when ``wanted`` is ahead, and until it is sharp."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.wanted, self.drawn = 1, 0
        self.width, self.sharp = 0, False
        self.moved, self.served = 0.0, 0.0
        self.placed = False


def composed(rendered: Rendered, look: Look) -> tuple[ImageArray, str]:
    """Return the image for the page, and a note about it."""
    if look.mode != "depth":
        return to_image(rendered, look.mode), ""
    depths = depth_range([rendered])
    pixels = to_image(rendered, "depth", depths)
    if pixels.shape[1] >= 200 and pixels.shape[0] >= 64:
        pixels[:, -64:] = colour_bar(pixels.shape[0], depths)
    return pixels, f", depth {depths[0]:.3g} to {depths[1]:.3g}"
