"""Meshes cut from fields of known geometry: closed, outward, in place, in every format."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.export.marching import drop_small_components, face_areas, polygonise, vertex_normals
from gridreg.export.mesh import Mesh, extract_mesh, read_mesh, save_mesh, write_mesh
from gridreg.export.volume import DensityVolume, SeenDensity, lattice_nodes, sample_density, surface_threshold
from gridreg.rendering import OccupancyGrid
from tests.export_fields import AnalyticField, ball, box, torus, union


def radii(mesh: Mesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices, axis=1)


def assert_closed(mesh: Mesh) -> None:
    assert mesh.watertight
    assert mesh.volume > 0
    # An implementation of our own would not notice its own mistakes.
    other = mesh.to_trimesh()
    assert other.is_watertight
    assert other.is_winding_consistent
    assert other.volume == pytest.approx(mesh.volume)


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


class TestThreshold:
    def volume(self, function, resolution=33):
        field = AnalyticField(function)
        return sample_density(SeenDensity(field), field.bounds, resolution)

    @pytest.mark.parametrize("resolution", [17, 33, 65])
    def test_half_of_a_homogeneous_solid_at_any_resolution(self, resolution):
        assert surface_threshold(self.volume(ball(0.7, 12.0), resolution)) == pytest.approx(6.0)

    def test_haze_does_not_move_it(self):
        solid = self.volume(ball(0.7, 200.0))
        hazy = self.volume(union(ball(0.7, 200.0), lambda x: torch.full((len(x),), 0.2)))
        assert surface_threshold(hazy) == pytest.approx(surface_threshold(solid))

    def test_follows_the_scale_of_the_density(self):
        def soft(x: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.softplus((0.6 - x.norm(dim=-1)) * 40)

        thresholds = [surface_threshold(self.volume(lambda x, k=k: k * soft(x))) for k in (5.0, 50.0)]
        assert thresholds[0] < thresholds[1]

    def test_surface_of_a_soft_solid_is_where_rays_see_it(self):
        def soft(x: torch.Tensor) -> torch.Tensor:
            return 200 * ((0.6 - x.norm(dim=-1)) / 0.1).clamp(0, 1)

        mesh = extract_mesh(AnalyticField(soft), resolution=65)
        # A ray to the centre has lost half of its light where 200 / 0.1 * depth^2 / 2 = log 2.
        seen = 0.6 - math.sqrt(2 * math.log(2) * 0.1 / 200)
        assert np.abs(radii(mesh) - seen).max() < 2 / 64

    def test_matches_a_plain_loop_over_rays(self):
        rng = np.random.default_rng(0)
        values = rng.exponential(2.0, (5, 6, 7)).astype(np.float32)
        volume = DensityVolume(values, np.zeros(3), np.array([0.3, 0.2, 0.1]))
        found = []
        for axis, spacing in enumerate(volume.spacing):
            for ray in np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis]):
                for line in (ray, ray[::-1]):
                    light = 1.0
                    for density in line:
                        light *= math.exp(-density * spacing)
                        if light <= 0.5:
                            found.append(density)
                            break
        assert surface_threshold(volume) == pytest.approx(np.median(found) / 2, rel=1e-6)

    def test_override(self):
        field = AnalyticField(lambda x: 100 * (1 - x.norm(dim=-1)).clamp(min=0))
        mesh = extract_mesh(field, resolution=33, threshold=60.0)
        assert mesh.threshold == 60.0
        assert np.abs(radii(mesh) - 0.4).max() < 1e-3


class TestBadInput:
    def test_empty_field(self):
        field = AnalyticField(lambda x: torch.full((len(x),), 1e-3))
        with pytest.raises(InputError, match=r"no ray along an axis of the box is more than 0\.00225 opaque"):
            extract_mesh(field, resolution=9)

    def test_threshold_that_nothing_exceeds(self):
        with pytest.raises(InputError, match=r"threshold=2000: the largest density in the box is 1000"):
            extract_mesh(AnalyticField(ball(0.5)), resolution=9, threshold=2000.0)

    def test_density_that_is_not_finite(self):
        field = AnalyticField(lambda x: torch.where(x[:, 0] > 0.9, torch.nan, 1.0))
        with pytest.raises(InputError, match=r"not finite at \d+ of \d+ positions"):
            extract_mesh(field, resolution=9)

    @pytest.mark.parametrize(
        "options",
        [
            {"threshold": 0.0},
            {"threshold": -1.0},
            {"threshold": math.nan},
            {"threshold": math.inf},
            {"resolution": 1},
            {"min_component": -0.1},
            {"min_component": 1.5},
            {"refine": -1},
            {"chunk": 0},
            {"bounds": torch.tensor([[0.0, 0, 0], [1, 1, 0]])},
            {"bounds": torch.zeros(3)},
        ],
    )
    def test_arguments_out_of_range_are_named(self, options):
        with pytest.raises(InputError, match=next(iter(options))) as error:
            extract_mesh(AnalyticField(ball(0.5)), **{"resolution": 9, **options})
        assert "\n" not in str(error.value)


class TestFiles:
    @pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".PLY"])
    def test_every_format_reads_back(self, tmp_path, suffix):
        path = tmp_path / f"mesh{suffix}"
        mesh = write_mesh(AnalyticField(ball(0.6)), path, resolution=17)
        back = read_mesh(path)
        np.testing.assert_allclose(np.sort(back.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=1e-6)
        assert len(back.faces) == len(mesh.faces)
        assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
        assert back.colours is not None
        np.testing.assert_allclose(back.colours.mean(axis=0), mesh.colours.mean(axis=0), atol=1.5)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    def test_other_suffix_is_refused_before_any_work(self, tmp_path):
        field = AnalyticField(ball(0.5))
        with pytest.raises(InputError, match=r"found suffix '.stl', expected one of .ply, .obj, .glb"):
            write_mesh(field, tmp_path / "mesh.stl")
        assert field.largest_batch == 0

    def test_failed_write_leaves_what_stood_there(self, tmp_path, monkeypatch):
        path = tmp_path / "mesh.ply"
        path.write_text("before")

        def broken(self, target, **options):
            target.write_text("half")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(trimesh.Trimesh, "export", broken)
        with pytest.raises(InputError, match="no space left"):
            write_mesh(AnalyticField(ball(0.5)), path, resolution=9)
        assert path.read_text() == "before"
        assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]

    def test_unreadable_files(self, tmp_path):
        with pytest.raises(InputError, match="no such mesh file"):
            read_mesh(tmp_path / "none.ply")
        broken = tmp_path / "broken.ply"
        broken.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n1 2\n")
        with pytest.raises(InputError, match=r"broken\.ply"):
            read_mesh(broken)
        points = tmp_path / "points.ply"
        trimesh.PointCloud(np.eye(3)).export(points)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_mesh(points)
        other = tmp_path / "text.xyzzy"
        other.write_text("hello")
        with pytest.raises(InputError, match=r"text\.xyzzy"):
            read_mesh(other)

    def test_mesh_without_colours(self, tmp_path):
        mesh = extract_mesh(AnalyticField(box((0.5, 0.4, 0.3))), resolution=17, colours=False)
        save_mesh(mesh, tmp_path / "a.ply")
        assert read_mesh(tmp_path / "a.ply").colours is None


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
    assert face_areas(vertices, faces).min() > 1e-6


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
