"""Distances of a mesh to the true one: Chamfer distance, F-score, normal consistency."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
import trimesh.sample
from numpy.typing import NDArray
from scipy.spatial import KDTree  # type: ignore[import-untyped]

from gridreg.errors import InputError
from gridreg.export.mesh import Mesh
from gridreg.machine import check_memory

Points = NDArray[np.float64]

# Triangles tried for each point: those of the nearest marks on the other surface.
_CANDIDATES = 10


@dataclass(frozen=True)
class MeshComparison:
    """Figures of a mesh against the true one.

    Attributes:
        chamfer: mean of accuracy and completeness, world units.
        accuracy: mean distance from the mesh to the truth, world units.
        completeness: mean distance from the truth to the mesh, world units.
        precision: fraction of the mesh within ``threshold`` of the truth.
        recall: fraction of the truth within ``threshold`` of the mesh.
        f_score: harmonic mean of both (Knapitsch et al., Tanks and Temples, 2017).
        normal_consistency: mean absolute cosine between the normals of a point and of the point nearest to it
            on the other surface, over both directions (Mescheder et al., Occupancy Networks, 2019).
        threshold: of precision and recall, world units.
        diagonal: of the truth's bounding box, world units.
        chamfer_relative: chamfer over the diagonal.
        accuracy_relative: likewise.
        completeness_relative: likewise.
    """

    chamfer: float
    accuracy: float
    completeness: float
    precision: float
    recall: float
    f_score: float
    normal_consistency: float
    threshold: float
    diagonal: float
    chamfer_relative: float
    accuracy_relative: float
    completeness_relative: float

    def to_dict(self) -> dict[str, float]:
        """The figures by name, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        """Six lines for a terminal."""
        fraction = self.threshold / self.diagonal
        return "\n".join(
            [
                f"Chamfer distance    {self.chamfer:.5g} ({self.chamfer_relative:.3%} of the box diagonal)",
                f"  mesh to truth     {self.accuracy:.5g} ({self.accuracy_relative:.3%})",
                f"  truth to mesh     {self.completeness:.5g} ({self.completeness_relative:.3%})",
                f"F-score             {self.f_score:.4f} within {self.threshold:.4g} ({fraction:.2%})",
                f"  precision, recall {self.precision:.4f}, {self.recall:.4f}",
                f"Normal consistency  {self.normal_consistency:.4f}",
            ]
        )


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> tuple[Points, NDArray[np.int64]]:
    """Return points spread evenly by area over a mesh, and the face of each.

    Args:
        mesh: with some area.
        count: number of points.
        generator: of the random numbers.

    Returns:
        Positions ``(count, 3)`` in world units, faces ``(count,)``.

    Raises:
        InputError: for less than one point, or a mesh without area.
    """
    if count < 1:
        raise InputError(f"samples={count}: expected at least 1 point")
    check_memory(200 * count, f"samples={count}")
    area = float(mesh.to_trimesh().area) if len(mesh.faces) else 0.0
    if not 0 < area < np.inf:
        raise InputError(f"mesh: found {len(mesh.faces)} faces without area, expected a surface")
    seed = int(torch.randint(1 << 31, (), generator=generator))
    points, faces = trimesh.sample.sample_surface(mesh.to_trimesh(), count, seed=seed)
    return np.asarray(points), np.asarray(faces, dtype=np.int64)


def _unit_normals(mesh: Mesh) -> Points:
    """Return the normals ``(F, 3)`` of the faces; zero for a face without area."""
    a, b, c = (mesh.corners[:, k] for k in range(3))
    crosses = np.cross(b - a, c - a)
    length = np.linalg.norm(crosses, axis=1, keepdims=True)
    return np.asarray(crosses / np.maximum(length, np.finfo(np.float64).tiny))


def _to_triangles(points: Points, corners: Points) -> Points:
    """Return the distance ``(N,)`` of each point ``(N, 3)`` to its own triangle ``(N, 3, 3)``, at any scale.

    trimesh's ``closest_point`` calls short edges zero, so it is off for small objects.
    """
    tiny = np.finfo(np.float64).tiny
    following = np.roll(corners, -1, axis=1)
    edges, away = following - corners, points[:, None] - corners
    along = (away * edges).sum(axis=-1) / np.maximum((edges * edges).sum(axis=-1), tiny)
    to_edges = np.linalg.norm(away - np.clip(along, 0, 1)[..., None] * edges, axis=-1).min(axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=-1)
    above = (np.cross(edges, away) * normal[:, None]).sum(axis=-1) >= 0
    to_plane = np.abs((away[:, 0] * normal).sum(axis=-1)) / np.maximum(length, tiny)
    found: Points = np.where(above.all(axis=1) & (length > 0), to_plane, to_edges)
    return found


def _nearest(
    points: Points, mesh: Mesh, samples: Points, faces: NDArray[np.int64]
) -> tuple[Points, NDArray[np.int64]]:
    """Return the distance ``(N,)`` of points to a mesh, and the nearest face of each.

    The distance to the nearest sample alone would be too large by about half the spacing of the samples. So
    samples (large triangles have many) and centroids (small ones may have no sample) only mark the triangles
    to be measured.
    """
    marks = np.concatenate([samples, mesh.corners.mean(axis=1)])
    faces = np.concatenate([faces, np.arange(len(mesh.faces))])
    _, near = KDTree(marks).query(points, k=[*range(1, min(_CANDIDATES, len(marks)) + 1)])
    best = np.full(len(points), np.inf)
    face = np.zeros(len(points), np.int64)
    for candidate in faces[near].T:
        distance = _to_triangles(points, mesh.corners[candidate])
        closer = distance < best
        best, face = np.where(closer, distance, best), np.where(closer, candidate, face)
    return best, face


def compare_meshes(
    mesh: Mesh,
    truth: Mesh,
    *,
    threshold: float | None = None,
    samples: int = 50_000,
    generator: torch.Generator | None = None,
) -> MeshComparison:
    """Compare a mesh with the true one.

    Points are drawn evenly by area from both surfaces; each gets its distance to the other surface (to
    triangles, not to the other's samples) and the angle between both normals.

    Args:
        mesh: the reconstruction.
        truth: what it should be, in the same coordinates.
        threshold: for the F-score, world units; None: 1 % of the diagonal of the truth's bounding box.
        samples: points drawn from each surface; the figures scatter by about their spread over the root of
            this.
        generator: of the points; None: one seeded with 0.

    Raises:
        InputError: for a mesh without area or arguments out of range.
    """
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    used = truth.vertices[np.unique(truth.faces)] if len(truth.faces) else np.zeros((1, 3))
    diagonal = float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))
    threshold = 0.01 * diagonal if threshold is None else threshold
    points, faces = sample_surface(mesh, samples, generator)
    true_points, true_faces = sample_surface(truth, samples, generator)
    if not 0 < threshold < np.inf:
        raise InputError(f"threshold={threshold}: expected a distance in world units above 0")
    to_truth, nearest_true = _nearest(points, truth, true_points, true_faces)
    to_mesh, nearest = _nearest(true_points, mesh, points, faces)
    normals, true_normals = _unit_normals(mesh), _unit_normals(truth)
    cosines = [
        np.abs((normals[faces] * true_normals[nearest_true]).sum(axis=1)).mean(),
        np.abs((true_normals[true_faces] * normals[nearest]).sum(axis=1)).mean(),
    ]
    accuracy, completeness = float(to_truth.mean()), float(to_mesh.mean())
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    chamfer = (accuracy + completeness) / 2
    return MeshComparison(
        chamfer=chamfer,
        accuracy=accuracy,
        completeness=completeness,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        normal_consistency=float(np.mean(cosines)),
        threshold=threshold,
        diagonal=diagonal,
        chamfer_relative=chamfer / diagonal,
        accuracy_relative=accuracy / diagonal,
        completeness_relative=completeness / diagonal,
    )
