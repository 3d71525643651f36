"""pycolmap on images of the built-in object: the cameras that took them are found again."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from gridreg.scenes import load_scene, prepare
from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.builtin.raycast import cast, render_rgba


def wall_textures() -> np.ndarray:
    """Six square textures of random blobs, no two places alike."""
    noise = np.random.default_rng(0).random((6, 300, 300, 3))
    blurred = gaussian_filter(noise, (0, 1.6, 1.6, 0))
    return np.clip(0.5 + 5 * (blurred - 0.5), 0, 1)


def room_image(pose: np.ndarray, intrinsics: np.ndarray, size: int, textures: np.ndarray) -> np.ndarray:
    """The lighthouse in a room with these textures on its walls, floor and ceiling."""
    rgba = render_rgba(pose, intrinsics, size, size, samples=2)
    hits = cast(pose, intrinsics, np.arange(size) + 0.5, np.arange(size) + 0.5)
    slopes = np.stack(np.broadcast_arrays(hits.right, -hits.down[:, None], -1.0), axis=-1)
    direction = slopes @ pose[:3, :3].T
    reach = (np.sign(direction) * 5.0 - pose[:3, 3]) / direction
    wall = pose[:3, 3] + reach.min(axis=-1, keepdims=True) * direction
    axis = reach.argmin(axis=-1)
    side = axis + 3 * (np.take_along_axis(wall, axis[..., None], -1)[..., 0] > 0)
    u, v = (np.take_along_axis(wall, ((axis + k) % 3)[..., None], -1)[..., 0] for k in (1, 2))
    places = [side, (u + 5) * 29.9, (v + 5) * 29.9]
    behind = np.stack([map_coordinates(textures[..., c], places, order=1) for c in range(3)], axis=-1)
    return np.asarray(rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:]))


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_pycolmap_finds_the_cameras(tmp_path: Path) -> None:
    size = 300
    focal = 0.5 * size / np.tan(0.5 * 0.8)
    intrinsics = np.array([focal, focal, size / 2, size / 2])
    poses = [look_at_origin(14 * k, 18 + 6 * np.sin(k)) for k in range(8)]
    (tmp_path / "images").mkdir()
    textures = wall_textures()
    for k, pose in enumerate(poses):
        pixels = np.rint(255 * room_image(pose, intrinsics, size, textures)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"images/{k}.png")
    prepared = prepare(tmp_path / "images", tmp_path / "out")
    assert len(prepared.registered) >= 7
    scene = load_scene(tmp_path / "out", "holdout8")
    views = (scene.train, scene.test)
    found = {name: pose for view in views for name, pose in zip(view.names, view.poses, strict=True)}
    first, *others = sorted(found)
    for other in others:
        relative = np.linalg.inv(found[first].numpy()) @ found[other].numpy()
        wanted = np.linalg.inv(poses[int(first)]) @ poses[int(other)]
        angle = np.degrees(np.arccos(np.clip((np.trace(relative[:3, :3].T @ wanted[:3, :3]) - 1) / 2, -1, 1)))
        assert angle < 1
