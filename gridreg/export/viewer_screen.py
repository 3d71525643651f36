"""One browser of the viewer: what it has seen, and the image that it is sent, with few pixels while it moves."""

from __future__ import annotations

import math
from typing import Any

from gridreg.export.images import colour_bar, depth_range, to_image
from gridreg.export.viewer_panel import Look
from gridreg.rendering import Rendered
from gridreg.training.images import ImageArray


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


class Pace:
    """Follows how long rays take and says how wide the next image should be.

    Args:
        seconds: what an image may take while the camera moves.
        smallest: width below which it does not go, pixels.
    """

    def __init__(self, seconds: float = 0.12, smallest: int = 48) -> None:
        self.seconds, self.smallest = seconds, smallest
        # About what two cores do; the first image corrects it.
        self._per_ray = 1e-5

    def saw(self, rays: int, seconds: float) -> None:
        """Tell how long an image took."""
        if rays > 0:
            self._per_ray += 0.5 * (seconds / rays - self._per_ray)

    def moving(self, full: int, aspect: float) -> int:
        """Width of an image that can be drawn in time, at most ``full``, pixels.

        Args:
            full: width at rest, pixels.
            aspect: width over height.

        Example:
            >>> pace = Pace(seconds=0.1, smallest=10)
            >>> for _ in range(40): pace.saw(1000, 0.01)
            >>> pace.moving(800, aspect=1.0), pace.moving(60, aspect=1.0)
            (100, 60)
        """
        rays = self.seconds / max(self._per_ray, 1e-9)
        return max(min(self.smallest, full), min(full, round(math.sqrt(rays * aspect))))

    @staticmethod
    def sharper(width: int, full: int) -> int:
        """The next width at rest: twice, and the last step is not a small one.

        Example:
            >>> Pace.sharper(100, 800), Pace.sharper(300, 800)
            (200, 800)
        """
        return full if full < 3 * width else 2 * width
