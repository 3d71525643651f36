"""Bad scenes: one clear line for each, naming the file or argument, what was found and what is expected."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import Scene, Views, background_colour, builtin_scene, load_scene

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


class TestImages:
    def test_missing(self, scene: Path) -> None:
        (scene / "test/r_4.png").unlink()
        refused(scene, r"transforms_test\.json: frame 4: image .*test/r_4 not found")

    def test_truncated(self, scene: Path) -> None:
        path = scene / "train/r_2.png"
        path.write_bytes(path.read_bytes()[:-60])
        refused(scene, r"train/r_2\.png: not a whole image")

    def test_not_an_image(self, scene: Path) -> None:
        (scene / "train/r_2.png").write_text("hello")
        refused(scene, r"train/r_2\.png: not an image that can be read, expected a whole PNG, JPEG")

    def test_no_alpha(self, scene: Path) -> None:
        Image.new("RGB", (SIZE, SIZE)).save(scene / "train/r_2.png")
        refused(scene, r"train/r_2\.png: image has no alpha channel, expected RGBA")

    @pytest.mark.parametrize("split", ["train", "test"])
    def test_another_size_than_the_others(self, scene: Path, split: str) -> None:
        Image.new("RGBA", (SIZE, SIZE + 1)).save(scene / split / "r_3.png")
        refused(scene, rf"{split}/r_3\.png: image is 16x17, expected 16x16 as before")

    def test_another_size_than_the_file_states(self, scene: Path) -> None:
        edit(scene, lambda c: c.update(w=32, h=SIZE))
        refused(scene, r"train/r_0\.png: image is 16x16, expected w x h of its camera, 32x16")

    @pytest.mark.parametrize("size", [0, -8, 5, 32])
    def test_size_that_does_not_divide(self, scene: Path, size: int) -> None:
        refused(scene, rf"size: found {size}, expected a divisor of the width of .*r_0\.png, 16", size=size)

    def test_height_that_does_not_divide(self, scene: Path) -> None:
        for k in range(8):
            Image.new("RGBA", (SIZE, SIZE + 1)).save(scene / f"train/r_{k}.png")
        refused(scene, r"train/r_0\.png: image is 16x17, expected edges divisible by 2", size=8)


class TestContainment:
    @pytest.mark.parametrize(
        "file_path", ["../outside", "../outside.png", "train/../../outside.png", "./../lego/../outside", ".."]
    )
    def test_climbing(self, scene: Path, file_path: str) -> None:
        shutil.copy(scene / "train/r_0.png", scene.parent / "outside.png")
        edit(scene, lambda c: c["frames"][0].update(file_path=file_path))
        refused(scene, r"frame 0: file_path .* leads out of the scene folder")

    def test_climbing_says_the_same_whether_or_not_something_is_there(self, scene: Path) -> None:
        edit(scene, lambda c: c["frames"][0].update(file_path="../nothing.png"))
        refused(scene, r"leads out of the scene folder")

    def test_absolute_even_when_inside(self, scene: Path) -> None:
        edit(scene, lambda c: c["frames"][0].update(file_path=str(scene / "train/r_0.png")))
        refused(scene, r"is not a path relative to the scene folder")

    @pytest.mark.parametrize("name", ["r_0", "r_0.png"])
    def test_symbolic_link_to_a_file(self, scene: Path, name: str) -> None:
        shutil.move(scene / "train/r_0.png", scene.parent / "outside.png")
        os.symlink(scene.parent / "outside.png", scene / "train" / name)
        refused(scene, r"frame 0: file_path './train/r_0' leads out of the scene folder")

    def test_symbolic_link_to_a_folder(self, scene: Path) -> None:
        shutil.move(scene / "train", scene.parent / "elsewhere")
        os.symlink(scene.parent / "elsewhere", scene / "train")
        assert len(load_scene(scene, "builtin8").train) == 8

    def test_symbolic_link_out_of_a_linked_folder(self, scene: Path) -> None:
        self.test_symbolic_link_to_a_folder(scene)
        shutil.move(scene / "train/r_0.png", scene.parent / "outside.png")
        os.symlink(scene.parent / "outside.png", scene / "train/r_0.png")
        refused(scene, r"frame 0: file_path './train/r_0' leads out of the scene folder")

    def test_a_link_inside_the_scene_is_fine(self, scene: Path) -> None:
        shutil.move(scene / "train/r_0.png", scene / "moved.png")
        os.symlink(scene / "moved.png", scene / "train/r_0.png")
        assert len(load_scene(scene, "builtin8").train) == 8

    def test_a_loop_of_links(self, scene: Path) -> None:
        os.remove(scene / "train/r_0.png")
        os.symlink(scene / "train/r_0.png", scene / "train/r_0.png")
        refused(scene, r"frame 0: (file_path .* cannot be followed|image .* not found)")

    @pytest.mark.parametrize("file_path", ["", "a\0b"])
    def test_not_a_path(self, scene: Path, file_path: str) -> None:
        edit(scene, lambda c: c["frames"][0].update(file_path=file_path))
        refused(scene, r"is not a path relative to the scene folder")

    def test_too_long(self, scene: Path) -> None:
        edit(scene, lambda c: c["frames"][0].update(file_path="x" * 5000))
        refused(scene, r"frame 0: file_path 'x+ ... x+' cannot be followed")

    def test_a_number(self, scene: Path) -> None:
        edit(scene, lambda c: c["frames"][0].update(file_path=3))
        refused(scene, r"frame 0: file_path is a int, expected a string")


class TestArguments:
    def test_protocol_wants_more_than_there_is(self, scene: Path) -> None:
        refused(
            scene,
            r"protocol dietnerf8: view 26 is not in .*transforms_train\.json, .* frames 0 to 17",
            "dietnerf8",
        )
        refused(scene, r"protocol views100: view 18 is not in", "views100")
        refused(scene, r"protocol human50: view 18 is not in", "human50")

    @pytest.mark.parametrize("ids", [[25], [-1], [1.5], [True], ["0"]])
    def test_test_ids(self, scene: Path, ids: list[Any]) -> None:
        refused(
            scene, r"test: view .* is not in .*transforms_test\.json, which lists frames 0 to 24", test=ids
        )

    def test_repeated_ids(self, scene: Path) -> None:
        refused(scene, r"test: a view is listed twice in \[1, 1\]", test=[1, 1])

    @pytest.mark.parametrize("wanted", [0, 11, -2])
    def test_too_many_validation_views(self, scene: Path, wanted: int) -> None:
        refused(scene, rf"validation: found {wanted}, expected 1 to 10 views", validation=wanted)

    def test_a_validation_protocol_without_frames_left(self, scene: Path) -> None:
        with pytest.raises(InputError, match="first12-validation: found 10, expected 1 to 6 views outside"):
            load_scene(scene, "first12-validation")

    def test_validation_on_training_views(self, scene: Path) -> None:
        refused(scene, r"validation: views \[3\] are training views", validation=[3, 9])

    def test_validation_out_of_range(self, scene: Path) -> None:
        refused(scene, r"validation: view 18 is not in", validation=[18])

    def test_unknown_protocol(self, scene: Path) -> None:
        refused(scene, r"protocol: found 'nerf', expected one of", "nerf")

    @pytest.mark.parametrize("background", ["grey", (1, 1), (0, 0, 2), (0.1, 0.2, float("nan"))])
    def test_background(self, scene: Path, background: Any) -> None:
        refused(scene, "background: found", background=background)

    @pytest.mark.parametrize(("near", "far"), [(2, 2), (3, 1), (-1, 4), (float("nan"), 4)])
    def test_near_and_far(self, scene: Path, near: float, far: float) -> None:
        refused(scene, "near, far: found", near=near, far=far)

    @pytest.mark.parametrize(
        "bounds",
        [
            [[1, 1, 1], [-1, -1, -1]],
            [[0, 0, 0]],
            [["a"] * 3] * 2,
            [[0, 0], [1]],
            [[0, 0, 0], [1, 1, float("nan")]],
        ],
    )
    def test_bounds(self, scene: Path, bounds: Any) -> None:
        refused(scene, "bounds: found", bounds=bounds)

    def test_no_folder(self, tmp_path: Path) -> None:
        refused(tmp_path / "nothing", "nothing: no such scene folder")

    def test_a_file(self, scene: Path) -> None:
        refused(scene / "builtin.json", r"builtin\.json: no such scene folder")

    def test_a_folder_without_a_scene(self, tmp_path: Path) -> None:
        refused(tmp_path, "not a scene, expected transforms_train.json")


def test_cameras_that_look_away(scene: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        for k, frame in enumerate(content["frames"]):
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] *= 3
            if k == 2:
                pose[:3, :3] = pose[:3, :3] @ np.diag([-1, 1, -1])
            frame["transform_matrix"] = pose.tolist()

    edit(scene, change)
    refused(
        scene, "cameras: 1 of 8 look away from the point that the others look at; give bounds, near and far"
    )


class TestViews:
    def views(self, **changes: Any) -> Views:
        fields: dict[str, Any] = {
            "pixels": torch.zeros(2, 3, 4, 4),
            "poses": torch.eye(4).repeat(2, 1, 1),
            "intrinsics": torch.ones(2, 4),
            "names": ("a", "b"),
            "ids": (0, 1),
        }
        return Views(**{**fields, **changes})

    def test_accepts_and_moves(self) -> None:
        views = self.views()
        assert (len(views), views.height, views.width) == (2, 3, 4)
        assert torch.equal(views.to("cpu").rgba, views.rgba)

    @pytest.mark.parametrize(
        ("changes", "pattern"),
        [
            (
                {"pixels": torch.zeros(2, 3, 4, 3)},
                r"pixels: found shape \(2, 3, 4, 3\), expected \(V, H, W, 4\)",
            ),
            ({"poses": torch.zeros(2, 3, 4)}, r"poses: found shape \(2, 3, 4\), expected \(2, 4, 4\)"),
            ({"intrinsics": torch.zeros(1, 4)}, r"intrinsics: found shape \(1, 4\), expected \(2, 4\)"),
            ({"names": ("a",)}, "names, ids: found 1 and 2, expected 2 each"),
        ],
    )
    def test_shapes(self, changes: dict[str, Any], pattern: str) -> None:
        with pytest.raises(InputError, match=pattern):
            self.views(**changes)

    def test_scene_checks_its_box(self) -> None:
        views, white = self.views(), background_colour("white")
        with pytest.raises(InputError, match="bounds: found"):
            Scene("a", "b", views, views, 1.0, 2.0, torch.zeros(2, 3), white, "f")
