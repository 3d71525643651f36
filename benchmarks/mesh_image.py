"""A mesh as it looks from a camera, by points on its surface and a depth buffer: enough for an image in a page."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridreg.export import Camera, Mesh
from gridreg.training.images import ImageArray


def mesh_image(mesh: Mesh, camera: Camera, *, colours: bool, points: int = 3_000_000) -> ImageArray:
    """The image ``(H, W, 3)`` of a mesh on white, lit from the camera's upper left.

    Args:
        mesh: in world coordinates.
        camera: from where.
        colours: its own colours; False: grey, which shows the shape.
        points: drawn on the surface; each covers one pixel.
    """
    rng, corners = np.random.default_rng(0), mesh.corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    chosen = rng.choice(len(corners), points, p=areas / areas.sum())
    u, v = rng.random((2, points, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    of = corners[chosen]
    places = of[:, 0] + u * (of[:, 1] - of[:, 0]) + v * (of[:, 2] - of[:, 0])
    pose, (fx, fy, cx, cy) = camera.pose.double().numpy(), camera.lens.intrinsics
    seen = (places - pose[:3, 3]) @ pose[:3, :3]
    depth = -seen[:, 2]
    column = np.floor(fx * seen[:, 0] / depth + cx).astype(int)
    row = np.floor(-fy * seen[:, 1] / depth + cy).astype(int)
    height, width = camera.lens.height, camera.lens.width
    inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # Faces that look away are hidden by those before them; drawing them would fill holes wrongly.
    inside &= (normals[chosen] * (places - pose[:3, 3])).sum(axis=1) < 0
    light = pose[:3, :3] @ np.array([-0.4, 0.6, 0.7])
    facing = normals[chosen] @ light / np.maximum(areas[chosen], 1e-12) / np.linalg.norm(light)
    shade = 0.35 + 0.65 * facing.clip(0, 1)
    paint: NDArray[np.floating] = np.full((points, 3), 205.0)
    if colours and mesh.colours is not None:
        paint, shade = mesh.colours[mesh.faces[chosen]].mean(axis=1), 0.6 + 0.4 * shade
    # From far to near, so that the nearest point of a pixel is written last.
    order = np.argsort(-depth[inside], kind="stable")
    image = np.full((height, width, 3), 255.0)
    image[row[inside][order], column[inside][order]] = (paint * shade[:, None])[inside][order]
    return np.asarray(image.round().clip(0, 255), np.uint8)
