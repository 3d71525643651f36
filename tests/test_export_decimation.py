"""A closed mesh stays one when it has fewer faces, whatever the library that collapses its edges leaves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from gridreg.errors import InputError
from gridreg.export.decimation import decimate
from gridreg.export.marching import polygonise
from gridreg.export.mesh import Mesh
from gridreg.export.mesh_files import read_mesh, save_mesh
from gridreg.export.volume import DensityVolume


def sponge_of(seed: int) -> Mesh:
    """A closed surface full of thin bridges and small holes."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(28, 28, 28)), 1.5)
    volume = DensityVolume((noise + 0.1).clip(1e-3).astype(np.float32), np.zeros(3), np.ones(3))
    return Mesh(*polygonise(volume, 0.13))


@pytest.fixture(scope="module", params=[0, 1, 2])
def sponge(request) -> Mesh:
    return sponge_of(request.param)


def faces_of_edges(mesh: Mesh) -> set[int]:
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return set(np.unique(edges, axis=0, return_counts=True)[1].tolist())


@pytest.mark.parametrize("faces", [200, 600, 2000])
def test_every_edge_keeps_two_faces(sponge, faces):
    assert faces_of_edges(sponge) == {2}
    plain = sponge.to_trimesh().simplify_quadric_decimation(face_count=faces)
    mesh = sponge.reduced(faces)
    assert len(mesh.faces) <= faces
    assert faces_of_edges(mesh) == {2}
    assert mesh.watertight
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert mesh.volume == pytest.approx(plain.volume, rel=0.005)


def test_the_library_alone_would_not_do():
    """Otherwise the tests above would show nothing."""
    plain = sponge_of(0).to_trimesh().simplify_quadric_decimation(face_count=600)
    assert 4 in faces_of_edges(Mesh(np.asarray(plain.vertices), np.asarray(plain.faces)))


def test_it_stays_closed_in_a_file_whose_corners_are_merged(sponge, tmp_path):
    save_mesh(sponge.reduced(600), tmp_path / "a.stl")
    assert read_mesh(tmp_path / "a.stl").watertight


def test_two_boxes_that_share_an_edge_are_taken_apart():
    first = trimesh.creation.box((1, 1, 1))
    second = first.copy()
    second.apply_translation((1, 1, 0))
    both = trimesh.util.concatenate([first, second])
    both.merge_vertices()
    faces = np.asarray(both.faces, dtype=np.int64)
    assert faces_of_edges(Mesh(both.vertices, faces)) == {2, 4}
    # As many faces as there are: nothing is to be collapsed.
    vertices, kept, nearest = decimate(np.asarray(both.vertices), faces, len(faces))
    mesh = Mesh(vertices, kept)
    assert faces_of_edges(mesh) == {2}
    assert mesh.to_trimesh().body_count == 2
    assert mesh.volume == pytest.approx(2, rel=0.005)
    np.testing.assert_allclose(vertices, both.vertices[nearest], atol=2e-3)


def test_an_open_mesh_keeps_its_rim():
    sphere = trimesh.creation.icosphere(4)
    faces = np.asarray(sphere.faces, dtype=np.int64)[sphere.triangles_center[:, 2] > 0.1]
    vertices, kept, _ = decimate(np.asarray(sphere.vertices), faces, 300)
    mesh = trimesh.Trimesh(vertices, kept, process=False)
    assert len(kept) <= 300
    assert mesh.body_count == 1
    assert faces_of_edges(Mesh(vertices, kept)) == {1, 2}
    assert mesh.area == pytest.approx(sphere.submesh([sphere.triangles_center[:, 2] > 0.1])[0].area, rel=0.05)


def test_too_few_faces_for_any_shape_are_refused():
    ring = trimesh.creation.torus(1, 0.2)
    with pytest.raises(InputError, match="faces=4: so few leave nothing of the shape, expected more"):
        decimate(np.asarray(ring.vertices), np.asarray(ring.faces, dtype=np.int64), 4)
