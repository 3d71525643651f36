"""Camera rays and box intersections against hand-worked cases and brute force."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gridreg.rendering import Rays, box_intersection, camera_rays, pixel_rays

BOX = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 1.5, 0.5]])


def random_pose(seed):
    generator = np.random.default_rng(seed)
    q, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = q * np.sign(np.linalg.det(q))
    pose[:3, 3] = generator.normal(size=3)
    return torch.tensor(pose, dtype=torch.float32)


@given(seed=st.integers(0, 1000), row=st.integers(0, 29), column=st.integers(0, 39))
def test_a_point_on_a_ray_projects_back_to_its_pixel(seed, row, column):
    pose, intrinsics = random_pose(seed), torch.tensor([33.0, 35.0, 19.0, 16.0])
    rays = camera_rays(pose, intrinsics, 30, 40)
    k = row * 40 + column
    point = rays.origins[k] + 2.7 * rays.directions[k]
    x, y, z = (torch.linalg.inv(pose) @ torch.cat([point, torch.ones(1)]))[:3]
    assert z < 0
    assert (19.0 + 33.0 * x / -z).item() == pytest.approx(column + 0.5, abs=2e-3)
    assert (16.0 - 35.0 * y / -z).item() == pytest.approx(row + 0.5, abs=2e-3)


def test_directions_have_length_one_and_origins_are_the_camera():
    pose = random_pose(3)
    rays = camera_rays(pose, torch.tensor([20.0, 20.0, 5.0, 5.0]), 10, 10)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(100))
    assert torch.equal(rays.origins, pose[:3, 3].expand(100, 3))


def test_each_ray_may_have_its_own_camera():
    poses = torch.stack([random_pose(1), random_pose(2)])
    intrinsics = torch.tensor([[20.0, 20.0, 5.0, 5.0], [30.0, 31.0, 4.0, 6.0]])
    both = pixel_rays(poses, intrinsics, torch.tensor([2, 7]), torch.tensor([3, 1]))
    for k in range(2):
        one = camera_rays(poses[k], intrinsics[k], 10, 10)[torch.tensor([[23], [71]][k])]
        torch.testing.assert_close(both.directions[k : k + 1], one.directions)


@given(seed=st.integers(0, 10_000))
def test_box_intersection_agrees_with_dense_sampling(seed):
    generator = torch.Generator().manual_seed(seed)
    origin = torch.randn(1, 3, generator=generator) * 2
    direction = torch.randn(1, 3, generator=generator)
    rays = Rays(origin, direction / direction.norm())
    t_min, t_max = box_intersection(rays, BOX, near=0.1, far=6.0)
    t = torch.linspace(0.1, 6.0, 6001)
    x = rays.origins + t[:, None] * rays.directions
    inside = ((x >= BOX[0]) & (x <= BOX[1])).all(dim=-1)
    if inside.any():
        assert t_min.item() == pytest.approx(t[inside].min().item(), abs=2e-3)
        assert t_max.item() == pytest.approx(t[inside].max().item(), abs=2e-3)
    else:
        assert (t_max - t_min).item() < 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis_have_finite_distances(axis):
    direction = torch.zeros(1, 3)
    direction[0, axis] = 1.0
    inside = BOX.mean(dim=0, keepdim=True)
    t_min, t_max = box_intersection(Rays(inside, direction), BOX, near=0.0, far=10.0)
    assert t_min.item() == 0.0
    assert t_max.item() == pytest.approx((BOX[1, axis] - inside[0, axis]).item(), abs=1e-5)
    beside = inside.clone()
    beside[0, (axis + 1) % 3] = 9.0
    t_min, t_max = box_intersection(Rays(beside, direction), BOX, near=0.0, far=10.0)
    assert torch.equal(t_min, t_max)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"origins \(4, 3\) and directions \(5, 3\)"):
        Rays(torch.zeros(4, 3), torch.zeros(5, 3))
