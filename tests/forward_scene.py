"""A forward-facing scene: the built-in object seen from a plane of cameras, in LLFF's format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.builtin.raycast import render_rgba


def write_forward_scene(folder: Path, *, size: int = 32, count: int = 9) -> Path:
    """Write ``count`` opaque pictures of ``size`` pixels and their ``poses_bounds.npy``; return the folder."""
    (folder / "images").mkdir(parents=True)
    middle = look_at_origin(30.0, 20.0)
    focal = 1.7 * size
    rows = []
    for k in range(count):
        pose = middle.copy()
        angle = 2 * np.pi * k / count
        pose[:3, 3] += middle[:3, :3] @ [0.5 * np.cos(2 * angle), 0.4 * np.sin(angle), 0.0]
        rgba = render_rgba(pose, np.array([focal, focal, size / 2, size / 2]), size, size, samples=2)
        picture = rgba[..., :3] * rgba[..., 3:] + np.array([0.2, 0.3, 0.5]) * (1 - rgba[..., 3:])
        pixels = np.rint(255 * picture).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"view_{k:02d}.png")
        right, up, back, place = pose[:3].T
        matrix = np.stack([-up, right, back, place, [size, size, focal]], axis=-1)
        rows.append([*matrix.ravel(), 2.2, 6.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder
