"""Lenses, and camera files that read back or are refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export.camera_files import load_cameras, save_cameras
from gridreg.export.camera_paths import turntable
from gridreg.export.cameras import look_at, orbit_of_box
from gridreg.rendering.cameras import Lens

LENS = Lens.from_angle(45.0, 30, 40)
BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


class TestLens:
    def test_resized_sees_the_same(self):
        lens = Lens((50.0, 52.0, 21.0, 14.0), 30, 40)
        small = lens.resized(20)
        assert (small.width, small.height) == (20, 15)
        assert small.intrinsics == (25.0, 26.0, 10.5, 7.0)

    @pytest.mark.parametrize(
        "arguments",
        [
            ((50.0, 50.0, 20.0, 15.0), 0, 40),
            ((0.0, 50.0, 20.0, 15.0), 30, 40),
            ((50.0, 50.0, math.nan, 15.0), 30, 40),
        ],
    )
    def test_refuses_what_cannot_be(self, arguments):
        with pytest.raises(InputError):
            Lens(*arguments)

    def test_refuses_angles_without_a_image(self):
        with pytest.raises(InputError, match=r"angle=180\.0"):
            Lens.from_angle(180.0, 10, 10)


class TestFiles:
    def test_read_back(self, tmp_path):
        cameras = turntable(orbit_of_box(BOX), Lens((50.0, 52.0, 21.0, 14.0), 30, 40), 3)
        save_cameras(tmp_path / "a.json", cameras)
        back = load_cameras(tmp_path / "a.json")
        assert [c.lens for c in back] == [c.lens for c in cameras]
        assert all(torch.equal(a.pose, b.pose) for a, b in zip(back, cameras, strict=True))

    def test_transforms_of_a_scene_are_a_path(self, tmp_path):
        pose = look_at(np.array([3.0, 0, 1]), np.zeros(3), np.array([0.0, 0, 1])).tolist()
        path = tmp_path / "transforms_test.json"
        path.write_text(
            json.dumps(
                {
                    "camera_angle_x": math.pi / 2,
                    "frames": [{"file_path": "./test/r_0", "transform_matrix": pose}],
                }
            )
        )
        with pytest.raises(InputError, match="frame 0: has no w"):
            load_cameras(path)
        (camera,) = load_cameras(path, LENS)
        assert camera.lens.intrinsics == pytest.approx((20.0, 20.0, 20.0, 15.0))

    def test_lens_of_the_caller_where_the_file_has_none(self, tmp_path):
        path = tmp_path / "a.json"
        path.write_text(json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]}))
        assert load_cameras(path, LENS)[0].lens == LENS
        with pytest.raises(InputError, match="has no fl_x and no camera_angle_x"):
            load_cameras(path)

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("{", "not valid JSON"),
            ("[]", "found a list, expected a JSON object"),
            (
                '{"w": 4, "h": 3, "frames": [{"fl_x": 4, "cx": 9, "transform_matrix": EYE}]}',
                "principal point",
            ),
            ('{"frames": []}', "found no list 'frames'"),
            ('{"frames": [3]}', "frame 0: has no transform_matrix"),
            ('{"frames": [{"transform_matrix": [[1]]}]}', r"frame 0: transform_matrix has shape \(1, 1\)"),
            ('{"frames": [{"fl_x": "a", "transform_matrix": EYE}]}', "has no w"),
            ('{"w": 4, "h": 3, "frames": [{"fl_x": "a", "transform_matrix": EYE}]}', "found fl_x='a'"),
            ('{"w": 4, "h": 3, "frames": [{"fl_x": -1, "transform_matrix": EYE}]}', "frame 0: intrinsics"),
            ('{"w": 4.5, "h": 3, "frames": [{"fl_x": 1, "transform_matrix": EYE}]}', "whole pixels"),
            ('{"w": NaN, "h": 3, "frames": [{"fl_x": 1, "transform_matrix": EYE}]}', "found w=nan"),
        ],
    )
    def test_bad_files_are_told_in_one_line(self, tmp_path, text, said):
        path = tmp_path / "bad.json"
        path.write_text(text.replace("EYE", str(np.eye(4).tolist())))
        with pytest.raises(InputError, match=said) as error:
            load_cameras(path)
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)

    def test_missing_and_binary_files(self, tmp_path):
        with pytest.raises(InputError, match="file not found"):
            load_cameras(tmp_path / "none.json")
        (tmp_path / "b.json").write_bytes(b"\xff\xfe\x00")
        with pytest.raises(InputError, match="not valid JSON"):
            load_cameras(tmp_path / "b.json")
