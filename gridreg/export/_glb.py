"""Triangles as binary glTF 2.0: y is up, lengths are metres, and vertex colours are linear."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from gridreg.export.mesh import Mesh

__all__ = ["Y_UP", "glb_of", "srgb_of"]

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of a world with z up to one with y up."""


def glb_of(mesh: Mesh) -> bytes:
    """Return the file; colours are floats, as the 8 bits of trimesh show steps in the dark once they are linear."""
    # trimesh's visuals and exporters have no types.
    surface: Any = PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0)  # type: ignore[no-untyped-call]
    surface.baseColorTexture = None if mesh.texture is None else Image.fromarray(mesh.texture)
    visual: Any = TextureVisuals(uv=mesh.places, material=surface)  # type: ignore[no-untyped-call]
    made = trimesh.Trimesh(mesh.vertices @ Y_UP.T, mesh.faces, visual=visual, process=False)
    if mesh.colours is not None:
        made.vertex_attributes["_linear"] = _linear(mesh.colours / 255).astype("<f4")

    def finish(tree: dict[str, Any]) -> None:
        tree["asset"] |= {"generator": "gridreg", "extras": {"size": mesh.size}}
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        if "_linear" in attributes:
            attributes["COLOR_0"] = attributes.pop("_linear")

    content = export_glb(trimesh.Scene(made), include_normals=False, tree_postprocessor=finish)  # type: ignore[no-untyped-call]
    return bytes(content)


def srgb_of(linear: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return linear colours of 8 bits as sRGB (IEC 61966-2-1)."""
    x = linear / 255
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * encoded), dtype=np.uint8)


def _linear(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
