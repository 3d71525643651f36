"""transforms.json of nerfstudio and instant-ngp, and which box a scene gets."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene
from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.extent import camera_extent, focus_point

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


@pytest.fixture
def scene(source: Path, tmp_path: Path) -> Path:
    """The training frames of the built-in scene as one list."""
    folder = tmp_path / "own"
    shutil.copytree(source / "train", folder / "images")
    content = json.loads((source / "transforms_train.json").read_text())
    for k, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/r_{k}.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def edit(scene: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = scene / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def refused(folder: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        load_scene(folder, "holdout8", **options)
    assert "\n" not in str(error.value)


def test_every_eighth_frame_is_held_out(scene: Path, source: Path) -> None:
    loaded = load_scene(scene, "holdout8")
    assert loaded.test.names == ("r_0", "r_8", "r_16")
    assert loaded.train.names == tuple(f"r_{k}" for k in range(18) if k % 8)
    original = load_scene(source, "first18", test=[]).train
    assert torch.equal(loaded.train.rgba[0], original.rgba[1])
    assert torch.equal(loaded.train.poses[14], original.poses[17])
    assert torch.equal(loaded.test.intrinsics, original.intrinsics[:3])


def test_images_need_no_alpha_here(scene: Path) -> None:
    for k in range(18):
        Image.open(scene / f"images/r_{k}.png").convert("RGB").save(scene / f"images/r_{k}.png")
    assert bool((load_scene(scene, "holdout8").train.rgba[..., 3] == 1).all())


def test_keys_of_nerfstudio(scene: Path) -> None:
    stated = {
        "camera_model": "OPENCV",
        "fl_x": 21.0,
        "fl_y": 22.0,
        "cx": 8.5,
        "cy": 7.5,
        "w": SIZE,
        "h": SIZE,
    }
    extra = {
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "applied_transform": [[1, 0, 0, 0]],
        "ply_file_path": "x",
    }
    edit(scene, lambda c: (c.pop("camera_angle_x"), c.update(stated, **extra)))
    assert load_scene(scene, "holdout8").train.intrinsics[0].tolist() == [21, 22, 8.5, 7.5]


def test_one_camera_per_frame_with_lenses_of_their_own(scene: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        for k, frame in enumerate(content["frames"]):
            frame.update(fl_x=20.0 + k, w=SIZE, h=SIZE)
        content["frames"][2]["k1"] = 0.2

    edit(scene, change)
    intrinsics = load_scene(scene, "holdout8").train.intrinsics
    assert intrinsics[0, 0] == 21
    assert intrinsics[2, 0] == 23
    assert intrinsics[1, 0] != 22


def test_masks_named_by_the_frames(scene: Path) -> None:
    (scene / "masks").mkdir()
    Image.new("L", (SIZE, SIZE), 0).save(scene / "masks/none.png")
    edit(scene, lambda c: c["frames"][1].update(mask_path="masks/none.png"))
    refused(
        scene, r"transforms\.json: frame 2: has no mask, others have; expected one for every frame, or none"
    )
    Image.new("L", (SIZE, SIZE), 255).save(scene / "masks/all.png")
    edit(scene, lambda c: [frame.setdefault("mask_path", "masks/all.png") for frame in c["frames"]])
    loaded = load_scene(scene, "holdout8")
    assert bool((loaded.train.rgba[0, ..., 3] == 0).all())
    assert bool((loaded.train.rgba[1, ..., 3] > 0).any())
    edit(scene, lambda c: c["frames"][1].update(mask_path="../none.png"))
    refused(scene, r"frame 1: file_path '\.\./none\.png' leads out of the scene folder")
    edit(scene, lambda c: c["frames"][1].update(mask_path=7))
    refused(scene, r"frame 1: mask_path is a int, expected a string")


def test_images_of_different_sizes_with_one_intrinsics(scene: Path) -> None:
    Image.new("RGBA", (12, SIZE)).save(scene / "images/r_5.png")
    refused(scene, r"images/r_5\.png: image is 12x16, expected 16x16 as before")
    edit(scene, lambda c: c.update(w=SIZE, h=SIZE))
    refused(scene, r"images/r_5\.png: image is 12x16, expected w x h of its camera, 16x16")


def test_a_prepared_scene_states_its_extent(scene: Path) -> None:
    stated = {"near": 1.5, "far": 7.5, "bounds": [[-1, -2, -1], [1, 2, 1.5]]}
    edit(scene, lambda c: c.update(gridreg=stated))
    loaded = load_scene(scene, "holdout8")
    assert (loaded.near, loaded.far, loaded.bounds.tolist()) == (1.5, 7.5, stated["bounds"])
    assert load_scene(scene, "holdout8", near=2.0).near == 2


@pytest.mark.parametrize(
    "stated",
    [
        7,
        {},
        {"near": 1, "far": 2},
        {"near": "a", "far": 2, "bounds": [[0] * 3] * 2},
        {"near": 1, "far": 2, "bounds": [1]},
    ],
)
def test_a_damaged_extent(scene: Path, stated: object) -> None:
    edit(scene, lambda c: c.update(gridreg=stated))
    refused(scene, r"transforms\.json: 'gridreg' does not hold near, far and \(2, 3\) bounds")


def test_bad_lists(scene: Path) -> None:
    edit(scene, lambda c: c.update(frames=c["frames"][:1]))
    refused(scene, r"transforms\.json: found 1 frames, expected at least 2 \(one is held out\)")
    edit(scene, lambda c: c.pop("frames"))
    refused(scene, r"transforms\.json: key 'frames' is missing")


class TestBox:
    @pytest.mark.parametrize("bounds", [[[9, 9, 9], [10, 10, 10]], [[-0.1, -0.1, 8], [0.1, 0.1, 9]]])
    def test_that_no_camera_sees(self, scene: Path, bounds: list[list[float]]) -> None:
        refused(scene, r"bounds: no training camera sees the box .* between near 2 and far 6", bounds=bounds)

    def test_beyond_far(self, scene: Path) -> None:
        refused(scene, r"between near 0\.1 and far 0\.5", near=0.1, far=0.5)

    @pytest.mark.parametrize("half", [1e-3, 0.1, 1.5, 50.0])
    def test_small_and_large_ones_are_seen(self, scene: Path, half: float) -> None:
        # Who states a box counts in the world of the files, however large: it stays.
        loaded = load_scene(scene, "holdout8", bounds=[[-half] * 3, [half] * 3])
        assert (loaded.far, loaded.bounds[1].tolist()) == (6, [pytest.approx(half)] * 3)


class TestFocus:
    def test_is_where_the_axes_meet(self) -> None:
        poses = np.stack([look_at_origin(40 * k, 10 * k - 20) for k in range(6)])
        poses[:, :3, 3] += [1.0, -2.0, 3.0]
        np.testing.assert_allclose(focus_point(poses), [1, -2, 3], atol=1e-9)

    def test_least_squares_of_axes_that_do_not_meet(self) -> None:
        rng = np.random.default_rng(0)
        poses = np.stack([look_at_origin(*rng.uniform(-60, 60, 2)) for _ in range(5)])
        poses[:, :3, 3] += 0.1 * rng.standard_normal((5, 3))
        axes, origins = -poses[:, :3, 2], poses[:, :3, 3]

        def cost(point: np.ndarray) -> float:
            gap = point - origins
            return float(((gap - (gap * axes).sum(1, keepdims=True) * axes) ** 2).sum())

        best = focus_point(poses)
        for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]):
            assert cost(best) < cost(best + step)

    def test_parallel_cameras_have_no_focus_but_an_answer(self) -> None:
        poses = np.tile(np.eye(4), (4, 1, 1))
        poses[:, 0, 3] = [0, 1, 2, 3]
        np.testing.assert_allclose(focus_point(poses)[:2], [1.5, 0], atol=1e-9)
        with pytest.raises(InputError, match="look away"):
            camera_extent(poses, np.full((4, 4), 10.0), (10, 10))


def test_frames_that_a_list_would_hold_out_are_trained_on_under_all_and_that_is_said(scene: Path) -> None:
    held, every = load_scene(scene, "holdout8"), load_scene(scene, "all")
    assert len(every.train) == len(held.train) + len(held.test)
    assert {*every.train.names} == {*held.train.names, *held.test.names}
    assert every.test.names == held.test.names
    assert any(
        f"{len(held.test)} of {len(held.test)} test views are trained on" in note for note in every.notes
    )
    assert not any("trained on" in note for note in held.notes)
