"""``gridreg mesh``: the surface of a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from gridreg.cli.arguments import Checkpoint, OptionalFile, OptionalFloat, OptionalInt
from gridreg.machine import DeviceName, choose_device


@dataclass
class MeshOptions:
    """Cut a closed, coloured mesh out of a checkpoint's density, in world coordinates."""

    checkpoint: Checkpoint
    """Output folder of a run, or its checkpoint."""
    out: OptionalFile = None
    """File to write: .ply, .obj, .stl or .glb (y up); default: mesh.ply in the run's folder."""
    resolution: int = 256
    """Lattice nodes along the longest edge of the box; memory grows with the cube, 350 MB at 256."""
    threshold: OptionalFloat = None
    """Density at the surface, per world unit; default: follows from the field."""
    min_component: float = 0.01
    """Parts with less surface than this fraction of the largest part's are dropped; 0 keeps all."""
    faces: OptionalInt = None
    """At most so many faces, such as 100000; default: as many as the resolution gives."""
    texture: OptionalInt = None
    """Edge of a texture in pixels, such as 1024, for .obj and .glb (extra `texture`); slow over 100000 faces."""
    crop: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="FILE|X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="")
    ] = ()
    """Box to keep, in the coordinates of the scene's files: six numbers, or a file that the viewer has saved."""
    base: OptionalFloat = None
    """Millimetres over the sheet below which the object goes straight down to it: closes what no photograph saw."""
    colours: bool = True
    """Colour the vertices as the field is seen along its normals."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""


def run(options: MeshOptions) -> int:
    """Write the mesh and say what it is.

    Raises:
        InputError: for a missing or damaged checkpoint, an empty field, a forward-facing scene, or a place that is not
            writable.
    """
    from gridreg.cli.runs import folder_of
    from gridreg.errors import InputError
    from gridreg.export import write_mesh
    from gridreg.export.crop_box import load_crop
    from gridreg.training import load_run

    loaded = load_run(options.checkpoint, choose_device(options.device))
    if loaded.warp is not None:
        raise InputError(
            f"{options.checkpoint}: a forward-facing scene, whose field is not in world coordinates; "
            "expected one with cameras around it"
        )
    crop = load_crop(options.crop) if options.crop else None
    target = options.out if options.out is not None else folder_of(options.checkpoint) / "mesh.ply"
    mesh = write_mesh(
        loaded.field,
        target,
        loaded.occupancy,
        resolution=options.resolution,
        faces=options.faces,
        texture=options.texture,
        crop=crop,
        base=None if options.base is None else options.base / 1000,
        world=loaded.world,
        threshold=options.threshold,
        min_component=options.min_component,
        colours=options.colours,
        cameras=loaded.cameras,
    )
    closed = "watertight" if mesh.watertight else "not watertight"
    print(
        f"{target}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {closed}, "
        f"volume {mesh.volume:.4g} cubic world units, cut at density {mesh.threshold:.4g} per world unit; "
        f"size {mesh.size}"
    )
    return 0
