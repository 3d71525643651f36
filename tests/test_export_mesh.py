"""Meshes cut from fields of known geometry: closed, outward, in place, in every format."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export.mesh import extract_mesh
from gridreg.rendering import OccupancyGrid
from tests.export_fields import AnalyticField, ball, torus, union
from tests.export_meshes import assert_closed, radii


@pytest.mark.parametrize("density", [1.5, 30.0, 1e4])
def test_ball_of_any_density_has_its_radius_and_volume(density):
    mesh = extract_mesh(AnalyticField(ball(0.6, density)), resolution=41)
    assert_closed(mesh)
    assert mesh.threshold == pytest.approx(density / 2)
    assert np.abs(radii(mesh) - 0.6).max() < 0.05 * 0.05  # 5 % of a lattice cell
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=5e-3)
    assert mesh.to_trimesh().euler_number == 2


def test_refinement_takes_vertices_from_within_a_cell_onto_the_surface():
    field = AnalyticField(ball(0.6))
    coarse = np.abs(radii(extract_mesh(field, resolution=41, refine=0)) - 0.6)
    fine = np.abs(radii(extract_mesh(field, resolution=41)) - 0.6)
    assert coarse.max() < 0.05
    assert fine.mean() < 0.05 * coarse.mean()


def test_torus_keeps_its_hole():
    mesh = extract_mesh(AnalyticField(torus(0.6, 0.2)), resolution=49)
    assert_closed(mesh)
    assert mesh.to_trimesh().euler_number == 0
    assert mesh.volume == pytest.approx(2 * math.pi**2 * 0.6 * 0.2**2, rel=2e-2)


def test_what_the_box_cuts_is_closed_at_its_faces():
    mesh = extract_mesh(AnalyticField(ball(0.8, centre=(1.0, 1.0, 1.0))), resolution=41)
    assert_closed(mesh)
    assert mesh.vertices.max() == pytest.approx(1.0, abs=1e-9)
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.8**3 / 8, rel=1e-2)


def test_field_that_fills_its_box_gives_the_box():
    mesh = extract_mesh(
        AnalyticField(lambda x: torch.full((len(x),), 50.0), half=(1.0, 0.5, 0.25)), resolution=17
    )
    assert_closed(mesh)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-1, -0.5, -0.25], atol=1e-9)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [1, 0.5, 0.25], atol=1e-9)
    # Marching cubes bevels edges by at most a cell.
    assert mesh.volume == pytest.approx(1.0, rel=2e-2)


def test_world_coordinates_of_a_box_off_the_origin():
    field = AnalyticField(ball(0.5, centre=(10.0, -4.0, 2.0)))
    field.bounds = torch.tensor([[9.2, -4.9, 1.0], [10.9, -3.1, 2.7]])
    mesh = extract_mesh(field, resolution=33)
    assert_closed(mesh)
    distance = np.linalg.norm(mesh.vertices - np.array([10.0, -4.0, 2.0]), axis=1)
    assert np.abs(distance - 0.5).max() < 5e-3


def test_bounds_look_at_a_part_of_the_box_or_past_it():
    field = AnalyticField(union(ball(0.3, centre=(-0.5, 0.0, 0.0)), ball(0.3, centre=(0.5, 0.0, 0.0))))
    right = extract_mesh(field, resolution=33, bounds=torch.tensor([[0.1, -0.4, -0.4], [0.9, 0.4, 0.4]]))
    assert_closed(right)
    assert right.vertices[:, 0].min() > 0.19
    wide = extract_mesh(field, resolution=49, bounds=torch.tensor([[-2.0, -2, -2], [2.0, 2, 2]]))
    assert wide.volume == pytest.approx(2 * right.volume, rel=0.05)
    with pytest.raises(InputError, match="no ray"):
        extract_mesh(field, resolution=17, bounds=torch.tensor([[-0.1, 0.5, 0.5], [0.1, 0.9, 0.9]]))


def test_cavities_and_what_is_in_them_are_left_out_unless_wanted():
    hollow = union(
        lambda x: 500.0 * ((x.norm(dim=-1) < 0.8) & (x.norm(dim=-1) > 0.6)).float(), ball(0.3, 500.0)
    )
    field = AnalyticField(hollow)
    outer = extract_mesh(field, resolution=41)
    assert_closed(outer)
    assert radii(outer).min() > 0.79
    full = extract_mesh(field, resolution=41, fill_cavities=False)
    assert_closed(full)
    assert radii(full).min() < 0.31
    shell = 4 / 3 * math.pi * (0.8**3 - 0.6**3 + 0.3**3)
    assert full.volume == pytest.approx(shell, rel=2e-2)


def test_small_parts_are_dropped_and_large_ones_kept():
    parts = union(ball(0.5), ball(0.05, centre=(0.8, 0.0, 0.0)), ball(0.2, centre=(0.0, 0.0, 0.8)))
    field = AnalyticField(parts)
    counts = {}
    for share in (0.0, 0.02, 0.5):
        mesh = extract_mesh(field, resolution=49, min_component=share)
        assert_closed(mesh)
        counts[share] = mesh.to_trimesh().body_count
    assert counts == {0.0: 3, 0.02: 2, 0.5: 1}


def test_occupancy_counts_as_in_renders():
    field = AnalyticField(union(ball(0.3, centre=(-0.5, 0.0, 0.0)), ball(0.3, centre=(0.5, 0.0, 0.0))))
    cells = torch.ones(8, 8, 8, dtype=torch.uint8)
    cells[:4] = 0
    mesh = extract_mesh(field, OccupancyGrid(field.bounds, cells), resolution=33)
    assert_closed(mesh)
    assert mesh.vertices[:, 0].min() > 0.19


def test_density_is_evaluated_in_chunks_that_change_nothing():
    field = AnalyticField(torus(0.6, 0.2))
    whole = extract_mesh(field, resolution=25)
    field.largest_batch = 0
    parts = extract_mesh(field, resolution=25, chunk=500)
    assert 0 < field.largest_batch <= 500
    np.testing.assert_array_equal(whole.vertices, parts.vertices)
    np.testing.assert_array_equal(whole.faces, parts.faces)
    np.testing.assert_array_equal(whole.colours, parts.colours)


def test_colours_are_those_of_the_surface():
    mesh = extract_mesh(AnalyticField(ball(0.6)), resolution=33)
    expected = (mesh.vertices + 1) / 2 * 255
    # Dense: the ray stops within its first samples, at most one lattice cell below.
    assert np.abs(mesh.colours - expected).max() < 255 / 2 * (2 / 32) + 1


def test_colours_are_seen_along_the_inward_normal():
    mesh = extract_mesh(AnalyticField(ball(0.6), colour=lambda x, d: (1 + d) / 2), resolution=33)
    outward = mesh.vertices / radii(mesh)[:, None]
    # The normal of a coarse mesh is off by some degrees.
    assert np.abs(mesh.colours / 127.5 - 1 + outward).max() < 0.2


def test_colours_come_from_the_layer_that_is_seen_not_from_the_skin():
    red, blue = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1.0])

    def colour(x: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        return torch.where((x.norm(dim=-1) > 0.585)[:, None], blue, red)

    def density(x: torch.Tensor) -> torch.Tensor:
        r = x.norm(dim=-1)
        return 3.0 * (r < 0.6).float() + 500.0 * (r < 0.57).float()

    mesh = extract_mesh(AnalyticField(density, colour=colour), resolution=65, threshold=2.0)
    assert radii(mesh).mean() == pytest.approx(0.6, abs=2e-3)
    assert mesh.colours[:, 0].mean() > 200
    assert extract_mesh(AnalyticField(density), resolution=17, colours=False).colours is None
