"""Bad frame lists: one clear line for each, naming file and frame, what was found and what is expected."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


@pytest.fixture
def scene(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "lego"))


def refused(folder: Path, pattern: str, protocol: str = "builtin8", **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        load_scene(folder, protocol, **options)
    assert "\n" not in str(error.value)


def edit(scene: Path, change: Callable[[dict[str, Any]], Any], split: str = "train") -> None:
    path = scene / f"transforms_{split}.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


class TestJson:
    @pytest.mark.parametrize("split", ["train", "test"])
    @pytest.mark.parametrize(
        "text", ["", "{", '{"frames": [}', "\ufeff{}x", pytest.param("[" * 100_000, id="deep")]
    )
    def test_invalid(self, scene: Path, split: str, text: str) -> None:
        (scene / f"transforms_{split}.json").write_text(text)
        refused(scene, rf"transforms_{split}\.json: not valid JSON")

    def test_not_utf8(self, scene: Path) -> None:
        (scene / "transforms_train.json").write_bytes(b"\xff\xfe\x00{")
        refused(scene, r"transforms_train\.json: not valid JSON")

    @pytest.mark.parametrize("text", ["[]", "3", '"frames"', "null"])
    def test_not_an_object(self, scene: Path, text: str) -> None:
        (scene / "transforms_train.json").write_text(text)
        refused(scene, r"transforms_train\.json: found a \w+, expected a JSON object")

    def test_missing_test_file(self, scene: Path) -> None:
        (scene / "transforms_test.json").unlink()
        refused(scene, r"transforms_test\.json: file not found")

    def test_unreadable_file(self, scene: Path) -> None:
        (scene / "transforms_test.json").unlink()
        (scene / "transforms_test.json").mkdir()
        refused(scene, r"transforms_test\.json: cannot be read")

    def test_missing_frames(self, scene: Path) -> None:
        edit(scene, lambda c: c.pop("frames"))
        refused(scene, r"transforms_train\.json: key 'frames' is missing")

    @pytest.mark.parametrize("frames", [[], {}, "frames", 7])
    def test_empty_frames(self, scene: Path, frames: object) -> None:
        edit(scene, lambda c: c.update(frames=frames))
        refused(scene, r"transforms_train\.json: 'frames' is not a list with at least one frame")

    def test_frame_that_is_no_object(self, scene: Path) -> None:
        edit(scene, lambda c: c["frames"].insert(1, "r_1"))
        refused(scene, r"transforms_train\.json: frame 1: found a str, expected a JSON object")

    @pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
    def test_missing_key_of_a_frame(self, scene: Path, key: str) -> None:
        edit(scene, lambda c: c["frames"][3].pop(key))
        refused(scene, rf"transforms_train\.json: frame 3: key '{key}' is missing")

    def test_missing_focal_length(self, scene: Path) -> None:
        edit(scene, lambda c: c.pop("camera_angle_x"))
        refused(scene, r"frame 0: key 'camera_angle_x' \(or 'fl_x'\) is missing")

    @pytest.mark.parametrize(
        ("key", "value", "pattern"),
        [
            ("camera_angle_x", 0, "camera_angle_x is 0.0, expected radians between 0 and pi"),
            ("camera_angle_x", 3.2, "camera_angle_x is 3.2, expected radians"),
            ("camera_angle_x", "0.69", "camera_angle_x is '0.69', expected a finite number"),
            ("camera_angle_x", float("nan"), "camera_angle_x is 'nan', expected a finite number"),
            ("fl_x", -5, "fl_x is -5.0, expected a positive number of pixels"),
            ("fl_y", 0, "fl_y is 0.0, expected a positive"),
            ("cx", True, "cx is 'True', expected a finite number"),
            ("cy", float("inf"), "cy is 'inf', expected a finite number"),
            ("w", -3, "w is -3.0, expected a positive number of pixels"),
            ("h", 0, "h is 0.0, expected a positive number of pixels"),
            pytest.param("w", 10**400, "w is '10+', expected a finite number", id="huge"),
        ],
    )
    def test_bad_numbers(self, scene: Path, key: str, value: object, pattern: str) -> None:
        edit(scene, lambda c: c.update({key: value}))
        refused(scene, rf"transforms_train\.json: frame 0: {pattern}")

    @pytest.mark.parametrize("key", ["k1", "k2", "k3", "k4", "p1", "p2"])
    def test_lens_distortion_that_is_no_number(self, scene: Path, key: str) -> None:
        edit(scene, lambda c: c.update({key: "strong"}))
        refused(scene, rf"frame 0: {key} is 'strong', expected a finite number")

    def test_lens_distortion_too_strong_to_undo(self, scene: Path) -> None:
        edit(scene, lambda c: c.update(k1=-500.0))
        refused(scene, r"transforms_train\.json: frame 0: lens distortion .*k1=-500\.0.* is too strong")

    @pytest.mark.parametrize(
        "lens", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}, {"camera_model": 3}]
    )
    def test_fisheyes_are_refused_by_name(self, scene: Path, lens: dict[str, Any]) -> None:
        edit(scene, lambda c: c.update(lens))
        refused(scene, r"frame 0: camera_model is .*, expected one of OPENCV, PINHOLE")


def spoil(matrix: list[list[float]], kind: str) -> object:
    pose = np.array(matrix)
    if kind == "nan":
        pose[1, 3] = np.nan
    elif kind == "infinite":
        pose[0, 0] = np.inf
    elif kind == "scaled":
        pose[:3, :3] *= 1.01
    elif kind == "sheared":
        pose[0, 1] += 0.1
    elif kind == "huge":
        pose[:3, :3] *= 1e200
    elif kind == "mirrored":
        pose[:3, 0] *= -1
    elif kind == "last row":
        pose[3] = [0, 0, 0, 2]
    elif kind == "shape":
        return pose[:3, :3].tolist()
    elif kind == "ragged":
        return [[1, 2], [3]]
    elif kind == "words":
        return [["a"] * 4] * 4
    elif kind == "null":
        return None
    return pose.tolist()


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("nan", "transform_matrix holds a number that is not finite"),
        ("infinite", "transform_matrix holds a number that is not finite"),
        ("scaled", "transform_matrix is not rigid"),
        ("sheared", "transform_matrix is not rigid"),
        ("huge", "transform_matrix is not rigid"),
        ("mirrored", "transform_matrix mirrors"),
        ("last row", r"transform_matrix has the last row \[0.0, 0.0, 0.0, 2.0\], expected 0 0 0 1"),
        ("shape", r"transform_matrix has shape \(3, 3\), expected \(4, 4\)"),
        ("ragged", "transform_matrix is not a 4x4 matrix of numbers"),
        ("words", "transform_matrix is not a 4x4 matrix of numbers"),
        ("null", r"transform_matrix has shape \(\), expected"),
    ],
)
def test_poses(scene: Path, kind: str, pattern: str) -> None:
    edit(
        scene,
        lambda c: c["frames"][1].update(transform_matrix=spoil(c["frames"][1]["transform_matrix"], kind)),
    )
    refused(scene, rf"transforms_train\.json: frame 1: {pattern}")


def test_a_pose_without_its_last_row_is_fine(scene: Path) -> None:
    expected = load_scene(scene, "builtin8").train.poses
    edit(scene, lambda c: c["frames"][1]["transform_matrix"].pop())
    assert torch.equal(load_scene(scene, "builtin8").train.poses, expected)
