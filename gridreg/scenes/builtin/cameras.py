"""The cameras of the built-in scene, on the sphere and with the lens of nerf_synthetic."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["FIELD_OF_VIEW", "RADIUS", "look_at_origin", "test_poses", "train_poses"]

Array = NDArray[np.float64]

RADIUS = 4.0311
"""Distance of every camera from the origin, world units."""
FIELD_OF_VIEW = 0.6911112070083618
"""Horizontal field of view, radians."""

_TRAIN_ELEVATIONS = (12, 48, -14, 28, 4, 62, 20, -6)
_VALIDATION_ELEVATIONS = (30, -10, 52, 8, 22, 40, 0, 16, 58, -4)


def look_at_origin(azimuth: float, elevation: float) -> Array:
    """Return the ``(4, 4)`` pose of a camera that looks at the origin, world z up; angles in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    back = np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(back, right), back, RADIUS * back], axis=-1)
    return pose


def train_poses() -> list[Array]:
    """Return 8 training poses, evenly spread around, followed by 10 for validation between them."""
    train = [look_at_origin(135.0 * k + 20.0, e) for k, e in enumerate(_TRAIN_ELEVATIONS)]
    validation = [look_at_origin(36.0 * k + 3.0, e) for k, e in enumerate(_VALIDATION_ELEVATIONS)]
    return train + validation


def test_poses() -> list[Array]:
    """Return 25 test poses once around, rising and sinking between -8 and 48 degrees."""
    return [look_at_origin(14.4 * k, 20.0 + 28.0 * math.sin(math.radians(3 * 14.4 * k))) for k in range(25)]
