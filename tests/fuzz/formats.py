"""Strategies of files as exporters write them, with something wrong: first in their structure, then in their bytes.

Every strategy draws an `Input`: a name for reports, files for a folder, and what reads it.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from hypothesis import strategies as st
from PIL import Image

from gridreg.export import load_cameras, read_mesh
from gridreg.scenes import Scene, default_protocol, load_scene
from gridreg.scenes.images import read_mask, read_rgba
from gridreg.training.strict_yaml import read_yaml

__all__ = ["Input", "changed_bytes", "changed_json", "changed_words", "images", "scene_inputs"]

EDGE = 12
NUMBERS = st.one_of(
    st.sampled_from(
        [0, -1, 1, 2**31, 2**63, 10**400, -0.0, 1e-300, 1e300, 3.5e38, float("nan"), float("inf")]
    ),
    st.floats(),
    st.integers(-(2**70), 2**70),
)
ODDITIES = st.one_of(
    NUMBERS,
    st.none(),
    st.booleans(),
    st.text(max_size=8),
    st.sampled_from(["", "..", "/etc/passwd", "a\0b", "\ud800", "\x1b[31m", "x\ny", "=1+1", "C:\\a.png"]),
    st.lists(NUMBERS, max_size=5),
    st.lists(st.lists(NUMBERS, max_size=5), max_size=5),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)


@dataclass(frozen=True)
class Input:
    """Files to be read.

    Attributes:
        kind: name of the format, for reports.
        files: content by path inside a folder.
        read: what reads the folder.
    """

    kind: str
    files: dict[str, bytes]
    read: Callable[[Path], Any]


def scene(folder: Path) -> Scene:
    """Load a folder as the commands do."""
    return load_scene(folder, default_protocol(folder))


def image(k: int, mode: str = "RGBA", kind: str = "PNG", **options: Any) -> bytes:
    """Encode a small image that differs with its number."""
    values = np.random.default_rng(k).integers(0, 256, (EDGE, EDGE, 4), dtype=np.uint8)
    values[..., 3] = 255 * (values[..., 3] > 99)
    stream = io.BytesIO()
    Image.fromarray(values).convert(mode).save(stream, kind, **options)
    return stream.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def deep_image(colours: int, edge: int = EDGE) -> bytes:
    """Return a PNG of 16 bits a channel, RGB (2) or RGBA (6)."""
    rows = np.random.default_rng(colours).integers(
        0, 256, (edge, 1 + edge * (6 if colours == 2 else 8)), np.uint8
    )
    rows[:, 0] = np.arange(edge) % 5
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", edge, edge, 16, colours, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes())),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def white_square(kind: str) -> bytes:
    """Return a mask."""
    values = np.zeros((EDGE, EDGE), np.uint8)
    values[3:8, 3:8] = 255
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, kind)
    return stream.getvalue()


SIDEWAYS = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
IMAGES = {f"images/{k}.png": image(k) for k in range(5)}


def pose(k: int) -> list[list[float]]:
    """Return a camera at distance 4 that looks at the origin."""
    angle = 0.9 * k
    back = np.array([np.cos(angle), np.sin(angle), 0.0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([[-back[1], back[0], 0], [0, 0, 1], back, 4 * back], axis=-1)
    return [[float(value) for value in row] for row in matrix]


def nodes(value: Any) -> list[tuple[Any, ...]]:
    """Return the path of every node of a JSON value below its top."""
    found: list[tuple[Any, ...]] = []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found += [(key,), *((key, *rest) for rest in nodes(inner))]
    return found


@st.composite
def changed_json(draw: st.DrawFn, content: dict[str, Any]) -> bytes:
    """Draw a JSON text of which one to three values are replaced or gone."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(nodes(content)))
        node: Any = content
        for key in path[:-1]:
            node = node[key]
        if draw(st.integers(0, 4)):
            node[path[-1]] = draw(ODDITIES)
        else:
            del node[path[-1]]
        if not nodes(content):
            break
    return json.dumps(content).encode("utf-8", "surrogatepass")


@st.composite
def changed_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """Draw the bytes with some of them replaced, cut off, or repeated."""
    spoiled = bytearray(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data)
    for _ in range(draw(st.integers(0, 4))):
        if spoiled:
            spoiled[draw(st.integers(0, len(spoiled) - 1))] = draw(st.integers(0, 255))
    return bytes(spoiled + spoiled[:40] if not draw(st.integers(0, 9)) else spoiled)


def resealed(data: bytes) -> bytes:
    """Return a PNG with right checksums, so that what is damaged reaches the decoder; other data as they are."""
    parts, place = [data[:8]], 8
    while data[:4] == b"\x89PNG" and len(data) >= place + 8:
        length = int.from_bytes(data[place : place + 4], "big")
        parts.append(chunk(data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    return b"".join(parts) if len(parts) > 1 else data


@st.composite
def changed_words(draw: st.DrawFn, text: str) -> bytes:
    """Draw a text of which some words are others, or lines are gone."""
    lines = [line.split(" ") for line in text.splitlines()]
    for _ in range(draw(st.integers(1, 3))):
        line = draw(st.sampled_from(lines))
        word = st.one_of(NUMBERS.map(str), st.text(max_size=6), st.just(""))
        line[draw(st.integers(0, len(line) - 1))] = draw(word)
    if draw(st.booleans()):
        del lines[draw(st.integers(0, len(lines) - 1))]
    return "\n".join(" ".join(line) for line in lines).encode("utf-8", "surrogatepass")


TRANSFORMS = {
    "camera_angle_x": 0.69,
    "w": EDGE,
    "h": EDGE,
    "k1": 0.01,
    "gridreg": {"near": 2.0, "far": 6.0, "bounds": [[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]]},
    "test_filenames": ["images/0.png"],
    "frames": [{"file_path": f"images/{k}.png", "fl_x": 17.0, "transform_matrix": pose(k)} for k in range(5)],
}
BLENDER = {
    "camera_angle_x": 0.69,
    "frames": [{"file_path": f"./images/{k}", "transform_matrix": pose(k)} for k in range(5)],
}
COLMAP = {
    "cameras": f"1 OPENCV {EDGE} {EDGE} 17 17 6 6 0.01 0 0 0\n",
    "images": "".join(f"{k + 1} 1 0.0{k} 0 0 0.{k} 0 4 1 {k}.png\n1.0 2.0 -1\n" for k in range(5)),
    "points3D": "".join(f"{k} 0.{k} 0 0.1 9 9 9 0.5 1 2\n" for k in range(9)),
}
YAML = "preset: quick\ntrain:\n  steps: 100\n  rays: [1, 2]\nfield: {a: 8e-5}\n"
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


_TRIANGLES = trimesh.creation.box((1.0, 2.0, 3.0))
_TRIANGLES.visual.vertex_colors = np.full((8, 4), 99, np.uint8)
MESHES = [
    ("ply", PLY),
    *((kind, _TRIANGLES.export(file_type=kind)) for kind in ("ply", "stl", "stl_ascii", "obj", "off", "glb")),
]
MESHES = [(kind.partition("_")[0], data.encode() if isinstance(data, str) else data) for kind, data in MESHES]


@st.composite
def single_lists(draw: st.DrawFn) -> Input:
    """Draw a ``transforms.json``, as values or as bytes."""
    plain = json.dumps(TRANSFORMS).encode()
    text = draw(st.one_of(changed_json(TRANSFORMS), changed_json(TRANSFORMS), changed_bytes(plain)))
    return Input("transforms.json", {**IMAGES, "transforms.json": text}, scene)


@st.composite
def blender_lists(draw: st.DrawFn) -> Input:
    """Draw Blender's two lists, one of them changed."""
    lists = {f"transforms_{split}.json": json.dumps(BLENDER).encode() for split in ("train", "test")}
    lists[draw(st.sampled_from(sorted(lists)))] = draw(changed_json(BLENDER))
    return Input("Blender", {**IMAGES, **lists}, scene)


@st.composite
def colmap_texts(draw: st.DrawFn) -> Input:
    """Draw a COLMAP model in text form, one file changed."""
    files = {f"sparse/0/{name}.txt": text.encode() for name, text in COLMAP.items()}
    name = draw(st.sampled_from(sorted(COLMAP)))
    files[f"sparse/0/{name}.txt"] = draw(changed_words(COLMAP[name]))
    return Input("COLMAP text", {**IMAGES, **files}, scene)


@st.composite
def colmap_binaries(draw: st.DrawFn) -> Input:
    """Draw a COLMAP model in binary form, one file changed."""
    whole = {
        "cameras": struct.pack("<QiiQQ4d", 1, 1, 1, EDGE, EDGE, 17, 17, 6, 6),
        "images": struct.pack("<Q", 5)
        + b"".join(
            struct.pack("<i7di", k, 1, 0.01 * k, 0, 0, 0.1 * k, 0, 4, 1) + f"{k}.png".encode() + bytes(9)
            for k in range(5)
        ),
        "points3D": struct.pack("<Q", 9)
        + b"".join(struct.pack("<Q3d3BdQ", k, 0.1 * k, 0, 0.1, 9, 9, 9, 0.5, 0) for k in range(9)),
    }
    name = draw(st.sampled_from(sorted(whole)))
    whole[name] = draw(changed_bytes(whole[name]))
    return Input("COLMAP binary", {**IMAGES, **{f"sparse/0/{n}.bin": d for n, d in whole.items()}}, scene)


@st.composite
def llff_arrays(draw: st.DrawFn) -> Input:
    """Draw a ``poses_bounds.npy``: other numbers, types and shapes, then other bytes."""
    rows = np.zeros((5, 17))
    for k in range(5):
        axes = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        rows[k] = [*np.column_stack([axes, [0.1 * k, 0, 0], [EDGE, EDGE, 17]]).ravel(), 1, 10]
    for _ in range(draw(st.integers(0, 3))):
        rows[draw(st.integers(0, 4)), draw(st.integers(0, 16))] = draw(st.floats())
    dtype = draw(st.sampled_from(["f8", "f4", ">f8", "c16", "S8", "i4"]))
    stream = io.BytesIO()
    with np.errstate(all="ignore"):
        np.save(stream, rows.reshape(draw(st.sampled_from([(5, 17), (17, 5), (85,)]))).astype(dtype))
    data = stream.getvalue()
    return Input("LLFF", {**IMAGES, "poses_bounds.npy": draw(st.just(data) | changed_bytes(data))}, scene)


@st.composite
def headers(draw: st.DrawFn) -> bytes:
    """Draw a PNG whose header says anything and whose checksums are right."""
    side = st.sampled_from([0, 1, 5, EDGE, 70_000, 2**31 - 1, 2**32 - 1])
    header = struct.pack(
        ">IIBBBBB",
        draw(side),
        draw(side),
        draw(st.sampled_from([1, 8, 16, 3])),
        draw(st.sampled_from([0, 2, 3, 4, 6, 7])),
        0,
        0,
        draw(st.integers(0, 2)),
    )
    parts = [(b"IHDR", header), (b"IDAT", zlib.compress(draw(st.binary(max_size=300)))), (b"IEND", b"")]
    if draw(st.booleans()):
        parts.insert(1, (b"tRNS", draw(st.binary(max_size=8))))
    if draw(st.booleans()):
        parts.insert(1, (b"eXIf", draw(st.binary(max_size=40))))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@st.composite
def images(draw: st.DrawFn) -> Input:
    """Draw an image or mask: encodings with some bytes changed, PNGs with any header, other programs' formats."""
    whole = draw(
        st.sampled_from(
            [
                image(0),
                image(0, "LA"),
                image(0, "P"),
                image(0, "1"),
                *(white_square(kind) for kind in ("PNG", "TIFF", "BMP", "JPEG")),
                image(0, "L"),
                image(0, "RGB", "JPEG", exif=SIDEWAYS),
                image(0, "RGBA", "WEBP"),
                image(0, "F", "TIFF"),
                image(0, "RGB", "TIFF"),
                image(0, "RGB", "BMP"),
                image(0, "RGB", "EPS"),
                image(0, "RGB", "GIF"),
                image(0, "I;16"),
                deep_image(2),
                deep_image(6),
            ]
        )
    )
    data = draw(st.one_of(changed_bytes(whole), changed_bytes(whole).map(resealed), headers()))
    if draw(st.booleans()):
        return Input("mask", {"a.png": data}, lambda folder: read_mask(folder / "a.png"))
    return Input("image", {"a.png": data}, lambda folder: read_rgba(folder / "a.png", opaque=True))


@st.composite
def camera_files(draw: st.DrawFn) -> Input:
    """Draw a camera path."""
    return Input(
        "camera path",
        {"path.json": draw(changed_json(TRANSFORMS))},
        lambda folder: load_cameras(folder / "path.json"),
    )


@st.composite
def meshes(draw: st.DrawFn) -> Input:
    """Draw a mesh file."""
    suffix, text = draw(st.sampled_from(MESHES))
    return Input(
        "mesh", {f"a.{suffix}": draw(changed_bytes(text))}, lambda folder: read_mesh(folder / f"a.{suffix}")
    )


@st.composite
def configurations(draw: st.DrawFn) -> Input:
    """Draw a YAML file."""
    text = draw(
        st.one_of(changed_words(YAML), changed_bytes(YAML.encode()), st.text(max_size=60).map(str.encode))
    )
    return Input("YAML", {"a.yaml": text}, lambda folder: read_yaml(folder / "a.yaml"))


def scene_inputs() -> list[st.SearchStrategy[Input]]:
    """Return a strategy for each format of scenes, images, meshes and camera paths."""
    return [
        single_lists(),
        blender_lists(),
        colmap_texts(),
        colmap_binaries(),
        llff_arrays(),
        images(),
        camera_files(),
        meshes(),
        configurations(),
    ]
