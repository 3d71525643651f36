"""Where no camera sees, within the silhouettes' hull, a mesh is solid; what cameras see stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export.cameras import look_at
from gridreg.export.mesh import extract_mesh
from gridreg.rendering import Camera, Lens, OccupancyGrid
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer, load_run
from gridreg.training.run import save_run
from tests.export_fields import AnalyticField
from tests.export_meshes import assert_closed


def around(elevation: float, count: int = 6) -> list[Camera]:
    high, lens = np.radians(elevation), Lens((120.0, 120.0, 60.0, 60.0), 120, 120)
    turns = 2 * np.pi * np.arange(count) / count
    places = [3 * np.array([np.cos(t) * np.cos(high), np.sin(t) * np.cos(high), np.sin(high)]) for t in turns]
    return [Camera(look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])), lens) for place in places]


def lid(x: torch.Tensor) -> torch.Tensor:
    """A box of 1.2 x 1.2 x 0.8 with walls and a lid of 0.1, open below: what photographs from above make of a box."""
    inside = (x[:, :2].abs() < 0.6).all(dim=-1) & (x[:, 2].abs() < 0.4)
    hollow = (x[:, :2].abs() < 0.5).all(dim=-1) & (x[:, 2] < 0.3)
    return 500.0 * (inside & ~hollow).float()


def bowl(x: torch.Tensor) -> torch.Tensor:
    """The same upside down."""
    return lid(x * torch.tensor([1.0, 1.0, -1.0]))


def carved(field: AnalyticField) -> OccupancyGrid:
    grid = OccupancyGrid.full(field.bounds, (16, 16, 16))
    return OccupancyGrid(grid.bounds, grid.cells, grid.cells)


SOLID = 1.2 * 1.2 * 0.8


def test_box_that_is_seen_from_above_alone_is_solid_and_ends_where_it_is_seen_to_end():
    field = AnalyticField(lid)
    hollow = extract_mesh(field, carved(field), resolution=49)
    assert hollow.volume < 0.5 * SOLID
    mesh = extract_mesh(field, carved(field), resolution=49, cameras=around(35))
    assert_closed(mesh)
    assert mesh.volume == pytest.approx(SOLID, rel=0.06)
    # A hull alone would reach further down, as steeply as the cameras look.
    np.testing.assert_allclose(mesh.vertices.min(axis=0), hollow.vertices.min(axis=0), atol=0.05)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), hollow.vertices.max(axis=0), atol=0.05)


def test_what_stands_on_the_floor_of_the_box_reaches_down_to_it():
    field = AnalyticField(lid)
    mesh = extract_mesh(field, carved(field), resolution=49, cameras=around(35), standing=True)
    assert_closed(mesh)
    assert mesh.vertices[:, 2].min() == pytest.approx(-1.0, abs=0.05)
    assert mesh.vertices[:, 2].max() == pytest.approx(0.4, abs=0.05)
    # No camera sees through the foot, which narrows as they look past the edges of the box.
    foot = mesh.vertices[mesh.vertices[:, 2] < -0.9]
    assert np.abs(foot[:, :2]).max() < 0.45


def test_bowl_that_cameras_look_into_stays_a_bowl():
    field = AnalyticField(bowl)
    before = extract_mesh(field, carved(field), resolution=49)
    mesh = extract_mesh(field, carved(field), resolution=49, cameras=[*around(35), *around(80)])
    assert_closed(mesh)
    assert mesh.volume == pytest.approx(before.volume, rel=0.1)


def test_nothing_is_filled_without_silhouettes_or_outside_their_hull():
    field = AnalyticField(lid)
    before = extract_mesh(field, resolution=33)
    grid = OccupancyGrid.full(field.bounds, (16, 16, 16))
    assert extract_mesh(field, grid, resolution=33, cameras=around(35)).volume == before.volume
    centres = grid.centres(torch.arange(16**3)).reshape(16, 16, 16, 3)
    walls = (~((centres[..., :2].abs() < 0.45).all(dim=-1) & (centres[..., 2] < 0.25))).to(torch.uint8)
    proven = OccupancyGrid(grid.bounds, grid.cells, walls)
    assert extract_mesh(field, proven, resolution=33, cameras=around(35)).volume < 0.7 * SOLID


def test_threshold_that_nothing_exceeds_is_refused_with_cameras_too():
    field = AnalyticField(lid)
    with pytest.raises(InputError, match="expected a threshold below it"):
        extract_mesh(field, carved(field), resolution=17, cameras=around(35), threshold=1e4)


def test_filled_surfaces_have_the_colour_of_what_is_seen_beside_them():
    field = AnalyticField(lid, colour=lambda x, d: torch.where(lid(x)[:, None] > 0, 0.8, 0.1).expand(-1, 3))
    mesh = extract_mesh(field, carved(field), resolution=33, cameras=around(35))
    below = (np.abs(mesh.vertices[:, :2]) < 0.4).all(axis=1) & (mesh.vertices[:, 2] < -0.3)
    assert below.any()
    assert (mesh.colours[below] > 150).all()


def test_checkpoint_keeps_the_cameras_of_the_training_views(tmp_path):
    scene = load_scene(builtin_scene(tmp_path / "scene", size=16), "builtin8")
    train = TrainSettings(steps=1, rays=8, voxels_start=6**3, voxels_end=6**3, carve=True)
    config = RunConfig(backbone="cp", train=train, composition="none")
    trainer = build_trainer(config, scene)
    save_run(tmp_path / "checkpoint", trainer, config, {})
    loaded = load_run(tmp_path / "checkpoint")
    assert len(loaded.cameras) == len(scene.train) == 8
    for mine, theirs in zip(loaded.cameras, scene.train.cameras, strict=True):
        assert torch.equal(mine.pose, theirs.pose)
        assert mine.lens == theirs.lens
