"""Triangles as binary glTF 2.0: y is up, lengths are metres, and vertex colours are linear."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Y_UP", "glb_of", "srgb_of"]

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of a world with z up to one with y up."""

_FLOAT, _UINT32 = 5126, 5125


def glb_of(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    colours: NDArray[np.uint8] | None = None,
    places: NDArray[np.float64] | None = None,
    texture: bytes | None = None,
    *,
    size: str = "",
) -> bytes:
    """Return the file; trimesh's own writer has 8 bits a colour, which show steps in the dark once they are linear.

    Args:
        vertices: ``(V, 3)``, y up.
        faces: ``(F, 3)``.
        colours: ``(V, 3)`` sRGB, or None.
        places: ``(V, 2)`` in the texture from its lower left corner, or None.
        texture: a PNG, or None.
        size: of the object, in words.
    """
    positions = vertices.astype("<f4")
    arrays: list[tuple[NDArray[Any], int, str]] = [
        (faces.astype("<u4").reshape(-1), _UINT32, "SCALAR"),
        (positions, _FLOAT, "VEC3"),
    ]
    attributes = {"POSITION": 1}
    if colours is not None:
        arrays.append((_linear(colours / 255).astype("<f4"), _FLOAT, "VEC3"))
        attributes["COLOR_0"] = len(arrays) - 1
    if places is not None:
        # Here textures begin at their upper left corner.
        arrays.append(((places * [1, -1] + [0, 1]).astype("<f4"), _FLOAT, "VEC2"))
        attributes["TEXCOORD_0"] = len(arrays) - 1
    blocks = [array.tobytes() for array, _, _ in arrays]
    views, accessors, offset = [], [], 0
    for number, ((array, kind, shape), block) in enumerate(zip(arrays, blocks, strict=True)):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(block)})
        accessors.append({"bufferView": number, "componentType": kind, "count": len(array), "type": shape})
        offset += len(block)
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    images: dict[str, Any] = {}
    if texture is not None:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(texture)})
        blocks.append(texture + b"\0" * (-len(texture) % 4))
        offset += len(blocks[-1])
        surface["baseColorTexture"] = {"index": 0}
        images = {
            "textures": [{"source": 0}],
            "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
        }
    accessors[1] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    content = {
        "asset": {"version": "2.0", "generator": "gridreg", **({"extras": {"size": size}} if size else {})},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": surface}],
        **images,
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    # Every array's elements have a multiple of four bytes, so nothing needs padding.
    binary = b"".join(blocks)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return (
        head
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def srgb_of(linear: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return linear colours of 8 bits as sRGB (IEC 61966-2-1)."""
    x = linear / 255
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * encoded), dtype=np.uint8)


def _linear(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
