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
from gridreg.scenes import builtin_photographs, load_scene, photograph_mesh, prepare
from tests.programs import ROOT, module_at

bodies = module_at(ROOT / "benchmarks" / "bodies.py")
own_photographs = module_at(ROOT / "benchmarks" / "own_photographs.py")
own_sheet = module_at(ROOT / "benchmarks" / "own_sheet.py")


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
    shape, coloured = (bodies.mesh_image(mesh, camera, colours=c, points=200_000) for c in (False, True))
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


class TestSheet:
    @pytest.fixture(scope="class")
    @classmethod
    def truth(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        made = builtin_photographs(tmp_path_factory.getbasetemp() / "scenes", count=6, size=400)
        return made / "truth"

    def scene(self, truth: Path, folder: Path) -> Path:
        """A scene as `prepare` writes one, with the true cameras and masks: crops of 300 pixels at half the size."""
        content = json.loads((truth / "transforms.json").read_text())
        frames = []
        for name in ("images", "masks"):
            (folder / name).mkdir(parents=True)
        for frame in content["frames"][:6]:
            left, top = (
                min(max(0, round(frame[c]) - 150), frame[n] - 300) for c, n in (("cx", "w"), ("cy", "h"))
            )
            for key in ("file_path", "mask_path"):
                with Image.open(truth / frame[key]) as image:
                    box = (left, top, left + 300, top + 300)
                    image.resize((150, 150), Image.Resampling.BOX, box=box).save(folder / frame[key])
            lens = {key: frame[key] / 2 for key in ("fl_x", "fl_y")}
            centre = {"cx": (frame["cx"] - left) / 2, "cy": (frame["cy"] - top) / 2}
            frames.append({**frame, **lens, **centre, "w": 150, "h": 150})
        extent = {"near": 0.1, "far": 0.6, "bounds": [[-0.1, -0.1, 0], [0.1, 0.1, 0.2]], "unit": "metre"}
        (folder / "transforms.json").write_text(json.dumps({"gridreg": extent, "frames": frames}))
        return folder

    def test_truth_has_no_error(self, truth: Path, tmp_path: Path) -> None:
        scene = self.scene(truth, tmp_path / "scene")
        assert max(own_sheet.camera_errors(scene, truth).values()) < 1e-5
        assert own_sheet.mask_overlap(scene, truth)["least"] > 0.97

    def test_known_errors(self, truth: Path, tmp_path: Path) -> None:
        scene = self.scene(truth, tmp_path / "scene")
        content = json.loads((scene / "transforms.json").read_text())
        pose = np.array(content["frames"][2]["transform_matrix"])
        turn = math.radians(2)
        c, s = math.cos(turn), math.sin(turn)
        pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        pose[:3, 3] *= 1.01
        content["frames"][2]["transform_matrix"] = pose.tolist()
        (scene / "transforms.json").write_text(json.dumps(content))
        mask = scene / content["frames"][4]["mask_path"]
        half = np.array(Image.open(mask))
        rows = np.flatnonzero(half.any(axis=1))
        half[rows[len(rows) // 2] :] = 0
        Image.fromarray(half).save(mask)
        errors = own_sheet.camera_errors(scene, truth)
        assert errors["rotation_degrees_max"] == pytest.approx(2)
        assert errors["position_percent_max"] == pytest.approx(1)
        assert errors["position_percent_median"] < 1e-9
        assert 0.1 < own_sheet.mask_overlap(scene, truth)["least"] < 0.6

    def test_true_and_estimated_scenes_share_test_views(self, truth: Path, tmp_path: Path) -> None:
        scene = self.scene(truth, tmp_path / "scene")
        both = [
            own_sheet.with_test_views(scene, truth, tmp_path / str(true), true=true) for true in (False, True)
        ]
        first, second = (load_scene(folder, "holdout8") for folder in both)
        assert (len(first.train), len(first.test)) == (6, 8)
        assert torch.equal(first.test.rgba, second.test.rgba)
        torch.testing.assert_close(first.train.poses, second.train.poses)
        torch.testing.assert_close(first.train.intrinsics, second.train.intrinsics)
        # The object is in the middle of the test views.
        alpha = first.test.rgba[..., 3]
        assert float(alpha[:, 40:110, 40:110].sum() / alpha.sum()) > 0.9

    def test_mesh(self, tmp_path: Path) -> None:
        vertices, faces = photograph_mesh(0.05)
        Mesh(vertices, faces).to_trimesh().export(tmp_path / "same.ply")
        Mesh(1.03 * vertices, faces).to_trimesh().export(tmp_path / "larger.ply")
        same, larger = (own_sheet.mesh_errors(tmp_path / f"{name}.ply") for name in ("same", "larger"))
        assert same["chamfer_percent"] < 0.2
        assert same["size_percent"] == pytest.approx(0, abs=0.05)
        assert larger["size_percent"] == pytest.approx(3, abs=0.05)
        assert larger["chamfer_percent"] > 3 * same["chamfer_percent"] + 0.1
