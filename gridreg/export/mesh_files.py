"""Meshes as files: PLY, OBJ, GLB and STL."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from gridreg.errors import InputError, silenced
from gridreg.export.crop_box import checked_crop
from gridreg.export.decimation import check_faces
from gridreg.export.mesh import Mesh, extract_mesh
from gridreg.export.sheet_base import OnSheet
from gridreg.export.texture import check_texture, textured
from gridreg.rendering import Field, OccupancyGrid
from gridreg.scenes import IN_PLACE, World
from gridreg.scenes.files import read_bytes
from gridreg.training.files import check_output_folder, write_bytes, writing

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl")
"""Formats that `save_mesh` writes, by the suffix of the file's name."""

READABLE = (*MESH_SUFFIXES, ".off", ".gltf")
"""Formats that `read_mesh` reads."""

# From a world with z up to one with y up.
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

TEXTURED = (".obj", ".glb")
"""Formats that have a texture."""


def _check_target(path: Path, texture: int | None = None) -> None:
    suffixes = MESH_SUFFIXES if texture is None else TEXTURED
    if path.suffix.lower() not in suffixes:
        what = "" if texture is None else " for a mesh with a texture"
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected one of {', '.join(suffixes)}{what}")
    check_output_folder(path.parent)


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh as PLY (binary), OBJ, GLB or STL, by the suffix; whole or not at all. Folders are made.

    Coordinates are those of the world, but for GLB, which has y up and linear colours by its standard, and STL, which
    has no colours and, as programs for printing take it, millimetres where the unit is known to be the metre. PLY, OBJ
    and GLB say the size in a comment. A texture goes into the GLB, or beside the OBJ as PNG and MTL.

    Raises:
        InputError: for another suffix, or if the place is not writable or the disk is full.
    """
    path = Path(path)
    kind = path.suffix.lower()
    _check_target(path, None if mesh.texture is None else 1)
    with writing(path) as temporary:
        if kind == ".glb":
            content = _glb(mesh)
        elif mesh.texture is not None:
            content = _textured_obj(mesh, path)
        else:
            scale = 1000 if kind == ".stl" and mesh.metric else 1
            scaled = replace(mesh, vertices=scale * mesh.vertices).to_trimesh()
            scaled.export(temporary, file_type=kind[1:])
            content = _commented(temporary.read_bytes(), kind, f"gridreg, {mesh.size}".encode())
        temporary.write_bytes(content)


def _glb(mesh: Mesh) -> bytes:
    """Return a binary glTF 2.0 file: y is up, colours are linear.

    These are floats, as the 8 bits that trimesh writes show steps in the dark once they are linear.
    """
    # trimesh's visuals and exporters have no types.
    surface: Any = PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0)  # type: ignore[no-untyped-call]
    surface.baseColorTexture = None if mesh.texture is None else Image.fromarray(mesh.texture)
    visual: Any = TextureVisuals(uv=mesh.places, material=surface)  # type: ignore[no-untyped-call]
    made = trimesh.Trimesh(mesh.vertices @ _Y_UP.T, mesh.faces, visual=visual, process=False)
    if mesh.colours is not None:
        made.vertex_attributes["_linear"] = _linear(mesh.colours / 255).astype("<f4")

    def finish(tree: dict[str, Any]) -> None:
        tree["asset"] |= {"generator": "gridreg", "extras": {"size": mesh.size}}
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        if "_linear" in attributes:
            attributes["COLOR_0"] = attributes.pop("_linear")

    content = export_glb(trimesh.Scene(made), include_normals=False, tree_postprocessor=finish)  # type: ignore[no-untyped-call]
    return bytes(content)


def _srgb(linear: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return linear colours of 8 bits as sRGB (IEC 61966-2-1)."""
    x = linear / 255
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * encoded), dtype=np.uint8)


def _linear(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _textured_obj(mesh: Mesh, path: Path) -> bytes:
    """Write image and material beside the file, and return what belongs into it."""
    assert mesh.texture is not None
    black, white = (0, 0, 0, 255), (255, 255, 255, 255)
    material: Any = SimpleMaterial(  # type: ignore[no-untyped-call]
        Image.fromarray(mesh.texture), white, black, black, glossiness=1.0, name=path.stem
    )
    visual: Any = TextureVisuals(uv=mesh.places, material=material)  # type: ignore[no-untyped-call]
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
    text, beside = export_obj(  # type: ignore[no-untyped-call]
        made, return_texture=True, mtl_name=f"{path.stem}.mtl", header=f"gridreg, {mesh.size}"
    )
    for file, content in beside.items():
        write_bytes(path.with_name(file), content)
    return str(text).encode()


def _commented(content: bytes, kind: str, said: bytes) -> bytes:
    if kind == ".ply":
        return content.replace(b"\nelement vertex", b"\ncomment " + said + b"\nelement vertex", 1)
    if kind == ".obj":
        return b"# " + said + b"\n" + content
    # A binary STL begins with 80 bytes of anything but the word "solid".
    return said[:80].ljust(80, b"\0") + content[80:]


def write_mesh(
    field: Field,
    path: str | Path,
    occupancy: OccupancyGrid | None = None,
    *,
    resolution: int = 256,
    faces: int | None = None,
    texture: int | None = None,
    crop: NDArray[np.float64] | None = None,
    base: float | None = None,
    world: World = IN_PLACE,
    **options: Any,
) -> Mesh:
    """`extract_mesh` and `save_mesh` in one, in the world of the scene's files.

    Args:
        field: the field.
        path: file to write; its suffix chooses the format.
        occupancy: as for `extract_mesh`.
        resolution: as for `extract_mesh`.
        faces: at most so many; None: as they come.
        texture: edge of a square texture, pixels, instead of colours of vertices; None: none.
        crop: ``(2, 3)`` box in the world of the files; what is outside is left out, and the cut closed.
        base: height over the sheet, metres, below which the object goes straight down to it; None: as the field has it.
        world: where the field's coordinates lie in the world of the scene's files.
        options: further arguments of `extract_mesh`.

    Raises:
        InputError: of either; for a box that holds nothing of the field's, a base of a scene that is not on the sheet,
            or a texture without xatlas.
    """
    # Before minutes of work, not after.
    _check_target(Path(path), texture)
    if texture is not None:
        check_texture(texture)
        options["colours"] = False
    if faces is not None:
        check_faces(faces)
    if base is not None:
        if not world.metric:
            raise InputError("base: the scene is not one on the sheet, whose ground is known")
        field, occupancy = OnSheet(field, occupancy, world, base), None
    if crop is not None:
        options["bounds"] = _cropped(field.bounds, crop, world)
    # Metres are known from the sheet that the object stands on.
    mesh = extract_mesh(field, occupancy, resolution=resolution, standing=world.metric, **options)
    if faces is not None:
        mesh = mesh.reduced(faces)
    if texture is not None:
        mesh = textured(mesh, field, occupancy, texture, resolution)
    if world != IN_PLACE:
        mesh = replace(mesh, vertices=world.outward(mesh.vertices), metric=world.metric)
    save_mesh(mesh, path)
    return mesh


def _cropped(bounds: torch.Tensor, crop: NDArray[np.float64], world: World) -> torch.Tensor:
    box = checked_crop(crop)
    inner = torch.from_numpy((box - world.origin) / world.unit).to(bounds)
    found = torch.stack([torch.maximum(inner[0], bounds[0]), torch.minimum(inner[1], bounds[1])])
    if not bool((found[0] < found[1]).all()):
        reach = world.outward(bounds.double().cpu().numpy()).round(4).tolist()
        raise InputError(f"crop: the box {box.tolist()} holds nothing of the field's, which is {reach}")
    return found


@np.errstate(all="ignore")
def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh; the parts of a scene become one mesh. No other file, texture or archive is opened.

    Raises:
        InputError: for another suffix than `READABLE`, or if there is no such file, it is not a mesh, it holds no
            faces, or a face names a corner that is not there.
    """
    path = Path(path)
    if path.suffix.lower() not in READABLE:
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected a mesh: {', '.join(READABLE)}")
    try:
        # Bytes have no neighbours: materials, textures and buffers beside the file cannot be named.
        content, kind = io.BytesIO(read_bytes(path, "mesh file")), path.suffix.lower()[1:]
        with silenced("trimesh"):
            loaded = trimesh.load_mesh(content, file_type=kind, process=False, skip_materials=True)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        if kind == "stl":
            # It lists every triangle with corners of its own.
            mesh.merge_vertices()
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
    except InputError:
        raise
    # The readers of trimesh raise whatever their formats make them raise.
    except Exception as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as a triangle mesh: {text}") from error
    # The bound of cameras: distances to what lies beyond are not finite in float32.
    if not len(faces) or not (np.abs(vertices) < 1e18).all():
        raise InputError(
            f"{path}: found {len(faces)} faces, expected a triangle mesh with corners within 1e18"
        )
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        wrong = low if low < 0 else high
        raise InputError(f"{path}: found a face with corner {wrong}, expected 0 to {len(vertices) - 1}")
    colours = None
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors, dtype=np.uint8)[:, :3]
    if kind in ("glb", "gltf"):
        vertices, colours = vertices @ _Y_UP, None if colours is None else _srgb(colours)
    return Mesh(vertices, faces, colours)
