"""Camera paths: rigid, level, around the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.export.camera_files import save_cameras
from gridreg.export.camera_paths import (
    camera_path,
    forward_facing,
    round_trip,
    spiral,
    sway,
    tour,
    turntable,
)
from gridreg.export.cameras import look_at, orbit_of_box, orbit_of_views, up_axis
from gridreg.rendering import camera_rays
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import Views
from tests.export_fields import ring_of_views

LENS = Lens.from_angle(45.0, 30, 40)
BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


def positions(cameras: list[Camera]) -> np.ndarray:
    return np.stack([c.pose[:3, 3].double().numpy() for c in cameras])


def assert_rigid(cameras: list[Camera]) -> None:
    for camera in cameras:
        rotation = camera.pose[:3, :3].double()
        torch.testing.assert_close(
            rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-5, rtol=0
        )
        assert torch.linalg.det(rotation) > 0
        assert camera.pose[3].tolist() == [0, 0, 0, 1]


def rotation_of(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def moved(views: Views, rotation: np.ndarray, shift: np.ndarray) -> Views:
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation, shift
    return Views(
        views.rgba,
        torch.from_numpy(world @ views.poses.double().numpy()).float(),
        views.intrinsics,
        views.names,
        views.ids,
    )


coordinates = st.tuples(*[st.floats(-3, 3)] * 3)


@given(position=coordinates, target=coordinates, up=coordinates)
def test_look_at_is_rigid_and_the_middle_ray_meets_the_target(position, target, up):
    if np.linalg.norm(np.subtract(position, target)) < 1e-2 or np.linalg.norm(up) < 1e-2:
        return
    camera = Camera(look_at(np.array(position), np.array(target), np.array(up)), LENS)
    assert_rigid([camera])
    ray = camera_rays(camera.pose, torch.tensor([40.0, 40, 0.5, 0.5]), 1, 1)
    towards = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    np.testing.assert_allclose(ray.directions[0].numpy(), towards, atol=1e-5)
    # What is up in the world is not down in the image.
    assert camera.pose[:3, 1].numpy() @ np.array(up) > -1e-5 * np.linalg.norm(up)


def test_look_at_refuses_its_own_place():
    with pytest.raises(InputError, match="stands at its target"):
        look_at(np.ones(3), np.ones(3), np.array([0.0, 0, 1]))


class TestOrbit:
    @pytest.mark.parametrize("elevation", [10.0, 40.0, 75.0])
    def test_is_derived_from_level_cameras(self, elevation):
        orbit = orbit_of_views(ring_of_views(8, radius=3.0, elevation=elevation), BOX)
        np.testing.assert_allclose(orbit.centre, 0, atol=1e-5)
        np.testing.assert_allclose(orbit.up, [0, 0, 1], atol=1e-5)
        assert orbit.radius == pytest.approx(3.0, rel=1e-5)
        assert orbit.elevation == pytest.approx(min(elevation, 60.0), abs=1e-3)
        assert orbit.elevations == pytest.approx((elevation, elevation), abs=1e-3)

    @given(seed=st.integers(0, 10_000))
    def test_follows_a_world_that_is_turned_and_moved(self, seed):
        rotation, shift = rotation_of(seed), np.array([3.0, -2.0, 5.0])
        views = moved(ring_of_views(7, radius=2.5, elevation=20.0), rotation, shift)
        orbit = orbit_of_views(views)
        np.testing.assert_allclose(orbit.centre, shift, atol=1e-4)
        np.testing.assert_allclose(orbit.up, rotation[:, 2], atol=1e-4)
        assert orbit.radius == pytest.approx(2.5, rel=1e-4)
        # Azimuth 0 is where the first camera stands.
        torch.testing.assert_close(orbit.pose(0.0), views.poses[0], atol=1e-4, rtol=0)

    def test_up_of_one_camera_and_of_cameras_side_by_side_is_their_own(self):
        one = look_at(np.array([3.0, 0, 1]), np.zeros(3), np.array([0.0, 0, 1])).double().numpy()
        np.testing.assert_allclose(up_axis(one[None]), one[:3, 1], atol=1e-6)
        other = one.copy()
        other[:3, 3] += one[:3, 0]
        np.testing.assert_allclose(up_axis(np.stack([one, other])), one[:3, 1], atol=1e-6)
        opposed = np.stack([np.diag([1.0, 1, 1, 1]), np.diag([-1.0, -1, 1, 1])])
        np.testing.assert_allclose(up_axis(opposed), [0, 0, 1])

    def test_a_centre_outside_the_box_gives_way_to_its_middle(self):
        orbit = orbit_of_views(ring_of_views(6), torch.tensor([[2.0, 2, 2], [4, 4, 4]]))
        np.testing.assert_allclose(orbit.centre, [3, 3, 3])

    def test_around_a_box_the_box_fits_into_the_image(self):
        bounds = torch.tensor([[0.0, 0, 0], [1, 2, 3]])
        orbit = orbit_of_box(bounds, angle=40.0)
        for camera in turntable(orbit, Lens.from_angle(40.0, 100, 100), 5):
            corners = torch.cartesian_prod(*bounds.T).double()
            local = (corners - camera.pose[:3, 3].double()) @ camera.pose[:3, :3].double()
            assert (local[:, 2] < 0).all()
            fx, fy, cx, cy = camera.lens.intrinsics
            columns, rows = cx - fx * local[:, 0] / local[:, 2], cy + fy * local[:, 1] / local[:, 2]
            assert columns.min() > 0
            assert columns.max() < 100
            assert rows.min() > 0
            assert rows.max() < 100

    def test_no_views(self):
        none = ring_of_views(3)
        none = Views(none.rgba[:0], none.poses[:0], none.intrinsics[:0], (), ())
        for derive in (lambda: orbit_of_views(none), lambda: sway(none, LENS), lambda: tour(none, LENS)):
            with pytest.raises(InputError, match="found no view"):
                derive()


class TestPaths:
    def test_turntable_goes_around_once_in_even_steps(self):
        orbit = orbit_of_views(ring_of_views(8, radius=3.0, elevation=30.0))
        cameras = turntable(orbit, LENS, 12)
        assert_rigid(cameras)
        p = positions(cameras)
        np.testing.assert_allclose(np.linalg.norm(p, axis=1), 3.0, rtol=1e-5)
        np.testing.assert_allclose(p[:, 2], 1.5, rtol=1e-4)
        steps = np.diff(np.unwrap(np.arctan2(p[:, 1], p[:, 0])))
        np.testing.assert_allclose(steps, 2 * math.pi / 12, atol=1e-5)

    def test_spiral_covers_the_elevations_and_closes(self):
        views = ring_of_views(9, elevation=(10.0, 50.0))
        orbit = orbit_of_views(views)
        cameras = spiral(orbit, LENS, 200, turns=3)
        assert_rigid(cameras)
        heights = np.degrees(np.arcsin((positions(cameras) - orbit.centre)[:, 2] / orbit.radius))
        assert heights.min() == pytest.approx(orbit.elevations[0], abs=0.5)
        assert heights.max() == pytest.approx(orbit.elevations[1], abs=0.5)
        gaps = np.linalg.norm(
            np.diff(np.concatenate([positions(cameras), positions(cameras)[:1]]), axis=0), axis=1
        )
        assert gaps.max() < 2.5 * np.median(gaps)

    def test_tour_passes_every_camera_and_stays_around_the_object(self):
        views = ring_of_views(8, radius=3.0, elevation=(15.0, 60.0))
        cameras = tour(views, LENS, 400, BOX)
        assert_rigid(cameras)
        p = positions(cameras)
        for pose in views.poses:
            nearest = int(np.linalg.norm(p - pose[:3, 3].numpy(), axis=1).argmin())
            assert np.linalg.norm(p[nearest] - pose[:3, 3].numpy()) < 0.1
            assert cameras[nearest].pose[:3, 2].dot(pose[:3, 2]) > 0.995
        distances = np.linalg.norm(p, axis=1)
        assert distances.min() > 2.5
        assert distances.max() < 3.5
        gaps = np.linalg.norm(np.diff(np.concatenate([p, p[:1]]), axis=0), axis=1)
        assert gaps.max() < 4 * np.median(gaps)

    def test_tour_of_one_camera_stands_still(self):
        views = ring_of_views(1)
        cameras = tour(views, LENS, 3)
        assert len(cameras) == 3
        assert all(torch.equal(c.pose, views.poses[0]) for c in cameras)

    def test_round_trip_of_a_shuffled_circle_is_the_circle(self):
        angles = np.random.default_rng(0).permutation(12) * 2 * math.pi / 12
        order = round_trip(np.stack([np.cos(angles), np.sin(angles)], axis=1))
        steps = np.diff(angles[[*order, order[0]]])
        assert order[0] == 0
        np.testing.assert_allclose(
            np.abs((steps + math.pi) % (2 * math.pi) - math.pi), 2 * math.pi / 12, atol=1e-9
        )

    def test_forward_facing_cameras_sway_before_the_scene(self):
        rng = np.random.default_rng(0)
        poses = [
            look_at(np.array([x, y, 4.0]), np.array([0.0, 0, 0]), np.array([0.0, 1, 0]))
            for x, y in rng.uniform(-0.5, 0.5, (12, 2))
        ]
        ring = ring_of_views(12)
        views = Views(ring.rgba, torch.stack(poses), ring.intrinsics, ring.names, ring.ids)
        assert forward_facing(views)
        assert not forward_facing(ring)
        cameras = camera_path("spiral", BOX, views, frames=40)
        assert_rigid(cameras)
        p = positions(cameras)
        assert np.abs(p[:, :2]).max() < 0.8
        assert p[:, 0].max() - p[:, 0].min() > 0.4
        assert all(-c.pose[2, 2] < -0.9 for c in cameras)
        parallel = torch.eye(4).repeat(3, 1, 1)
        parallel[:, 0, 3] = torch.tensor([0.0, 1.0, 2.0])
        side = Views(ring.rgba[:3], parallel, ring.intrinsics[:3], ring.names[:3], ring.ids[:3])
        assert_rigid(sway(side, LENS, 5))

    def test_by_name(self, tmp_path):
        views = ring_of_views(6, radius=3.0)
        for name in ("turntable", "spiral", "train"):
            cameras = camera_path(name, BOX, views, frames=7, width=20)
            assert len(cameras) == 7
            assert {(c.lens.width, c.lens.height) for c in cameras} == {(20, 15)}
        assert len(camera_path("turntable", BOX, frames=4)) == 4
        chosen = camera_path("turntable", BOX, views, frames=4, radius=5.0, elevation=0.0)
        np.testing.assert_allclose(np.linalg.norm(positions(chosen), axis=1), 5.0, rtol=1e-5)
        np.testing.assert_allclose(positions(chosen)[:, 2], 0.0, atol=1e-5)
        save_cameras(tmp_path / "path.json", chosen)
        assert len(camera_path(tmp_path / "path.json", BOX)) == 4
        assert camera_path(str(tmp_path / "path.json"), BOX, width=10)[0].lens.width == 10

    @pytest.mark.parametrize(
        ("name", "options", "said"),
        [
            ("helix", {}, "path: found 'helix', expected turntable, spiral, train or a camera file"),
            ("train", {}, "needs the scene's training cameras"),
            ("turntable", {"frames": 0}, "frames=0"),
            ("turntable", {"radius": -1.0}, "radius=-1.0"),
            ("turntable", {"radius": math.nan}, "radius=nan"),
            ("spiral", {"elevation": 90.0}, r"elevation=90\.0"),
            ("turntable", {"width": 0}, "size: found 0x"),
        ],
    )
    def test_bad_arguments(self, name, options, said):
        with pytest.raises(InputError, match=said):
            camera_path(name, BOX, **options)
