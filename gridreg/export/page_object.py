"""The object of a page, its photographs and their cameras, as the page's program reads them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from gridreg.export.camera_files import load_cameras
from gridreg.export.cameras import Orbit
from gridreg.export.html import data_uri
from gridreg.export.mesh import Mesh
from gridreg.scenes import Scene, Views, World
from gridreg.scenes.files import read_json
from gridreg.training.images import to_uint8

_PHOTOGRAPHS, _THUMBNAIL = 60, 160
_UINT16 = 2**16 - 1


def object_data(mesh: Mesh, scene: Scene | None, orbit: Orbit, photographs: int) -> dict[str, Any]:
    """The mesh as the page's program reads it: 16 bits a coordinate between two corners, 8 a colour."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    places = np.round((mesh.vertices - low) / np.maximum(high - low, 1e-12) * _UINT16)
    colours = np.full_like(places, 150) if mesh.colours is None else mesh.colours
    wide = len(mesh.vertices) > _UINT16
    # Between the cameras, not behind the first, whose photograph would stand in the way.
    pose = orbit.pose(25.0).double().numpy()
    return {
        "low": low.tolist(),
        "high": high.tolist(),
        "places": _base64(places, "<u2"),
        "colours": _base64(colours, "u1"),
        "faces": _base64(mesh.faces, "<u4" if wide else "<u2"),
        "wide": wide,
        "up": orbit.up.tolist(),
        "front": pose[:3, 2].tolist(),
        "cameras": [] if scene is None else _cameras(scene.train, scene.world)[:photographs],
    }


def _base64(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _chosen(views: Views) -> list[int]:
    count = min(_PHOTOGRAPHS, len(views))
    return [int(i) for i in np.linspace(0, len(views) - 1, count).round()] if count else []


def _cameras(views: Views, world: World) -> list[dict[str, Any]]:
    """Pose (three rows of four) in the world of the files, and where the image ends at distance 1: left, right, below,
    above."""
    found = []
    for i in _chosen(views):
        pose = views.poses[i].double().cpu().numpy()
        pose[:3, 3] = world.outward(pose[:3, 3])
        found.append(_stand(pose, views.intrinsics[i].tolist(), views.width, views.height))
    return found


def _stand(
    pose: NDArray[np.float64], intrinsics: Sequence[float], width: int, height: int
) -> dict[str, list[float]]:
    fx, fy, cx, cy = intrinsics
    edges = [-cx / fx, (width - cx) / fx, (cy - height) / fy, cy / fy]
    return {"pose": np.round(pose[:3], 6).flatten().tolist(), "edges": edges}


def small_photographs(views: Views, background: torch.Tensor) -> list[tuple[str, str]]:
    """Names and small images of the views, in the order of `_cameras`."""
    chosen = _chosen(views)
    found = []
    for i in chosen:
        small = Image.fromarray(to_uint8(views.over(i, background)))
        small.thumbnail((_THUMBNAIL, _THUMBNAIL))
        found.append((views.names[i], data_uri(small, "jpeg")))
    return found


def next_camera(path: Path | None) -> dict[str, Any] | None:
    """The camera to photograph from next, as `gridreg ensemble` leaves it: note, pose, edges of its image."""
    if path is None:
        return None
    (camera,) = load_cameras(path)
    lens = camera.lens
    return {
        "about": str(read_json(path).get("about", "")),
        **_stand(camera.pose.double().numpy(), lens.intrinsics, lens.width, lens.height),
    }
