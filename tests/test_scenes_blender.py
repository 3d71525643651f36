"""Loading Blender scenes: what is accepted, what is selected, what training sees."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.scenes import Protocol, builtin_scene, load_scene
from gridreg.scenes.frames import StatedIntrinsics
from gridreg.scenes.lens import LensDistortion
from gridreg.scenes.protocols import First, Listed

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


@pytest.fixture
def scene(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "lego"))


def edit(scene: Path, change: Callable[[dict[str, Any]], None], split: str = "train") -> None:
    path = scene / f"transforms_{split}.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_reads_images_poses_and_intrinsics(scene: Path) -> None:
    loaded = load_scene(scene, "builtin8")
    assert loaded.name == "lego"
    assert loaded.protocol == "builtin8"
    assert loaded.train.rgba.shape == (8, SIZE, SIZE, 4)
    assert loaded.test.rgba.shape == (25, SIZE, SIZE, 4)
    assert (
        loaded.train.rgba.dtype == loaded.train.poses.dtype == loaded.train.intrinsics.dtype == torch.float32
    )
    assert loaded.train.names == tuple(f"r_{k}" for k in range(8))
    assert loaded.test.ids == tuple(range(25))
    assert (loaded.near, loaded.far) == (2.0, 6.0)
    assert loaded.bounds.tolist() == [[-1.5] * 3, [1.5] * 3]
    assert loaded.background.tolist() == [1, 1, 1]
    assert loaded.validation is None
    assert not loaded.ndc
    content = json.loads((scene / "transforms_train.json").read_text())
    for k in range(8):
        stored = np.asarray(Image.open(scene / f"train/r_{k}.png"))
        np.testing.assert_array_equal(loaded.train.rgba[k], (stored / 255).astype(np.float32))
        np.testing.assert_allclose(loaded.train.poses[k], content["frames"][k]["transform_matrix"], rtol=1e-6)
    focal = SIZE / 2 / math.tan(content["camera_angle_x"] / 2)
    torch.testing.assert_close(loaded.train.intrinsics[3], torch.tensor([focal, focal, SIZE / 2, SIZE / 2]))


def test_only_selected_frames_are_opened(scene: Path) -> None:
    for k in range(8, 18):
        (scene / f"train/r_{k}.png").unlink()
    for k in range(1, 25):
        (scene / f"test/r_{k}.png").write_bytes(b"never read")
    loaded = load_scene(scene, "builtin8", test=[0])
    assert len(loaded.train) == 8
    assert loaded.test.names == ("r_0",)


@pytest.mark.parametrize(
    "form", ["train/r_{}.png", "./train/r_{}.png", "train/r_{}", "./train/../train/r_{}"]
)
def test_forms_of_file_path(scene: Path, form: str) -> None:
    expected = load_scene(scene, "first3").train

    def change(content: dict[str, Any]) -> None:
        for k, frame in enumerate(content["frames"]):
            frame["file_path"] = form.format(k)

    edit(scene, change)
    found = load_scene(scene, "first3").train
    assert torch.equal(found.rgba, expected.rgba)
    assert found.names == ("r_0", "r_1", "r_2")


def test_jpg_without_extension_and_dots_in_names(scene: Path) -> None:
    image = Image.open(scene / "train/r_0.png").convert("RGB")
    image.save(scene / "train/frame.001.jpg")
    edit(scene, lambda c: c["frames"][0].update(file_path="train/frame.001"))
    loaded = load_scene(scene, "first1", opaque=True)
    assert loaded.train.names == ("frame.001",)
    assert bool((loaded.train.rgba[..., 3] == 1).all())


def test_equal_file_names_in_two_folders_get_different_names(scene: Path) -> None:
    (scene / "other").mkdir()
    shutil.copy(scene / "train/r_1.png", scene / "other/r_0.png")
    edit(scene, lambda c: c["frames"][1].update(file_path="other/r_0"))
    assert load_scene(scene, "first2").train.names == ("train_r_0", "other_r_0")


def test_index_counts_frames_not_file_names(scene: Path) -> None:
    expected = load_scene(scene, "builtin8").train
    edit(scene, lambda c: c["frames"].reverse())
    protocol = Protocol("p", Listed((17, 10)), First(1), None, "white", "test")
    found = load_scene(scene, protocol).train
    assert found.ids == (17, 10)
    assert found.names == ("r_0", "r_7")
    assert torch.equal(found.rgba[0], expected.rgba[0])
    assert torch.equal(found.poses[1], expected.poses[7])


def test_explicit_intrinsics_win_over_angles(scene: Path) -> None:
    stated = {
        "fl_x": 20.0,
        "fl_y": 21.0,
        "cx": 7.0,
        "cy": 9.5,
        "w": SIZE,
        "h": float(SIZE),
        "camera_angle_y": 0.1,
    }
    edit(scene, lambda c: c.update(stated, k1=0.0, k2=0, p1=0.0, p2=0.0))
    assert load_scene(scene, "first1").train.intrinsics[0].tolist() == [20, 21, 7, 9.5]


def test_camera_angle_y_is_ignored(scene: Path) -> None:
    expected = load_scene(scene, "first1").train.intrinsics
    edit(scene, lambda c: c.update(camera_angle_y=0.47))
    assert torch.equal(load_scene(scene, "first1").train.intrinsics, expected)


def test_intrinsics_per_frame(scene: Path) -> None:
    edit(scene, lambda c: c["frames"][1].update(fl_x=33.0, cx=5.0))
    intrinsics = load_scene(scene, "first2").train.intrinsics
    assert intrinsics[1].tolist() == [33, 33, 5, SIZE / 2]
    assert intrinsics[0, 0] != 33


@pytest.mark.parametrize("size", [16, 8, 4])
def test_size_is_an_area_mean_and_scales_the_intrinsics(scene: Path, size: int) -> None:
    full, small = load_scene(scene, "builtin8"), load_scene(scene, "builtin8", size=size)
    factor = SIZE // size
    expected = torch.nn.functional.avg_pool2d(full.train.rgba.permute(0, 3, 1, 2), factor).permute(0, 2, 3, 1)
    torch.testing.assert_close(small.train.rgba, expected)
    torch.testing.assert_close(small.test.intrinsics * factor, full.test.intrinsics)
    assert (small.train.width, small.train.height) == (size, size)
    assert (small.fingerprint == full.fingerprint) == (factor == 1)


def test_a_protocol_halves_at_its_size_only(scene: Path) -> None:
    halving = Protocol("p", First(2), First(1), SIZE, "white", "test")
    other = Protocol("p", First(2), First(1), 2 * SIZE, "white", "test")
    assert load_scene(scene, halving).train.width == SIZE // 2
    assert load_scene(scene, other).train.width == SIZE
    assert load_scene(scene, halving, size=SIZE).train.width == SIZE
    # Every channel by itself, before compositing: a transparent pixel's colour takes part.
    stored = np.asarray(Image.open(scene / "train/r_0.png")).astype(np.float64) / 255
    mean = (stored[0::2, 0::2] + stored[0::2, 1::2] + stored[1::2, 0::2] + stored[1::2, 1::2]) / 4
    np.testing.assert_allclose(load_scene(scene, halving).train.rgba[0], mean, atol=1e-6)


def test_compositing(scene: Path) -> None:
    views = load_scene(scene, "builtin8").train
    rgba = views.rgba.numpy().astype(np.float64)
    for background, colour in (
        ("white", (1, 1, 1)),
        ("black", (0, 0, 0)),
        ((0.2, 0.4, 0.6), (0.2, 0.4, 0.6)),
    ):
        expected = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * np.array(colour)
        np.testing.assert_allclose(views.composited(background), expected, atol=1e-6)


def test_overrides(scene: Path) -> None:
    loaded = load_scene(
        scene,
        "builtin8",
        background="black",
        near=1.0,
        far=9.0,
        bounds=[[-1, -1, -2], [1, 1, 2]],
        test=[3, 1],
    )
    assert loaded.background.tolist() == [0, 0, 0]
    assert (loaded.near, loaded.far) == (1, 9)
    assert loaded.bounds.tolist() == [[-1, -1, -2], [1, 1, 2]]
    assert loaded.test.ids == (3, 1)


def test_no_test_views(scene: Path) -> None:
    loaded = load_scene(scene, "builtin8", test=[])
    assert len(loaded.test) == 0
    assert loaded.test.rgba.shape == (0, SIZE, SIZE, 4)
    assert loaded.test.composited("white").shape == (0, SIZE, SIZE, 3)


def test_a_validation_protocol_scores_training_frames_that_are_not_trained_on(scene: Path) -> None:
    plain, tuning = load_scene(scene, "builtin8"), load_scene(scene, "builtin8-validation")
    assert tuning.protocol == "builtin8-validation"
    assert tuning.train.ids == plain.train.ids
    assert tuning.fingerprint == plain.fingerprint
    assert tuning.test.ids == tuple(range(8, 18))
    frames = load_scene(scene, "builtin8", validation=10).validation
    assert frames is not None
    assert torch.equal(tuning.test.rgba, frames.rgba)
    # Asked for by index, they are the test frames.
    assert load_scene(scene, "builtin8-validation", test=[1]).test.names == plain.test.names[1:2]


def test_validation_views(scene: Path) -> None:
    assert load_scene(scene, "builtin8", validation=[9, 17]).validation.ids == (9, 17)
    assert load_scene(scene, "builtin8", validation=10).validation.ids == tuple(range(8, 18))
    spread = load_scene(scene, "builtin8", validation=3).validation
    assert len(set(spread.ids)) == 3
    assert set(spread.ids) <= set(range(8, 18))


def test_extent_follows_cameras_that_are_not_those_of_nerf_synthetic(scene: Path) -> None:
    shift, scale = np.array([10.0, 0, 0]), 5.0

    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] = matrix[:3, 3] * scale + shift
            frame["transform_matrix"] = matrix.tolist()

    edit(scene, change)
    loaded = load_scene(scene, "builtin8")
    # The box reaches 1.3 to each side; where it lies in the world of the files is noted.
    torch.testing.assert_close(loaded.bounds, torch.tensor([[-1.3] * 3, [1.3] * 3]))
    np.testing.assert_allclose(loaded.world.origin, shift, atol=1e-3)
    # What the lens sees at the focus: 4.03 tan(0.3456) = 1.45, five times as large in the files.
    half = scale * 4.0311 * math.tan(0.6911112 / 2)
    assert loaded.world.unit == pytest.approx(half / 1.3, rel=1e-3)
    assert loaded.world.unit * loaded.near == pytest.approx(scale * 4.0311 - half * math.sqrt(3), abs=0.01)
    assert loaded.world.unit * loaded.far == pytest.approx(scale * 4.0311 + half * math.sqrt(3), abs=0.01)
    assert any("centred on" in note for note in loaded.notes)


class TestFingerprint:
    def test_is_stable_and_does_not_depend_on_the_place_or_the_test_views(
        self, scene: Path, source: Path
    ) -> None:
        first = load_scene(scene, "builtin8").fingerprint
        assert first == load_scene(source, "builtin8", test=[0], validation=2).fingerprint
        assert len(first) == 64

    def test_changes_with_a_pixel(self, scene: Path) -> None:
        before = load_scene(scene, "builtin8").fingerprint
        path = scene / "train/r_5.png"
        pixels = np.array(Image.open(path))
        pixels[0, 0, 0] ^= 1
        Image.fromarray(pixels).save(path)
        assert load_scene(scene, "builtin8").fingerprint != before

    def test_does_not_change_with_the_compression_of_a_file(self, scene: Path) -> None:
        before = load_scene(scene, "builtin8").fingerprint
        path = scene / "train/r_5.png"
        Image.open(path).copy().save(path, compress_level=0)
        assert load_scene(scene, "builtin8").fingerprint == before

    @pytest.mark.parametrize("key", ["pose", "camera", "ids"])
    def test_changes_with_cameras_and_ids(self, scene: Path, key: str) -> None:
        before = load_scene(scene, "first7").fingerprint

        def change(content: dict[str, Any]) -> None:
            if key == "pose":
                content["frames"][2]["transform_matrix"][0][3] += 1e-6
            elif key == "camera":
                content["camera_angle_x"] += 1e-9

        edit(scene, change)
        assert load_scene(scene, "first8" if key == "ids" else "first7").fingerprint != before


def test_a_relative_and_a_linked_scene_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    os.symlink(scene, tmp_path / "link")
    expected = load_scene(scene, "builtin8")
    for folder in (Path("lego"), Path("link"), "lego"):
        assert torch.equal(load_scene(folder, "builtin8").train.rgba, expected.train.rgba)


def test_the_text_in_fingerprints_stays_as_checkpoints_have_it() -> None:
    assert StatedIntrinsics(angle_x=0.5, width=8, distortion=LensDistortion(k1=0.25)).fingerprint == (
        "Camera(angle_x=0.5, fx=None, fy=None, cx=None, cy=None, width=8, height=None, "
        "distortion=Distortion(k1=0.25, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0))"
    )
