"""The built-in scene: its geometry, depth and looks against independent checks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from gridreg.rendering.rays import camera_rays
from gridreg.scenes import (
    builtin_depth,
    builtin_mesh,
    builtin_signed_distance,
    builtin_surface,
)
from gridreg.scenes.builtin import BOUNDS
from gridreg.scenes.builtin.cameras import look_at_origin, train_poses
from gridreg.scenes.builtin.cameras import test_poses as held_out_poses
from gridreg.scenes.builtin.lighthouse import lighthouse
from gridreg.scenes.builtin.materials import shade
from gridreg.scenes.builtin.raycast import cast, render_rgba


class TestGeometry:
    def test_fits_its_box_and_has_thin_parts(self) -> None:
        points, normals = builtin_surface(20_000, torch.Generator().manual_seed(0))
        assert (points > BOUNDS[0]).all()
        assert (points < BOUNDS[1]).all()
        assert np.linalg.norm(points, axis=1).max() < 1.4
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)
        assert min(part.solid.reach for part in lighthouse()) < 0.03

    def test_surface_points_lie_on_the_union(self) -> None:
        points, normals = builtin_surface(5_000, torch.Generator().manual_seed(1))
        assert np.abs(builtin_signed_distance(points)).max() < 1e-9
        assert (builtin_signed_distance(points + 1e-6 * normals) > 0).mean() > 0.999
        assert (builtin_signed_distance(points - 1e-6 * normals) < 0).mean() > 0.999

    def test_surface_is_repeatable_and_follows_the_generator(self) -> None:
        first, again, other = (builtin_surface(100, torch.Generator().manual_seed(s))[0] for s in (3, 3, 4))
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)

    def test_signed_distance_is_the_least_of_all_parts(self) -> None:
        points = np.random.default_rng(0).uniform(-1.5, 1.5, (3_000, 3))
        plain = np.min([part.solid.distance(part.local(points)) for part in lighthouse()], axis=0)
        np.testing.assert_array_equal(builtin_signed_distance(points), plain)
        assert (plain < 0).any()

    def test_mesh_covers_the_surface(self) -> None:
        vertices, faces = builtin_mesh(0.1)
        assert np.abs(vertices).max() < 1.5
        assert builtin_signed_distance(vertices).max() < 1e-9
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        middles = mesh.triangles_center[mesh.area_faces > 1e-10]
        assert (np.abs(builtin_signed_distance(middles)) < 0.1).all()
        points, _ = builtin_surface(200, torch.Generator().manual_seed(0))
        sampled = mesh.sample(20_000, seed=0)
        assert np.linalg.norm(points[:, None] - sampled, axis=-1).min(axis=1).max() < 0.08


class TestDepth:
    def test_ends_where_sphere_tracing_ends(self) -> None:
        pose = look_at_origin(30, 25)
        focal = 26.0
        depth = builtin_depth(torch.tensor(pose), torch.tensor([focal, focal, 10.0, 8.0]), 16, 20)
        assert depth.shape == (16, 20)
        assert depth.dtype == torch.float32
        rows, columns = np.mgrid[:16, :20] + 0.5
        camera = np.stack([(columns - 10) / focal, -(rows - 8) / focal, -np.ones_like(rows)], axis=-1)
        direction = (camera / np.linalg.norm(camera, axis=-1, keepdims=True)).reshape(-1, 3) @ pose[:3, :3].T
        t = np.zeros(len(direction))
        moving = np.arange(len(t))
        for _ in range(100):
            step = builtin_signed_distance(pose[:3, 3] + t[moving, None] * direction[moving])
            t[moving] += np.maximum(step, 0)
            moving = moving[(step > 1e-6) & (t[moving] < 8)]
        exact = depth.numpy().ravel().astype(np.float64)
        hit = np.isfinite(exact)
        assert 0.1 < hit.mean() < 0.6
        # Sphere tracing creeps along grazing rays; it never passes the surface.
        assert (t[hit] <= exact[hit] + 1e-5).all()
        assert (np.abs(t[hit] - exact[hit]) < 1e-3).mean() > 0.97
        assert (t[~hit] > 7).mean() > 0.97

    def test_agrees_with_the_rays_of_the_renderer(self) -> None:
        pose = torch.tensor(look_at_origin(250, 40), dtype=torch.float32)
        intrinsics = torch.tensor([40.0, 44.0, 15.0, 13.0])
        depth = builtin_depth(pose, intrinsics, 24, 32).reshape(-1, 1)
        rays = camera_rays(pose, intrinsics, 24, 32)
        hit = torch.isfinite(depth[:, 0])
        points = (rays.origins + depth * rays.directions)[hit]
        assert np.abs(builtin_signed_distance(points.numpy())).max() < 1e-5

    def test_windows_lose_no_hit(self) -> None:
        # From near and from inside, where bounding balls reach behind the camera.
        for shift in (0.0, -2.6, -3.4, -4.0):
            pose = look_at_origin(200, 5)
            pose[:3, 3] += shift * pose[:3, 2]
            coordinates = np.arange(24) + 0.5
            hits = cast(pose, np.array([20.0, 20.0, 12.0, 12.0]), coordinates, coordinates)
            slopes = np.stack(np.broadcast_arrays(hits.right, -hits.down[:, None], -1.0), axis=-1).reshape(
                -1, 3
            )
            world = slopes @ pose[:3, :3].T
            every = [
                part.solid.intersect(part.axes.T @ (pose[:3, 3] - part.origin), (world @ part.axes).T)
                for part in lighthouse()
            ]
            np.testing.assert_allclose(hits.parameter.ravel(), np.min(every, axis=0), rtol=1e-9)

    def test_alpha_is_coverage(self) -> None:
        pose, intrinsics = look_at_origin(75, 10), np.array([50.0, 50.0, 20.0, 20.0])
        rgba = render_rgba(pose, intrinsics, 40, 40, samples=2)
        fine = builtin_depth(torch.tensor(pose), torch.tensor(2 * intrinsics), 80, 80)
        coverage = torch.isfinite(fine).double().reshape(40, 2, 40, 2).mean(dim=(1, 3)).numpy()
        np.testing.assert_allclose(rgba[..., 3], coverage)
        assert (rgba[rgba[..., 3] == 0] == 0).all()
        assert rgba.min() >= 0
        assert rgba.max() <= 1

    def test_glossy_parts_change_with_the_view_and_matt_ones_do_not(self) -> None:
        parts = lighthouse()
        change = {True: 0.0, False: 0.0}
        rng = np.random.default_rng(0)
        for part in parts:
            local = part.solid.sample(200, rng)
            normals = part.solid.normal(local) @ part.axes.T
            looks = []
            for towards in ([0.0, 0.0, 1.0], [0.6, -0.8, 0.0]):
                looks.append(shade(part.material, local, normals, np.tile(towards, (200, 1))))
            glossy = part.material.gloss > 0
            change[glossy] = max(change[glossy], float(np.abs(looks[0] - looks[1]).max()))
        assert change[True] > 0.3
        assert change[False] == 0


class TestCameras:
    def test_poses_look_at_the_origin_from_the_sphere(self) -> None:
        for pose in [*train_poses(), *held_out_poses()]:
            rotation = pose[:3, :3]
            np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1)
            np.testing.assert_allclose(rotation[:, 2], pose[:3, 3] / 4.0311, atol=1e-12)
            assert rotation[2, 1] > 0

    def test_no_test_view_is_a_training_view(self) -> None:
        held_out = np.array([pose[:3, 3] for pose in held_out_poses()])
        for pose in train_poses():
            assert np.linalg.norm(held_out - pose[:3, 3], axis=1).min() > 0.1
