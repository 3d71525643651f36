"""Marching cubes on any volume, and what is done to its triangles."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from gridreg.export.marching import drop_small_components, polygonise, vertex_normals
from gridreg.export.mesh import Mesh
from gridreg.export.volume import DensityVolume, SeenDensity, lattice_nodes, sample_density
from tests.export_fields import AnalyticField
from tests.export_meshes import assert_closed


@given(seed=st.integers(0, 2**16), fill=st.booleans(), share=st.floats(0.05, 0.95))
def test_any_volume_gives_a_closed_outward_surface(seed, fill, share):
    rng = np.random.default_rng(seed)
    values = rng.exponential(1.0, (5, 4, 6)).astype(np.float32)
    volume = DensityVolume(values, np.zeros(3), np.array([0.5, 0.4, 0.3]))
    threshold = float(np.quantile(values, share))
    vertices, faces = polygonise(volume, threshold, fill_cavities=fill)
    mesh = Mesh(vertices, faces)
    assert_closed(mesh)
    assert vertices.min() >= 0
    assert (vertices.max(axis=0) <= np.array([2.0, 1.2, 1.5]) + 1e-12).all()


def test_values_right_on_the_threshold_do_not_make_faces_collapse():
    values = np.zeros((5, 5, 5), np.float32)
    values[1:4, 1:4, 1:4] = 1.0
    vertices, faces = polygonise(DensityVolume(values, np.zeros(3), np.ones(3)), 1.0)
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert trimesh.triangles.area(vertices[faces]).min() > 1e-6


def test_lattice_is_nearly_cubic_and_touches_the_box():
    bounds = torch.tensor([[0.1, -0.7, 0.0], [1.3, 0.2, 0.35]])
    assert lattice_nodes(bounds, 13) == (13, 10, 5)
    field = AnalyticField(lambda x: x[:, 0] + 2 * x[:, 1] + 4 * x[:, 2] + 5)
    field.bounds = bounds
    volume = sample_density(SeenDensity(field), bounds, 13)
    i, j, k = np.meshgrid(*(np.arange(n) for n in (13, 10, 5)), indexing="ij")
    x, y, z = (volume.lower[a] + n * volume.spacing[a] for a, n in enumerate((i, j, k)))
    np.testing.assert_allclose(volume.values, x + 2 * y + 4 * z + 5, rtol=1e-5)


def test_vertex_normals_are_those_of_trimesh():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    ours = vertex_normals(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    np.testing.assert_allclose(ours, mesh.vertices, atol=3e-2)
    lonely = vertex_normals(np.eye(4, 3), np.array([[0, 1, 2]]))
    assert np.isfinite(lonely).all()


def test_dropping_parts_keeps_the_rest_as_it_is():
    big, small = trimesh.creation.box(), trimesh.creation.box((0.2, 0.2, 0.2))
    small.apply_translation((3, 0, 0))
    both = trimesh.util.concatenate([small, big])
    vertices, faces = drop_small_components(np.asarray(both.vertices), np.asarray(both.faces), 0.1)
    np.testing.assert_allclose(vertices, big.vertices)
    np.testing.assert_array_equal(faces, big.faces)


def test_watertight_tells_holes_and_flipped_faces():
    cube = trimesh.creation.box()
    vertices, faces = np.asarray(cube.vertices), np.asarray(cube.faces)
    assert Mesh(vertices, faces).watertight
    assert not Mesh(vertices, faces[1:]).watertight
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not Mesh(vertices, flipped).watertight
    assert Mesh(vertices, faces).volume == pytest.approx(1.0)
    assert Mesh(vertices, faces[:, ::-1]).volume == pytest.approx(-1.0)
