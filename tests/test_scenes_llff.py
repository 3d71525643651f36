"""Forward-facing scenes: poses_bounds.npy and normalised device coordinates."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gridreg.errors import InputError
from gridreg.rendering.rays import Rays, box_intersection, camera_rays
from gridreg.scenes import load_scene, ndc_rays

WIDTH, HEIGHT, FOCAL = 12, 9, 10.0


def forward_poses(count: int) -> np.ndarray:
    """Cameras in a plane that look along -z, slightly turned, in a world that is itself turned and shifted."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        a = 0.05 * np.sin(k)
        poses[k, :3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
        poses[k, :3, 3] = [0.3 * np.cos(2.0 * k), 0.2 * np.sin(2.0 * k), 0.0]
    return poses


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "fern"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    c, s = np.cos(0.7), np.sin(0.7)
    world = np.eye(4)
    world[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    world[:3, 3] = [5, -3, 2]
    rows = []
    for k, pose in enumerate(world @ forward_poses(9)):
        right, up, back, place = pose[:3].T
        matrix = np.stack([-up, right, back, place, [HEIGHT, WIDTH, FOCAL]], axis=-1)
        rows.append([*matrix.ravel(), 4.0 + k, 60.0])
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"images/IMG_{k:02d}.JPG", quality=95)
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def test_reads_a_forward_facing_scene(scene: Path) -> None:
    loaded = load_scene(scene, "spread3")
    assert loaded.ndc
    assert loaded.test.names == ("IMG_00", "IMG_08")
    assert loaded.train.names == ("IMG_01", "IMG_04", "IMG_07")
    assert loaded.train.intrinsics[0].tolist() == [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    assert loaded.near == 0
    assert bool((loaded.train.rgba[..., 3] == 1).all())


def test_poses_are_scaled_and_centred_as_in_nerf(scene: Path) -> None:
    loaded = load_scene(scene, "holdout8")
    poses = np.empty((9, 4, 4))
    poses[::8], poses[[k for k in range(9) if k % 8]] = loaded.test.poses, loaded.train.poses
    # The nearest depth, 4, becomes 4 / 3; the average camera becomes the identity.
    expected = forward_poses(9)
    expected[:, :3, 3] /= 3
    np.testing.assert_allclose(poses[:, :3, 3].mean(axis=0), 0, atol=1e-5)
    back = poses[:, :3, 2].sum(axis=0)
    np.testing.assert_allclose(back / np.linalg.norm(back), [0, 0, 1], atol=1e-5)
    gaps = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
    wanted = np.linalg.norm(expected[:, None, :3, 3] - expected[None, :, :3, 3], axis=-1)
    np.testing.assert_allclose(gaps, wanted, atol=1e-5)
    relative = np.linalg.inv(poses[0]) @ poses[5]
    np.testing.assert_allclose(relative, np.linalg.inv(expected[0]) @ expected[5], atol=1e-5)


def refused(folder: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        load_scene(folder, "holdout8", **options)
    assert "\n" not in str(error.value)


class TestBadInput:
    def test_number_of_images(self, scene: Path) -> None:
        (scene / "images/IMG_03.JPG").unlink()
        refused(scene, r"poses_bounds\.npy: holds 9 poses, but .*images holds 8 images")
        shutil.rmtree(scene / "images")
        refused(scene, r"holds 9 poses, but .*images holds 0 images")

    def test_size(self, scene: Path) -> None:
        Image.new("RGB", (HEIGHT, WIDTH)).save(scene / "images/IMG_03.JPG")
        refused(scene, r"IMG_03\.JPG: image is 9x12, expected w x h of its camera, 12x9")

    @pytest.mark.parametrize("content", [b"", b"hello", b"\x93NUMPY\x01\x00"])
    def test_not_numpy(self, scene: Path, content: bytes) -> None:
        (scene / "poses_bounds.npy").write_bytes(content)
        refused(scene, r"poses_bounds\.npy: not a NumPy file")

    def test_never_unpickles(self, scene: Path) -> None:
        np.save(scene / "poses_bounds.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
        refused(scene, r"poses_bounds\.npy: not a NumPy file")

    @pytest.mark.parametrize("shape", [(9, 15), (17,), (9, 17, 1)])
    def test_shape(self, scene: Path, shape: tuple[int, ...]) -> None:
        np.save(scene / "poses_bounds.npy", np.ones(shape))
        refused(scene, r"poses_bounds\.npy: found shape .*, expected \(N, 17\) numbers")

    def test_words(self, scene: Path) -> None:
        np.save(scene / "poses_bounds.npy", np.full((9, 17), "a"))
        refused(scene, r"expected \(N, 17\) numbers")

    @pytest.mark.parametrize(
        ("column", "value", "pattern"),
        [
            (3, np.nan, "holds no poses, or numbers that are not finite"),
            (14, 0.0, "expected positive sizes and focal lengths"),
            (15, 0.0, "depths 0 < near < far"),
            (16, 1.0, "depths 0 < near < far"),
            (0, 9.0, r"pose 2: transform_matrix is not rigid"),
        ],
    )
    def test_numbers(self, scene: Path, column: int, value: float, pattern: str) -> None:
        rows = np.load(scene / "poses_bounds.npy")
        rows[2, column] = value
        np.save(scene / "poses_bounds.npy", rows)
        refused(scene, pattern)

    def test_no_rows(self, scene: Path) -> None:
        np.save(scene / "poses_bounds.npy", np.ones((0, 17)))
        for path in (scene / "images").iterdir():
            path.unlink()
        refused(scene, "holds no poses")


depths = st.floats(1.01, 1e4)
offsets = st.floats(-1.0, 1.0)


class TestNormalisedCoordinates:
    intrinsics = torch.tensor([FOCAL, FOCAL + 1, WIDTH / 2, HEIGHT / 2], dtype=torch.float64)

    def project(self, points: np.ndarray) -> np.ndarray:
        """OpenGL's perspective projection with near plane 1 and infinite far plane, as NeRF's appendix derives it."""
        x, y, z = points.T
        right, top = WIDTH / (2 * FOCAL), HEIGHT / (2 * (FOCAL + 1))
        return np.stack([x / (-z) / right, y / (-z) / top, 1 + 2 / z], axis=-1)

    @given(offsets, offsets, offsets, offsets, offsets, depths)
    def test_points_of_a_ray_stay_on_the_mapped_ray(
        self, ox: float, oy: float, oz: float, dx: float, dy: float, depth: float
    ) -> None:
        origin = torch.tensor([[ox, oy, 0.5 * oz]], dtype=torch.float64)
        direction = torch.nn.functional.normalize(torch.tensor([[dx, dy, -1.0]], dtype=torch.float64), dim=-1)
        start, way = ndc_rays(origin, direction, self.intrinsics, HEIGHT, WIDTH)
        assert float(way.norm()) == pytest.approx(1)
        assert float(start[0, 2]) == pytest.approx(-1)
        reach = (depth + float(origin[0, 2])) / -float(direction[0, 2])
        mapped = self.project((origin + reach * direction).numpy())
        gap = mapped - start.numpy()
        t = float((gap * way.numpy()).sum())
        np.testing.assert_allclose(gap, t * way.numpy(), atol=1e-6)
        assert t >= -1e-9

    def test_rays_fill_the_box_of_the_scene(self, scene: Path) -> None:
        loaded = load_scene(scene, "holdout8")
        for pose, intrinsics in zip(loaded.train.poses, loaded.train.intrinsics, strict=True):
            rays = camera_rays(pose, intrinsics, HEIGHT, WIDTH)
            start, way = ndc_rays(rays.origins, rays.directions, intrinsics, HEIGHT, WIDTH)
            t_min, t_max = box_intersection(Rays(start, way), loaded.bounds, loaded.near, loaded.far)
            # Every ray runs through the box until it leaves it at infinity or to a side.
            assert bool((t_max > t_min).all())
            assert bool((t_min < 1e-5).all())
            ends = start + t_max[:, None] * way
            assert float((ends[:, 2] > 0.99).float().mean()) > 0.8
