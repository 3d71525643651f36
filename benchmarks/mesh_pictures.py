"""Shaded pictures of meshes without a graphics card: points spread densely over the surface, nearest in front."""

from __future__ import annotations

import numpy as np
import torch

from gridreg.export import Camera, Mesh
from gridreg.export.compare import sample_surface


def mesh_picture(mesh: Mesh, camera: Camera, *, coloured: bool, samples: int = 1_500_000) -> np.ndarray:
    """A picture ``(H, W, 3)`` uint8 of a mesh on white, lit from the camera.

    Args:
        mesh: in world coordinates.
        camera: from where.
        coloured: with the colours of the vertices; else grey, which shows the shape.
        samples: points on the surface; several for each pixel, or holes remain.
    """
    points, faces = sample_surface(mesh, samples, torch.Generator().manual_seed(0))
    corners = mesh.vertices[mesh.faces[faces]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    pose = camera.pose.double().numpy()
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    fx, fy, cx, cy = camera.lens.intrinsics
    depth = -local[:, 2]
    safe = np.maximum(depth, 1e-9)
    column = np.floor(cx + fx * local[:, 0] / safe).astype(int)
    row = np.floor(cy - fy * local[:, 1] / safe).astype(int)
    away = points - pose[:3, 3]
    facing = -(normals * away).sum(axis=1) / np.linalg.norm(away, axis=1)
    height, width = camera.lens.height, camera.lens.width
    # Faces that look away are hidden by those before them; drawing them would fill holes wrongly.
    seen = (depth > 0) & (facing > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    light = 0.25 + 0.75 * np.clip(facing, 0, 1)
    colour = np.full((len(points), 3), 0.72)
    if coloured and mesh.colours is not None:
        colour = mesh.colours[mesh.faces[faces]].mean(axis=1) / 255
    shaded = np.clip(colour * light[:, None], 0, 1)
    picture = np.full((height, width, 3), 255, np.uint8)
    order = np.argsort(-depth[seen], kind="stable")
    picture[row[seen][order], column[seen][order]] = np.rint(255 * shaded[seen][order])
    return picture
