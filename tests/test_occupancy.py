"""Occupancy grids: updates, resizing, tight boxes and the visual hull."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F

from gridreg.rendering import OccupancyGrid, camera_rays, visual_hull

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def ball(radius, centre=(0.0, 0.0, 0.0), density=100.0):
    middle = torch.tensor(centre)
    return lambda x: torch.where((x - middle).norm(dim=-1) < radius, density, 0.0)


def test_update_keeps_the_object_and_drops_the_rest():
    grid = OccupancyGrid.full(BOX, (20, 20, 20))
    grid.update(ball(0.5), step=0.05, dilate=0)
    centres = grid.centres(torch.arange(8000))
    assert torch.equal(grid.cells.reshape(-1).bool(), centres.norm(dim=-1) < 0.5)


def test_update_grows_by_the_dilation():
    sharp, grown = OccupancyGrid.full(BOX, (20, 20, 20)), OccupancyGrid.full(BOX, (20, 20, 20))
    sharp.update(ball(0.5), step=0.05, dilate=0)
    grown.update(ball(0.5), step=0.05, dilate=2)
    lower, upper = sharp.tight_bounds(), grown.tight_bounds()
    torch.testing.assert_close((lower - upper).abs(), torch.full((2, 3), 0.2))


@given(shape=st.tuples(*[st.integers(2, 7)] * 3), radius=st.integers(0, 3), seed=st.integers(0, 99))
def test_dilation_is_the_maximum_over_cubes(shape, radius, seed):
    dense = torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < 0.1
    grid = OccupancyGrid.full(BOX, shape)
    grid.update(lambda x: 100.0 * dense[_cells(x, shape)], step=0.05, dilate=radius)
    expected = F.max_pool3d(dense[None, None].float(), 2 * radius + 1, stride=1, padding=radius)[0, 0]
    assert torch.equal(grid.cells.float(), expected)


def _cells(x, shape):
    return tuple(((x[:, a] + 1) / 2 * shape[a]).long() for a in range(3))


def test_update_looks_only_at_occupied_cells_and_never_leaves_the_hull():
    seen = []
    grid = OccupancyGrid.full(BOX, (10, 10, 10))
    grid.cells[5:] = 0
    grid.hull = grid.cells.clone()

    def density(x):
        seen.append(x)
        return torch.full((x.shape[0],), 1e3)

    grid.update(density, step=0.1)
    assert sum(x.shape[0] for x in seen) == 500
    assert max(float(x[:, 0].max()) for x in seen) < 0
    assert int(grid.cells.sum()) == 500


def test_threshold_is_an_opacity():
    # 1 - exp(-density * step) crosses 0.01 at density 0.1005 for a step of 0.1.
    for level, kept in ((0.0995, 0), (0.1015, 64)):
        grid = OccupancyGrid.full(BOX, (4, 4, 4))
        grid.update(lambda x, level=level: torch.full((x.shape[0],), level), step=0.1, threshold=0.01)
        assert int(grid.cells.sum()) == kept


@given(
    seed=st.integers(0, 10_000),
    resolution=st.tuples(*[st.integers(1, 9)] * 3),
    lower=st.tuples(*[st.floats(-1.2, -0.2)] * 3),
    upper=st.tuples(*[st.floats(0.2, 1.2)] * 3),
)
def test_resizing_never_loses_an_occupied_point(seed, resolution, lower, upper):
    generator = torch.Generator().manual_seed(seed)
    cells = (torch.rand(5, 6, 7, generator=generator) < 0.2).to(torch.uint8)
    old = OccupancyGrid(BOX.clone(), cells)
    bounds = torch.tensor([lower, upper])
    new = old.at(bounds, resolution)
    points = bounds[0] + torch.rand(400, 3, generator=generator) * (bounds[1] - bounds[0])
    assert not bool((old.contains(points) & ~new.contains(points)).any())


def test_resizing_to_the_same_box_and_resolution_changes_nothing():
    cells = (torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    assert torch.equal(OccupancyGrid(BOX, cells).at(BOX, (5, 6, 7)).cells, cells)


def test_refining_splits_cells():
    cells = torch.zeros(2, 2, 2, dtype=torch.uint8)
    cells[1, 0, 1] = 1
    fine = OccupancyGrid(BOX, cells).at(BOX, (4, 4, 4)).cells
    assert int(fine.sum()) == 8
    assert int(fine[2:, :2, 2:].sum()) == 8


def test_tight_box_of_a_single_cell_and_of_none():
    grid = OccupancyGrid.full(BOX, (4, 4, 4))
    grid.cells.zero_()
    with pytest.raises(RuntimeError, match="no cell is occupied"):
        grid.tight_bounds()
    grid.cells[1, 2, 3] = 1
    torch.testing.assert_close(grid.tight_bounds(), torch.tensor([[-0.5, 0.0, 0.5], [0.0, 0.5, 1.0]]))


def poses_around(count, distance=4.0):
    found = []
    for k in range(count):
        angle = torch.tensor(2 * torch.pi * k / count)
        back = torch.stack([angle.cos(), angle.sin(), torch.tensor(0.3)])
        back = back / back.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back)
        right = right / right.norm()
        pose = torch.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, torch.linalg.cross(back, right), back
        pose[:3, 3] = distance * back
        found.append(pose)
    return torch.stack(found)


def silhouettes(poses, intrinsics, inside, size=40):
    pictures = []
    for pose in poses:
        rays = camera_rays(pose, intrinsics, size, size)
        t = torch.linspace(2, 6, 400)
        points = rays.origins[:, None] + t[None, :, None] * rays.directions[:, None]
        hit = inside(points.reshape(-1, 3)).reshape(-1, 400).any(dim=1)
        pictures.append(hit.float().reshape(size, size))
    return torch.stack(pictures)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.2)])
def test_visual_hull_holds_the_object_and_little_else(centre):
    poses, intrinsics = poses_around(8), torch.tensor([50.0, 50.0, 20.0, 20.0])
    inside = ball(0.4, centre)
    alpha = silhouettes(poses, intrinsics, lambda x: inside(x) > 0)
    grid = OccupancyGrid.full(BOX, (24, 24, 24))
    hull = visual_hull(grid, alpha, poses, intrinsics.expand(8, 4)).reshape(-1).bool()
    centres = grid.centres(torch.arange(24**3))
    distance = (centres - torch.tensor(centre)).norm(dim=-1)
    assert bool(hull[distance < 0.4].all())
    assert not bool(hull[distance > 0.85].any())


def test_beyond_the_edge_of_a_picture_nothing_is_carved_if_the_silhouette_touches_it():
    intrinsics = torch.tensor([[400.0, 400.0, 20.0, 20.0]])
    grid, alpha = OccupancyGrid.full(BOX, (16, 16, 16)), torch.zeros(1, 40, 40)
    assert not bool(visual_hull(grid, alpha, poses_around(1), intrinsics).any())
    alpha[0, 0, 7] = 1.0
    # A narrow camera sees a tube that is almost empty; all else stays.
    assert 0.5 < visual_hull(grid, alpha, poses_around(1), intrinsics).float().mean() < 1.0
