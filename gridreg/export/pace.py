"""Widths of the next images: few pixels while something moves, all of them at rest."""

from __future__ import annotations

import math

__all__ = ["Pace"]


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
