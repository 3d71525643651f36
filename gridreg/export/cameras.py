"""Cameras: looking at a point, on the orbit on which the cameras of a scene stand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes import Views
from gridreg.scenes.extent import focus_point

Vector = NDArray[np.float64]


def look_at(position: Vector, target: Vector, up: Vector) -> Tensor:
    """Camera-to-world matrix ``(4, 4)`` float32 of a camera that looks from one point at another.

    Args:
        position, target: ``(3,)``, world units, different.
        up: ``(3,)``; the image's upper edge points that way. Looking along it, any side is up.

    Raises:
        InputError: if both points are the same.
    """
    position, back = np.asarray(position, dtype=np.float64), np.subtract(position, target)
    distance = float(np.linalg.norm(back))
    if not distance > 0:
        raise InputError(
            f"camera: stands at its target {np.asarray(target).tolist()}, expected another point"
        )
    back = back / distance
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(np.eye(3)[np.abs(back).argmin()], back)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return torch.from_numpy(pose).float()


@dataclass(frozen=True)
class Orbit:
    """A circle of places that look at a common centre.

    Args:
        centre: ``(3,)``, world units.
        up: ``(3,)`` unit vector, the axis of rotation.
        front: ``(3,)`` unit vector, orthogonal to ``up``: where azimuth 0 is.
        radius: distance of the cameras from the centre, world units.
        elevation: degrees above the plane through the centre.
        elevations: lowest and highest one of the cameras that it was derived from, degrees.
    """

    centre: Vector
    up: Vector
    front: Vector
    radius: float
    elevation: float
    elevations: tuple[float, float]

    def pose(self, azimuth: float, elevation: float | None = None) -> Tensor:
        """Camera-to-world matrix at an azimuth and an elevation (None: that of the orbit), degrees."""
        a = math.radians(azimuth)
        e = math.radians(self.elevation if elevation is None else elevation)
        level = math.cos(a) * self.front + math.sin(a) * np.cross(self.up, self.front)
        outwards = math.cos(e) * level + math.sin(e) * self.up
        return look_at(self.centre + self.radius * outwards, self.centre, self.up)


def up_axis(poses: Vector) -> Vector:
    """The direction ``(3,)`` that is up for cameras held level.

    A level camera's x axis lies in the ground plane, so the normal of the plane that the x axes span is up.
    Cameras whose x axes span none (one camera, or all side by side) leave it to the mean of their y axes.
    """
    rights, ups = poses[:, :3, 0], poses[:, :3, 1]
    spread, axes = np.linalg.eigh(rights.T @ rights / len(poses))
    mean: Vector = ups.mean(axis=0)
    if spread[1] < 0.05:
        length = float(np.linalg.norm(mean))
        return mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    normal: Vector = axes[:, 0] if axes[:, 0] @ mean >= 0 else -axes[:, 0]
    return normal


def orbit_of_views(views: Views, bounds: Tensor | None = None) -> Orbit:
    """The orbit on which cameras stand: their up, what they look at, median distance and elevation.

    Args:
        views: at least one.
        bounds: ``(2, 3)`` box; a point that lies outside of it is replaced by its middle.

    Raises:
        InputError: without views.
    """
    if not len(views):
        raise InputError("cameras: found no view, expected at least one to derive a path from")
    poses = views.poses.double().cpu().numpy()
    centre = focus_point(poses)
    if bounds is not None:
        lower, upper = bounds.double().cpu().numpy()
        if not ((centre > lower) & (centre < upper)).all():
            centre = (lower + upper) / 2
    up = up_axis(poses)
    away = poses[:, :3, 3] - centre
    distances = np.linalg.norm(away, axis=1)
    elevations = np.degrees(np.arcsin(np.clip(away @ up / np.maximum(distances, 1e-9), -1, 1)))
    # Straight from above or below a turntable only spins the image.
    elevation = float(np.clip(np.median(elevations), -60, 60))
    span = (float(elevations.min()), float(elevations.max()))
    return Orbit(centre, up, _level(away[0], up), float(np.median(distances)), elevation, span)


def orbit_of_box(bounds: Tensor, elevation: float = 25.0, angle: float = 40.0) -> Orbit:
    """An orbit around a box, for want of cameras: z is up, and the box fits into a field of view."""
    lower, upper = bounds.double().cpu().numpy()
    half = float(np.linalg.norm(upper - lower)) / 2
    radius = half / math.sin(math.radians(angle) / 2)
    up = np.array([0.0, 0.0, 1.0])
    return Orbit((lower + upper) / 2, up, np.array([0.0, -1.0, 0.0]), radius, elevation, (0.0, 60.0))


def _level(direction: Vector, up: Vector) -> Vector:
    """The part of a direction that is orthogonal to up, length 1."""
    flat = direction - (direction @ up) * up
    if np.linalg.norm(flat) < 1e-3 * max(float(np.linalg.norm(direction)), 1e-9):
        flat = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return np.asarray(flat / np.linalg.norm(flat))
