"""The built-in scene's exact geometry through the whole way: field, mesh, file, comparison."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gridreg.export.compare import MeshComparison, compare_meshes
from gridreg.export.mesh import Mesh, extract_mesh
from gridreg.export.mesh_files import read_mesh, save_mesh
from gridreg.scenes.builtin import BOUNDS, builtin_mesh, builtin_signed_distance
from tests.export_fields import AnalyticField, Function
from tests.export_meshes import assert_closed

CORNERS = torch.as_tensor(np.asarray(BOUNDS), dtype=torch.float32)
NODES = 64


def signed_distance(x: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.asarray(builtin_signed_distance(x.double().numpy()))).float()


def island(x: torch.Tensor) -> torch.Tensor:
    """A dense field on the exact geometry."""
    return 400.0 * (signed_distance(x) < 0).float()


def hazy_island(x: torch.Tensor) -> torch.Tensor:
    """As training leaves it: soft surfaces, a faint haze everywhere."""
    return 80.0 * torch.sigmoid(-signed_distance(x) * 120) + 0.05


@pytest.fixture(scope="module")
def truth() -> Mesh:
    vertices, faces = builtin_mesh(0.06)
    return Mesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64))


def extracted(function: Function) -> Mesh:
    field = AnalyticField(function)
    field.bounds = CORNERS
    return extract_mesh(field, resolution=NODES, colours=False, min_component=0.001)


@pytest.fixture(scope="module")
def sharp() -> Mesh:
    return extracted(island)


@pytest.fixture(scope="module")
def soft() -> Mesh:
    return extracted(hazy_island)


@pytest.mark.parametrize(("name", "bound"), [("sharp", 0.005), ("soft", 0.01)])
def test_mesh_is_within_one_percent_closed_and_outward(name, bound, truth, request):
    mesh = request.getfixturevalue(name)
    assert_closed(mesh)
    found = compare_meshes(mesh, truth, samples=8000)
    # The finest parts are thinner than a lattice cell of 1.5 % of the box's edge.
    assert found.chamfer_relative < bound
    assert found.f_score > 0.8
    assert found.normal_consistency > 0.8


def test_vertices_lie_on_the_exact_surface(sharp):
    distance = signed_distance(torch.from_numpy(sharp.vertices).float()).abs().numpy()
    cell = float((CORNERS[1] - CORNERS[0]).max()) / (NODES - 1)
    assert np.quantile(distance, 0.95) < 0.05 * cell
    assert distance.max() < cell


def test_file_compares_like_the_mesh_it_was_written_from(tmp_path, soft, truth):
    save_mesh(soft, tmp_path / "island.ply")
    ours = compare_meshes(soft, truth, samples=2000)
    back = compare_meshes(read_mesh(tmp_path / "island.ply"), truth, samples=2000)
    assert back.chamfer == pytest.approx(ours.chamfer, rel=1e-3)
    assert back.f_score == pytest.approx(ours.f_score, abs=2e-3)


def moved(mesh: Mesh, rotation: NDArray[np.float64], scale: float, shift: float) -> Mesh:
    return Mesh(scale * mesh.vertices @ rotation.T + shift, mesh.faces)


@pytest.mark.parametrize(("seed", "scale", "shift"), [(0, 1.0, 5.0), (1, 0.01, 0.0), (2, 40.0, -3.0)])
def test_comparison_moves_and_grows_with_both_meshes(seed, scale, shift, truth):
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    other = Mesh(truth.vertices + rng.normal(scale=0.02, size=truth.vertices.shape), truth.faces)

    def compared(turned: NDArray[np.float64], factor: float, by: float) -> MeshComparison:
        pair = (moved(other, turned, factor, by), moved(truth, turned, factor, by))
        return compare_meshes(*pair, samples=1500, threshold=0.02 * factor)

    plain, there = compared(np.eye(3), 1.0, 0.0), compared(rotation, scale, shift)
    assert there.chamfer == pytest.approx(scale * plain.chamfer, rel=1e-3)
    assert there.precision == pytest.approx(plain.precision, abs=2e-3)
    assert there.recall == pytest.approx(plain.recall, abs=2e-3)
    assert there.normal_consistency == pytest.approx(plain.normal_consistency, abs=5e-3)


def test_a_comparison_has_two_sides(truth):
    half = Mesh(truth.vertices, truth.faces[truth.vertices[truth.faces][:, :, 0].mean(axis=1) > 0])
    one, other = compare_meshes(half, truth, samples=2000), compare_meshes(truth, half, samples=2000)
    assert one.accuracy < 1e-4 < one.completeness
    assert other.completeness < 1e-4 < other.accuracy
    assert one.precision == 1.0
    assert one.recall == pytest.approx(other.precision, abs=0.05)
    assert one.diagonal > other.diagonal
