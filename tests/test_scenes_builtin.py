"""The built-in scene: exact geometry against independent checks, files written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.scenes import (
    builtin_depth,
    builtin_mesh,
    builtin_scene,
    builtin_signed_distance,
    builtin_surface,
    load_scene,
)
from gridreg.scenes.builtin import BOUNDS, write
from gridreg.scenes.builtin.cameras import look_at_origin, train_poses
from gridreg.scenes.builtin.cameras import test_poses as held_out_poses
from gridreg.scenes.builtin.lighthouse import lighthouse
from gridreg.scenes.builtin.materials import shade
from gridreg.scenes.builtin.raycast import cast, render_rgba
from gridreg.scenes.builtin.solids import Ball, Block, Frustum, Solid
from gridreg.scenes.builtin.tessellate import tessellate

SIZE = 24
lengths = st.floats(0.05, 1.5)
solids = st.one_of(
    st.builds(Ball, lengths),
    st.builds(lambda x, y, z: Block((x, y, z)), lengths, lengths, lengths),
    st.builds(Frustum, lengths, lengths, lengths),
    st.builds(lambda r, h: Frustum(r, r, h), lengths, lengths),
    st.builds(lambda r, h: Frustum(r, 0.0, h), lengths, lengths),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=SIZE)


class TestSolids:
    @settings(max_examples=80, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_rays_end_on_the_surface_and_cross_nothing_before(self, solid: Solid, seed: int) -> None:
        rng = np.random.default_rng(seed)
        origin = rng.standard_normal(3) * 3
        aim = np.array(solid.middle) + solid.reach * rng.uniform(-1, 1, (64, 3))
        direction = (aim - origin) * rng.uniform(0.2, 3, (64, 1))
        t = solid.intersect(origin, direction.T)
        hit = np.isfinite(t)
        assert np.abs(solid.distance(origin + t[hit, None] * direction[hit])).max(initial=0) < 1e-7
        # Marched by hand: no point before the hit, and no point of a missing ray, lies on the other side.
        side = np.sign(solid.distance(origin[None])[0])
        share = np.linspace(0, 1, 200)
        for ray in range(64):
            end = t[ray] * (1 - 1e-6) if hit[ray] else 4.0
            along = origin + (share * end)[:, None] * direction[ray]
            assert (side * solid.distance(along) > -1e-7).all()

    @settings(max_examples=60, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_distance_is_that_to_the_nearest_surface_point(self, solid: Solid, seed: int) -> None:
        rng = np.random.default_rng(seed)
        surface = solid.sample(20_000, rng)
        points = np.array(solid.middle) + 2 * solid.reach * rng.uniform(-1, 1, (20, 3))
        brute = np.linalg.norm(points[:, None] - surface, axis=-1).min(axis=1)
        spacing = math.sqrt(solid.area / len(surface))
        measured = np.abs(solid.distance(points))
        assert (measured <= brute + 1e-9).all()
        # Ten spacings of slack: few points fall near the tip of a cone.
        assert (brute <= measured + 10 * spacing).all()

    @settings(max_examples=60, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_normals_are_the_gradient_of_the_distance(self, solid: Solid, seed: int) -> None:
        points = solid.sample(50, np.random.default_rng(seed))
        assert np.abs(solid.distance(points)).max() < 1e-9
        normals = solid.normal(points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)
        step = 1e-6
        np.testing.assert_allclose(solid.distance(points + step * normals), step, rtol=1e-3)
        assert (solid.distance(points - step * normals) < 0).all()

    @settings(max_examples=40, deadline=None)
    @given(solids)
    def test_meshes_and_areas_agree(self, solid: Solid) -> None:
        vertices, faces = tessellate(solid, solid.reach / 15)
        assert np.abs(solid.distance(vertices)).max() < 1e-9
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.area == pytest.approx(solid.area, rel=0.06)
        centre = np.array(solid.middle)
        outward = ((mesh.triangles_center - centre) * mesh.face_normals).sum(axis=1)
        assert (outward[mesh.area_faces > 1e-12] > 0).all()

    def test_samples_are_uniform(self) -> None:
        # Shares of a cone's base and side, and of a box's faces, by their areas.
        rng = np.random.default_rng(0)
        cone = Frustum(1.0, 0.0, 1.0)
        base = (np.abs(cone.sample(40_000, rng)[:, 2]) < 1e-12).mean()
        assert base == pytest.approx(1 / (1 + math.sqrt(2)), abs=0.01)
        side = cone.sample(40_000, rng)[:, 2]
        # The area of a cone's side above height h is (1 - h)^2 of the whole.
        assert (side[side > 0] > 0.5).mean() == pytest.approx(0.25, abs=0.01)
        box = Block((1.0, 0.5, 0.25)).sample(40_000, rng)
        assert (np.abs(box[:, 2]) == 0.25).mean() == pytest.approx(0.5 / 0.875, abs=0.01)

    def test_no_tessellation_for_others(self) -> None:
        with pytest.raises(TypeError, match="no tessellation for a str"):
            tessellate("cone", 0.1)  # type: ignore[arg-type]


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
        vertices, faces = builtin_mesh(0.05)
        assert np.abs(vertices).max() < 1.5
        assert builtin_signed_distance(vertices).max() < 1e-9
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        middles = mesh.triangles_center[mesh.area_faces > 1e-10]
        assert (np.abs(builtin_signed_distance(middles)) < 0.05).all()
        points, _ = builtin_surface(200, torch.Generator().manual_seed(0))
        sampled = mesh.sample(20_000, seed=0)
        assert np.linalg.norm(points[:, None] - sampled, axis=-1).min(axis=1).max() < 0.06


class TestDepth:
    def test_ends_where_sphere_tracing_ends(self) -> None:
        pose = look_at_origin(30, 25)
        focal = 40.0
        depth = builtin_depth(torch.tensor(pose), torch.tensor([focal, focal, 16.0, 12.0]), 24, 32)
        assert depth.shape == (24, 32)
        assert depth.dtype == torch.float32
        rows, columns = np.mgrid[:24, :32] + 0.5
        camera = np.stack([(columns - 16) / focal, -(rows - 12) / focal, -np.ones_like(rows)], axis=-1)
        direction = (camera / np.linalg.norm(camera, axis=-1, keepdims=True)).reshape(-1, 3) @ pose[:3, :3].T
        t = np.zeros(len(direction))
        moving = np.arange(len(t))
        for _ in range(300):
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


class TestFiles:
    def test_loads_as_the_builtin_scene(self, folder: Path) -> None:
        scene = load_scene(folder, "builtin8", validation=10)
        assert scene.builtin
        assert (len(scene.train), len(scene.test), len(scene.validation)) == (8, 25, 10)
        assert 0.1 < float(scene.train.rgba[..., 3].mean()) < 0.5
        depth = builtin_depth(scene.test.poses[4], scene.test.intrinsics[4], SIZE, SIZE)
        solid = scene.test.rgba[4, ..., 3] == 1
        assert bool(torch.isfinite(depth[solid]).all())
        assert bool(((depth[solid] > scene.near) & (depth[solid] < scene.far)).all())

    def test_a_copy_under_another_name_is_still_marked(self, folder: Path, tmp_path: Path) -> None:
        copied = shutil.copytree(folder, tmp_path / "lego")
        assert load_scene(copied, "builtin8").builtin
        (copied / "builtin.json").unlink()
        assert not load_scene(copied, "builtin8").builtin

    def test_same_bytes_every_time(self, folder: Path, tmp_path: Path) -> None:
        again = builtin_scene(tmp_path, size=SIZE)
        names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
        assert names == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
        assert len(names) == 18 + 25 + 3
        assert all((folder / name).read_bytes() == (again / name).read_bytes() for name in names)
        assert sorted(p.name for p in tmp_path.iterdir()) == [f"lighthouse_{SIZE}"]

    def test_is_written_once(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(write, "_write", lambda *_: pytest.fail("written again"))
        assert builtin_scene(folder.parent, size=SIZE) == folder

    @pytest.mark.parametrize("damage", ["image", "version", "json"])
    def test_an_incomplete_folder_is_replaced(self, folder: Path, tmp_path: Path, damage: str) -> None:
        copied = tmp_path / folder.name
        shutil.copytree(folder, copied)
        if damage == "image":
            (copied / "test/r_7.png").unlink()
        elif damage == "json":
            (copied / "transforms_test.json").unlink()
        else:
            marker = json.loads((copied / "builtin.json").read_text())
            (copied / "builtin.json").write_text(json.dumps({**marker, "version": 0}))
        assert builtin_scene(tmp_path, size=SIZE) == copied
        assert len(load_scene(copied, "builtin8").test) == 25
        assert [p.name for p in tmp_path.iterdir()] == [folder.name]

    def test_leaves_other_folders_alone(self, tmp_path: Path) -> None:
        other = tmp_path / f"lighthouse_{SIZE}"
        other.mkdir()
        (other / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match=r"lighthouse_24: exists but is not the built-in scene"):
            builtin_scene(tmp_path, size=SIZE)
        assert (other / "notes.txt").read_text() == "mine"

    def test_nothing_is_left_when_writing_fails(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(folder: Path, size: int) -> None:
            folder.mkdir()
            (folder / "half").write_text("")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(write, "_write", fail)
        with pytest.raises(InputError, match=r"cannot be written \(No space left on device\)") as error:
            builtin_scene(tmp_path, size=SIZE)
        assert "\n" not in str(error.value)
        assert list(tmp_path.iterdir()) == []

    def test_nothing_is_left_when_interrupted(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(folder: Path, size: int) -> None:
            folder.mkdir()
            raise KeyboardInterrupt

        monkeypatch.setattr(write, "_write", interrupt)
        with pytest.raises(KeyboardInterrupt):
            builtin_scene(tmp_path, size=SIZE)
        assert list(tmp_path.iterdir()) == []

    def test_another_process_was_faster(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        original = write._write

        def meanwhile(fresh: Path, size: int) -> None:
            original(fresh, size)
            shutil.copytree(folder, tmp_path / folder.name)

        monkeypatch.setattr(write, "_write", meanwhile)
        assert builtin_scene(tmp_path, size=SIZE) == tmp_path / folder.name
        assert [p.name for p in tmp_path.iterdir()] == [folder.name]

    def test_a_file_in_the_way(self, tmp_path: Path) -> None:
        (tmp_path / "cache").write_text("")
        with pytest.raises(InputError, match="cannot be written"):
            builtin_scene(tmp_path / "cache", size=SIZE)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_unwritable(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(InputError, match="cannot be written"):
            builtin_scene(tmp_path, size=SIZE)

    def test_size(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="size: found 4, expected at least 8 pixels"):
            builtin_scene(tmp_path, size=4)
