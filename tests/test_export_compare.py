"""Distances between meshes of known shape, in closed form and against trimesh."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.export.compare import _to_triangles, compare_meshes, sample_surface
from gridreg.export.mesh import Mesh, extract_mesh
from tests.export_fields import AnalyticField, ball


def of_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def sphere(radius: float = 1.0, subdivisions: int = 3) -> Mesh:
    return of_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def square(edge: float = 1.0, height: float = 0.0) -> Mesh:
    """A square in the x-y plane, two triangles."""
    corners = np.array([[0.0, 0, height], [edge, 0, height], [edge, edge, height], [0, edge, height]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_a_mesh_is_itself():
    mesh = sphere()
    found = compare_meshes(mesh, mesh, samples=2000)
    assert found.chamfer < 1e-12
    assert (found.precision, found.recall, found.f_score) == (1.0, 1.0, 1.0)
    assert found.normal_consistency == pytest.approx(1.0, abs=1e-3)
    assert found.diagonal == pytest.approx(2 * math.sqrt(3), rel=1e-2)
    assert found.threshold == pytest.approx(0.01 * found.diagonal)


@given(radius=st.floats(0.5, 1.5), scale=st.floats(0.01, 100.0))
@settings(max_examples=8)
def test_concentric_spheres_are_as_far_apart_as_their_radii(radius, scale):
    found = compare_meshes(sphere(radius * scale), sphere(scale), samples=1000, threshold=0.2 * scale)
    gap = abs(radius - 1)
    # The facets of both lie up to 0.7 % of a radius inside.
    assert found.accuracy == pytest.approx(gap * scale, abs=1e-2 * scale)
    assert found.completeness == pytest.approx(gap * scale, abs=1e-2 * scale)
    assert found.chamfer_relative == pytest.approx(gap / (2 * math.sqrt(3)), abs=3e-3)
    assert found.normal_consistency > 0.99
    if abs(gap - 0.2) > 0.02:
        assert found.f_score == (1.0 if gap < 0.2 else 0.0)


def test_parallel_squares():
    found = compare_meshes(square(height=0.25), square(), samples=500)
    assert found.accuracy == pytest.approx(0.25)
    assert found.completeness == pytest.approx(0.25)
    assert found.normal_consistency == pytest.approx(1.0)
    assert found.f_score == 0.0


def test_half_of_the_truth_is_precise_but_not_complete():
    whole, half = square(2.0), square(1.0)
    found = compare_meshes(half, whole, samples=20_000, threshold=0.1)
    assert found.accuracy < 1e-12
    assert found.precision == 1.0
    # A quarter is covered, and a strip of 0.1 around it: 2 x 0.1 + a quarter of a circle of radius 0.1.
    assert found.recall == pytest.approx((1 + 0.2 + math.pi * 0.01 / 4) / 4, abs=0.01)
    assert found.f_score == pytest.approx(2 * found.recall / (1 + found.recall))
    # Two strips at a mean distance of 1/2, and a corner square at the mean distance from its corner.
    corner = (math.sqrt(2) + math.asinh(1)) / 3
    assert found.completeness == pytest.approx((2 * 0.5 + corner) / 4, rel=0.02)


def test_squares_at_right_angles_have_normals_at_right_angles():
    flat = square()
    upright = Mesh(flat.vertices[:, [0, 2, 1]] + [0, 0, 0.01], flat.faces)
    assert compare_meshes(upright, flat, samples=300).normal_consistency == pytest.approx(0.0, abs=1e-9)
    turned = Mesh(flat.vertices, flat.faces[:, ::-1])
    assert compare_meshes(turned, flat, samples=300).normal_consistency == pytest.approx(1.0)


def test_distances_are_those_of_an_exhaustive_search():
    a, b = sphere(1.0, 1), of_trimesh(trimesh.creation.box((1.5, 1.0, 1.2)))
    generator = torch.Generator().manual_seed(3)
    found = compare_meshes(a, b, samples=400, generator=generator)
    points, _ = sample_surface(a, 400, torch.Generator().manual_seed(3))
    every = np.stack(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(np.repeat(t[None], len(points), 0), points) - points, axis=1
            )
            for t in b.vertices[b.faces]
        ]
    )
    assert found.accuracy == pytest.approx(every.min(axis=0).mean(), rel=1e-3)


@given(seed=st.integers(0, 10_000), scale=st.sampled_from([1e-4, 1.0, 1e4]))
def test_distance_to_triangles_is_that_of_trimesh(seed, scale):
    rng = np.random.default_rng(seed)
    triangles, points = rng.normal(size=(60, 3, 3)), 2 * rng.normal(size=(60, 3))
    expected = np.linalg.norm(trimesh.triangles.closest_point(triangles, points) - points, axis=1)
    np.testing.assert_allclose(_to_triangles(scale * points, scale * triangles), scale * expected, rtol=1e-6)


def test_distance_to_triangles_without_area():
    point, segment = np.zeros((2, 3)), np.zeros((2, 3, 3))
    segment[0] = [[1, -1, 0], [1, 1, 0], [1, 3, 0]]
    segment[1] = [[0, 0, 2], [0, 0, 2], [0, 0, 2]]
    np.testing.assert_allclose(_to_triangles(point, segment), [1, 2])


def test_extracted_ball_is_on_the_true_sphere():
    mesh = extract_mesh(AnalyticField(ball(0.6)), resolution=49, colours=False)
    found = compare_meshes(mesh, sphere(0.6, 5), samples=5000)
    assert found.chamfer_relative < 1e-3
    assert found.f_score == 1.0


def test_points_are_spread_evenly_by_area():
    # Areas 1 and 3: a fan of two triangles.
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [-3, 0, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    points, faces = sample_surface(mesh, 40_000, torch.Generator().manual_seed(0))
    assert (faces == 0).mean() == pytest.approx(0.25, abs=0.01)
    np.testing.assert_allclose(points[faces == 0].mean(axis=0), [1 / 3, 2 / 3, 0], atol=0.02)
    inside = points[faces == 0]
    assert (inside[:, 0] + inside[:, 1] / 2 <= 1 + 1e-12).all()
    np.testing.assert_allclose(inside[:, 0].var(), 1 / 18, rtol=0.05)


def test_same_seed_same_figures():
    a, b = sphere(1.0, 2), sphere(0.9, 2)
    assert compare_meshes(a, b, samples=100) == compare_meshes(a, b, samples=100)
    other = compare_meshes(a, b, samples=100, generator=torch.Generator().manual_seed(1))
    assert other != compare_meshes(a, b, samples=100)


def test_faces_without_area_and_loose_vertices_do_no_harm():
    mesh = sphere(1.0, 3)
    vertices = np.concatenate([mesh.vertices, [[50.0, 50, 50]]])
    faces = np.concatenate([mesh.faces, [[0, 0, 1]]])
    found = compare_meshes(mesh, Mesh(vertices, faces), samples=500)
    assert found.chamfer < 1e-12
    assert found.diagonal == pytest.approx(2 * math.sqrt(3), rel=1e-2)


def test_figures_as_data_and_text():
    found = compare_meshes(sphere(1.01, 2), sphere(1.0, 2), samples=200)
    data = json.loads(json.dumps(found.to_dict()))
    assert data["f_score"] == 1.0
    assert data["chamfer"] == found.chamfer
    text = str(found)
    assert len(text.splitlines()) == 6
    assert f"{found.chamfer_relative:.3%} of the box diagonal" in text


def test_bad_input():
    empty = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64))
    flat = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for broken in (empty, flat):
        for pair in ((broken, sphere(1.0, 1)), (sphere(1.0, 1), broken)):
            with pytest.raises(InputError, match="without area"):
                compare_meshes(*pair, samples=10)
    for options in ({"samples": 0}, {"threshold": 0.0}, {"threshold": math.nan}):
        with pytest.raises(InputError, match=next(iter(options))):
            compare_meshes(sphere(1.0, 1), sphere(1.0, 1), **{"samples": 10, **options})
