"""Ways of a camera: around, up and around, to and fro before a scene, or through its training cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]
from torch import Tensor

from gridreg.errors import InputError
from gridreg.export.camera_files import load_cameras
from gridreg.export.cameras import Orbit, Vector, look_at, orbit_of_box, orbit_of_views, up_axis
from gridreg.machine import check_memory
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import IN_PLACE, Views, World
from gridreg.scenes.extent import focus_point

CAMERA_PATHS = ("turntable", "spiral", "train")
"""Names that `camera_path` knows; anything else is a camera file."""


def camera_path(
    name: str | Path,
    bounds: Tensor,
    views: Views | None = None,
    *,
    frames: int = 120,
    width: int | None = None,
    elevation: float | None = None,
    radius: float | None = None,
    world: World = IN_PLACE,
) -> list[Camera]:
    """The cameras of a video by name.

    Args:
        name: "turntable", "spiral", "train" (through the training cameras), or a JSON file, see
            `load_cameras`.
        bounds: ``(2, 3)`` box of the field, world units.
        views: the training views, which say where up is, how far away to stand and through which lens to
            look. Without them z is up, the box fits into the image, and there is no "train".
        frames: number of images; a file has its own.
        width: of the images, pixels; None: that of the views, or 400.
        elevation: of the turntable, degrees; None: the median of the views'.
        radius: of turntable and spiral, world units; None: the median of the views'.

        world: where the field's coordinates lie in the world of the scene's files, in which a camera file counts.

    Raises:
        InputError: for an unknown name, numbers out of range, "train" without views, or a bad file.
    """
    check_memory(1000 * frames, f"frames={frames}")
    lens = (
        Lens.from_angle(40.0, 400, 400)
        if views is None
        else Lens.from_tensor(views.intrinsics[0], views.height, views.width)
    )
    lens = lens if width is None else lens.resized(width)
    if str(name) not in CAMERA_PATHS:
        if not Path(name).is_file():
            raise InputError(
                f"path: found {str(name)!r}, expected {', '.join(CAMERA_PATHS)} or a camera file"
            )
        loaded = load_cameras(name, lens, world)
        return loaded if width is None else [Camera(c.pose, c.lens.resized(width)) for c in loaded]
    if name == "train":
        if views is None:
            raise InputError("path 'train': needs the scene's training cameras, expected a scene")
        return tour(views, lens, frames, bounds)
    orbit = orbit_of_box(bounds) if views is None else orbit_of_views(views, bounds)
    orbit = _changed(orbit, elevation, radius)
    if name == "turntable":
        return turntable(orbit, lens, frames)
    if views is not None and forward_facing(views):
        return sway(views, lens, frames)
    return spiral(orbit, lens, frames)


def _changed(orbit: Orbit, elevation: float | None, radius: float | None) -> Orbit:
    if elevation is not None:
        if not -90 < elevation < 90:
            raise InputError(f"elevation={elevation}: expected degrees between -90 and 90")
        orbit = replace(orbit, elevation=elevation)
    if radius is not None:
        if not 0 < radius < 1e18:
            raise InputError(f"radius={radius}: expected a distance in world units above 0")
        orbit = replace(orbit, radius=radius)
    return orbit


def _check_frames(frames: int) -> None:
    if frames < 1:
        raise InputError(f"frames={frames}: expected at least 1")


def turntable(orbit: Orbit, lens: Lens, frames: int = 120) -> list[Camera]:
    """Once around; the frame after the last is the first again.

    Raises:
        InputError: for less than one frame.
    """
    _check_frames(frames)
    return [Camera(orbit.pose(360 * i / frames), lens) for i in range(frames)]


def spiral(orbit: Orbit, lens: Lens, frames: int = 240, turns: int = 2) -> list[Camera]:
    """Around while rising from the lowest to the highest elevation of the orbit and sinking again.

    Raises:
        InputError: for less than one frame.
    """
    _check_frames(frames)
    # Over a pole the image would turn around.
    low, high = (max(-75.0, min(75.0, e)) for e in orbit.elevations)
    angles = [2 * math.pi * i / frames for i in range(frames)]
    rises = [(1 - math.cos(angle)) / 2 for angle in angles]
    return [
        Camera(orbit.pose(math.degrees(turns * angle), low + (high - low) * rise), lens)
        for angle, rise in zip(angles, rises, strict=True)
    ]


def forward_facing(views: Views) -> bool:
    """Return True if all cameras look the same way, to within 60 degrees of their mean direction."""
    axes = -views.poses[:, :3, 2].double().cpu().numpy()
    mean = axes.mean(axis=0)
    return bool((axes @ mean > 0.5 * np.linalg.norm(mean)).all() and np.linalg.norm(mean) > 0.5)


def sway(views: Views, lens: Lens, frames: int = 120, turns: int = 2) -> list[Camera]:
    """Small circles around the mean camera of a forward-facing scene, looking at what all look at (LLFF).

    The circles reach as far to the sides, up and down and to and fro as 90 % of the cameras stand.

    Raises:
        InputError: without views, or for less than one frame.
    """
    _check_frames(frames)
    if not len(views):
        raise InputError("cameras: found no view, expected at least one to derive a path from")
    poses = views.poses.double().cpu().numpy()
    middle, focus, up = poses[:, :3, 3].mean(axis=0), focus_point(poses), up_axis(poses)
    axis = -poses[:, :3, 2].mean(axis=0)
    if (focus - middle) @ axis <= 1e-6 * np.linalg.norm(axis):
        # Parallel axes meet nowhere.
        focus = middle + axis
    frame = look_at(middle, focus, up)[:3, :3].double().numpy()
    reach = np.quantile(np.abs((poses[:, :3, 3] - middle) @ frame), 0.9, axis=0)
    cameras = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        swing = np.array([math.cos(turns * angle), -math.sin(turns * angle), -math.sin(angle)])
        cameras.append(Camera(look_at(middle + frame @ (swing * reach), focus, up), lens))
    return cameras


def tour(views: Views, lens: Lens, frames: int = 240, bounds: Tensor | None = None) -> list[Camera]:
    """Through all cameras of views and back to the first, on a smooth curve around what they look at.

    The order is that of a short round trip. Between two cameras, direction from the common centre, distance,
    point looked at and up vector follow periodic cubic splines, so that the way leads around the object, not
    through it.

    Args:
        views: at least one.
        lens: of all frames.
        frames: evenly spread over the way.
        bounds: as for `orbit_of_views`.

    Raises:
        InputError: without views, or for less than one frame.
    """
    _check_frames(frames)
    orbit = orbit_of_views(views, bounds)
    poses = views.poses.double().cpu().numpy()
    away = poses[:, :3, 3] - orbit.centre
    distances = np.linalg.norm(away, axis=1, keepdims=True)
    directions = away / np.maximum(distances, 1e-9)
    order = round_trip(directions)
    if len(order) == 1:
        return [Camera(views.poses[0].float().cpu(), lens) for _ in range(frames)]
    # The point of each optical axis that is nearest to the centre, but in front of the camera.
    depth = np.maximum((away * poses[:, :3, 2]).sum(axis=1, keepdims=True), 0.1 * distances + 1e-6)
    targets = poses[:, :3, 3] - depth * poses[:, :3, 2]
    knots = np.concatenate([directions, distances, targets, poses[:, :3, 1]], axis=1)[[*order, order[0]]]
    turned = np.linalg.norm(np.diff(knots[:, :4] * [1, 1, 1, 1 / orbit.radius], axis=0), axis=1)
    place = np.concatenate([[0.0], np.cumsum(turned + 1e-3)])
    curve = CubicSpline(place, knots, bc_type="periodic")
    cameras = []
    for row in curve(np.arange(frames) / frames * place[-1]):
        position = orbit.centre + row[3] * row[:3] / max(float(np.linalg.norm(row[:3])), 1e-9)
        cameras.append(Camera(look_at(position, row[4:7], row[7:10]), lens))
    return cameras


def round_trip(points: Vector) -> list[int]:
    """A short closed way through points ``(N, 3)``: the nearest next, then crossings undone (2-opt)."""
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    order, left = [0], list(range(1, len(points)))
    while left:
        order.append(left.pop(int(distance[order[-1], left].argmin())))
    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                a, b, c, d = order[i - 1], order[i], order[j], order[(j + 1) % len(order)]
                if distance[a, c] + distance[b, d] < distance[a, b] + distance[c, d] - 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order
