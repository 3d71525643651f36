"""The benchmarks of bodies and of one's own photographs: what they compute besides training."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image

from gridreg.export import Camera, Lens, Mesh, look_at
from gridreg.scenes import prepare
from tests.programs import ROOT, module_at

bodies = module_at(ROOT / "benchmarks" / "bodies.py")
own_photographs = module_at(ROOT / "benchmarks" / "own_photographs.py")


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, ::-1]


@given(st.integers(0, 10_000), st.floats(0.05, 20))
def test_similarity_is_found_again(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points, turn, shift = rng.normal(size=(9, 3)), rotation(seed), rng.normal(size=3)
    found = own_photographs.similarity(points, scale * points @ turn.T + shift)
    assert found[0] == pytest.approx(scale)
    np.testing.assert_allclose(found[1], turn, atol=1e-9)
    np.testing.assert_allclose(found[2], shift, atol=1e-8 * max(1, scale))


def test_misplaced_cameras_do_not_bend_the_similarity() -> None:
    rng = np.random.default_rng(3)
    points, turn = rng.normal(size=(30, 3)), rotation(3)
    target = 2 * points @ turn.T + [1, 2, 3] + 1e-4 * rng.normal(size=(30, 3))
    target[[4, 9, 20]] += 5.0
    scale, found, shift = own_photographs.robust_similarity(points, target)
    assert scale == pytest.approx(2, rel=1e-3)
    np.testing.assert_allclose(found, turn, atol=1e-3)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-3)


def test_photographs_are_as_a_phone_takes_them(tmp_path: Path) -> None:
    poses = own_photographs.poses_around(9)
    assert len(poses) == 9
    focal = own_photographs.take_photographs(tmp_path / "photographs", poses[:2], 24)
    with Image.open(tmp_path / "photographs/photograph_001.jpg") as photograph:
        assert photograph.size == (24, 24)
        assert photograph.mode == "RGB"
        noted = photograph.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm]
    assert noted == pytest.approx(focal * math.hypot(36, 24) / math.hypot(24, 24), abs=0.5)


def test_true_cameras_in_the_world_of_a_prepared_scene(tmp_path: Path) -> None:
    poses = own_photographs.poses_around(10)
    focal = own_photographs.take_photographs(tmp_path / "photographs", poses, 16)
    # Cameras in a world of their own, one of them misplaced.
    turn, frames = np.eye(4), []
    turn[:3, :3] = rotation(1)
    for k, pose in enumerate(poses):
        moved = turn @ pose
        moved[:3, 3] = 0.5 * moved[:3, 3] + [1, 0, -2]
        frames.append(
            {"file_path": f"photographs/photograph_{k:03d}.jpg", "transform_matrix": moved.tolist()}
        )
    frames[3]["transform_matrix"] = frames[4]["transform_matrix"]
    content = {"w": 16, "h": 16, "fl_x": 1.1 * focal, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    prepare(tmp_path, tmp_path / "out/scene")
    truth = {f"photograph_{k:03d}": pose for k, pose in enumerate(poses)}
    errors = own_photographs.with_true_cameras(tmp_path / "out/scene", tmp_path / "out/true", truth, focal)
    assert errors["misplaced"] == 1
    assert errors["rotation_degrees_median"] < 1e-3
    assert errors["position_share_of_distance_median"] < 1e-4
    assert errors["focal_share"] == pytest.approx(0.1, abs=1e-6)
    estimated, true = (
        json.loads((tmp_path / "out" / name / "transforms.json").read_text()) for name in ("scene", "true")
    )
    assert true["gridreg"] == estimated["gridreg"]
    assert true["fl_x"] == pytest.approx(focal)
    np.testing.assert_allclose(
        true["frames"][0]["transform_matrix"], estimated["frames"][0]["transform_matrix"], atol=1e-4
    )


def tetrahedron() -> Mesh:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) - 0.25
    colours = np.full((4, 3), [200, 20, 20], np.uint8)
    return Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), colours)


def test_images_of_meshes() -> None:
    mesh = tetrahedron()
    place = np.array([4.0, 4.0, 4.0])
    camera = Camera(look_at(place, np.zeros(3), np.array([0.0, 0, 1])), Lens.from_angle(25.0, 120, 120))
    shape, coloured = (bodies.mesh_image(mesh, camera, coloured=c, samples=200_000) for c in (False, True))
    inside = (shape != 255).any(axis=-1)
    # The outline of the corners, without holes.
    local = (mesh.vertices - place) @ camera.pose[:3, :3].double().numpy()
    fx, fy, cx, cy = camera.lens.intrinsics
    x, y = cx + fx * local[:, 0] / -local[:, 2], cy - fy * local[:, 1] / -local[:, 2]
    triangle = np.stack([x, y], axis=1)[1:]
    sides = np.roll(triangle, -1, axis=0) - triangle
    area = abs(sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0]) / 2
    assert inside.sum() == pytest.approx(area, rel=0.15)
    # The face x + y + z = const looks at the camera: full light, even grey.
    assert np.ptp(shape[inside].astype(int)) < 25
    assert coloured[60, 60, 0] > 3 * coloured[60, 60, 1]
    assert not np.array_equal(shape, coloured)


def test_results_are_told_apart_and_tabulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = argparse.Namespace(steps=None, preset="human", seed=0)
    names = [bodies.record_name("a", p, arguments) for p in ("human8", "human50")]
    arguments.steps = 100
    names.append(bodies.record_name("a", "human8", arguments))
    assert len(set(names)) == 3
    figures = {
        "chamfer_relative": 0.0123,
        "accuracy_relative": 0.01,
        "completeness_relative": 0.02,
        "f_score": 0.75,
        "normal_consistency": 0.9,
    }
    record = {
        "name": "a",
        "scene": "a",
        "protocol": "human8",
        "steps": 5,
        "seed": 0,
        "mean": {"psnr": 25.0, "ssim_gaussian": 0.9},
        "mesh": figures,
        "seconds": {"train": 60.0},
    }
    (tmp_path / "bodies.jsonl").write_text(json.dumps(record))
    bodies.table(tmp_path)
    head, rule, line = capsys.readouterr().out.splitlines()
    assert head.count("|") == rule.count("|") == line.count("|") == 13
    assert "| 1.23% |" in line


def test_cameras_stand_around_the_body() -> None:
    places = bodies.cameras(tetrahedron())
    assert len(places) == 3
    front, _, behind = (camera.pose[:3, 3] for camera in places)
    assert float(front[1]) < 0 < float(behind[1])
    assert torch.allclose(front.norm(), behind.norm(), rtol=0.2)
