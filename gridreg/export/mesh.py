"""A triangle mesh from a field: extraction and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree  # type: ignore[import-untyped]
from torch import Tensor

from gridreg.errors import InputError
from gridreg.export.decimation import decimate
from gridreg.export.marching import Faces, Vertices, drop_small_components, polygonise, vertex_normals
from gridreg.export.unseen import fill_unseen
from gridreg.export.volume import SeenDensity, sample_density, surface_threshold
from gridreg.machine import check_memory
from gridreg.rendering import Camera, Field, OccupancyGrid
from gridreg.segments import optical_depth_to_weights

Colours = NDArray[np.uint8]

_FILLED = 0.25
"""How far filled a vertex is whose colour no camera sees; the border of what is filled is at 1/2."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in world coordinates.

    Args:
        vertices: ``(V, 3)`` float64, world units.
        faces: ``(F, 3)`` int64 vertex numbers, counterclockwise seen from outside.
        colours: ``(V, 3)`` uint8 sRGB, or None.
        threshold: density per world unit at which it was cut out of a field; None for a mesh from a file.
        metric: whether the world unit is known to be the metre.
        places: ``(V, 2)`` of the vertices in ``texture``, from its lower left corner, in its widths and heights; or
            None.
        texture: ``(H, W, 3)`` uint8 sRGB, upper row first, or None.
    """

    vertices: Vertices
    faces: Faces
    colours: Colours | None = None
    threshold: float | None = None
    metric: bool = False
    places: Vertices | None = None
    texture: Colours | None = None

    def reduced(self, faces: int) -> Mesh:
        """The same mesh with at most so many faces, each vertex in the colour of the nearest one of before."""
        if len(self.faces) <= faces:
            return self
        vertices, triangles, nearest = decimate(self.vertices, self.faces, faces)
        colours = None if self.colours is None else self.colours[nearest]
        return replace(self, vertices=vertices, faces=triangles, colours=colours)

    @property
    def size(self) -> str:
        """Edges of its bounding box in words: millimetres where the unit is the metre, else units of the files."""
        edges = np.ptp(self.vertices, axis=0) * (1000 if self.metric else 1)
        return " x ".join(f"{edge:.4g}" for edge in edges) + (
            " mm" if self.metric else " units of the scene's files, whose length is not known"
        )

    @property
    def corners(self) -> Vertices:
        """Corners of every face ``(F, 3, 3)``, world units."""
        return np.asarray(self.vertices[self.faces])

    @property
    def volume(self) -> float:
        """Signed volume, cubic world units: positive when the faces of a closed mesh look outward.

        Example:
            >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
            >>> tetrahedron = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
            >>> round(6 * tetrahedron.volume, 12)
            1.0
        """
        return float(self.to_trimesh().volume)

    @property
    def watertight(self) -> bool:
        """True if every edge joins exactly two faces, which run along it in opposite directions."""
        mesh = self.to_trimesh()
        if self.places is not None:
            # A texture's seams have every vertex twice.
            mesh.merge_vertices()
        return bool(mesh.is_watertight and mesh.is_winding_consistent)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return the same mesh for the trimesh library; nothing is merged or reordered."""
        return trimesh.Trimesh(self.vertices, self.faces, vertex_colors=self.colours, process=False)


def extract_mesh(
    field: Field,
    occupancy: OccupancyGrid | None = None,
    *,
    resolution: int = 256,
    threshold: float | None = None,
    bounds: Tensor | None = None,
    colours: bool = True,
    min_component: float = 0.01,
    fill_cavities: bool = True,
    cameras: Sequence[Camera] = (),
    standing: bool = False,
    refine: int = 8,
    chunk: int = 1 << 18,
) -> Mesh:
    """Cut the surface of a field out of its density.

    The surface is closed, also where the box cuts through something, and its faces look outward.

    Args:
        field: the field; what is attached to it counts.
        occupancy: density counts only in occupied cells, as in renders; None: everywhere.
        resolution: lattice nodes along the longest edge of the box. Memory grows with its cube: about 20
            bytes per node, 350 MB at 256; 36 with cameras.
        threshold: density per world unit at the surface; None: from the field, see
            `gridreg.export.volume.surface_threshold`.
        bounds: ``(2, 3)`` box to look in, world units; None: that of the field.
        colours: whether to colour the vertices, as the field is seen along the inward normal.
        min_component: parts with less surface than this fraction of that of the largest part are dropped.
        fill_cavities: leave out surfaces that cannot be reached from outside. What a field holds inside a
            solid was never seen by any camera.
        cameras: that the field was trained on. Where they see nothing within the hull of their silhouettes, as under
            an object on a table, it is solid, in the colour of the nearest surface that they see; none, or no hull: as
            the field has it.
        standing: whether the object is known to stand on the lower face (z) of the box, so that it reaches down to it.
        refine: bisection steps that move the vertices onto the level set.
        chunk: positions evaluated at once.

    Raises:
        InputError: for an empty field, a threshold that nothing exceeds, or arguments out of range.
    """
    if threshold is not None and not 0 < threshold < float("inf"):
        raise InputError(f"threshold={threshold}: expected a density per world unit above 0")
    if not 0 <= min_component <= 1:
        raise InputError(f"min_component={min_component}: expected a fraction in [0, 1]")
    if refine < 0:
        raise InputError(f"refine={refine}: expected a number of bisection steps, at least 0")
    box = field.bounds if bounds is None else bounds.to(field.bounds)
    edges = (box[1] - box[0]).double()
    nodes = resolution**3 * float((edges / edges.max()).prod())
    check_memory(
        (36 if len(cameras) else 20) * nodes, f"resolution={resolution}: a lattice of {nodes:.3g} nodes"
    )
    density = SeenDensity(field, occupancy, chunk)
    volume = sample_density(density, box, resolution)
    level = surface_threshold(volume) if threshold is None else threshold
    filled = None
    if len(cameras) and occupancy is not None and occupancy.hull is not None:
        filled = fill_unseen(volume, level, cameras, occupancy, standing=standing)
        np.maximum(volume.values, 2 * level * filled.values, out=volume.values)

    def inside_box(positions: Vertices) -> NDArray[np.float32]:
        x = torch.from_numpy(positions).to(box)
        outside = ((x < box[0]) | (x > box[1])).any(dim=-1).cpu().numpy()
        found = density(x).cpu().numpy()
        if filled is not None:
            found = np.maximum(found, 2 * level * filled.at(positions))
        return np.where(outside, np.float32(0), found)

    vertices, faces = polygonise(volume, level, inside_box, refine=refine, fill_cavities=fill_cavities)
    if not len(faces):
        raise InputError(
            f"threshold={level:.6g}: the largest density in the box is {float(volume.values.max()):.6g} "
            "per world unit, expected a threshold below it"
        )
    vertices, faces = drop_small_components(vertices, faces, min_component)
    seen = None
    if colours:
        depth = float(volume.spacing.mean())
        seen = seen_colours(field, density, vertices, vertex_normals(vertices, faces), depth, chunk)
        if filled is not None:
            seen = _spread(seen, vertices, filled.at(vertices) < _FILLED)
    return Mesh(vertices, faces, seen, level)


def _spread(colours: Colours, vertices: Vertices, known: NDArray[np.bool_]) -> Colours:
    """Give vertices whose colour is not known that of the nearest one whose is."""
    if known.all() or not known.any():
        return colours
    found: Colours = colours.copy()
    found[~known] = colours[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return found


@torch.no_grad()
def seen_colours(
    field: Field,
    density: SeenDensity,
    vertices: Vertices,
    normals: Vertices,
    depth: float,
    chunk: int = 1 << 18,
) -> Colours:
    """Colours along a short ray through each vertex, from one lattice cell ``depth`` outside to three inside.

    A surface has a thickness: the colour right at the level set, in front of what the training pixels were
    made of, is hardly trained. The ray is composited as in renders and divided by its opacity.
    """
    steps = torch.arange(8, dtype=field.bounds.dtype, device=field.bounds.device) * 0.5 - 0.75
    result = np.empty((len(vertices), 3), dtype=np.uint8)
    count = max(1, chunk // len(steps))
    for start in range(0, len(vertices), count):
        part = slice(start, start + count)
        x = torch.from_numpy(vertices[part]).to(field.bounds)
        inward = -torch.from_numpy(normals[part]).to(field.bounds)
        positions = x[:, None] + steps[:, None] * depth * inward[:, None]
        sigma = density(positions.reshape(-1, 3)).reshape(len(x), len(steps))
        offsets = torch.arange(len(x) + 1, device=x.device) * len(steps)
        weights = optical_depth_to_weights((sigma * (0.5 * depth)).flatten(), offsets).view(sigma.shape)
        # Where nothing stops the ray (a corner of the box), the vertex itself decides.
        blank = weights.sum(dim=1) < 1e-6
        weights = weights / weights.sum(dim=1, keepdim=True).clamp(min=1e-6)
        ray, sample = (weights > 1e-3).nonzero(as_tuple=True)
        seen = field.colour(positions[ray, sample], inward[ray]) * weights[ray, sample][:, None]
        total = torch.zeros_like(x).index_add(0, ray, seen.to(x.dtype))
        total[blank] = field.colour(x[blank], inward[blank]).to(x.dtype)
        result[part] = (total.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return result
