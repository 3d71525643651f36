"""`prepare`: from images or found cameras to a scene folder, whole or not at all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene, prepare
from gridreg.scenes.builtin.cameras import look_at_origin
from gridreg.scenes.drawing import draw_cameras
from gridreg.scenes.images import read_rgba
from gridreg.scenes.prepare import _upwards

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


def turned(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    similarity = np.eye(4)
    similarity[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    similarity[:3, 3] = [7, -4, 2]
    return similarity


@pytest.fixture
def posed(source: Path, tmp_path: Path) -> Path:
    """The built-in training images with their cameras in a world that is turned, shifted and 5 times larger."""
    folder = tmp_path / "posed"
    shutil.copytree(source / "train", folder / "images")
    content = json.loads((source / "transforms_train.json").read_text())
    for k, frame in enumerate(content["frames"]):
        pose = turned(50) @ np.array(frame["transform_matrix"])
        pose[:3, 3] = 5 * (pose[:3, 3] - [7, -4, 2]) + [7, -4, 2]
        frame.update(file_path=f"images/r_{k}.png", transform_matrix=pose.tolist())
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def refused(source: Path, out: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        prepare(source, out, **options)
    assert "\n" not in str(error.value)
    assert not out.exists() or out.is_file()
    # Nothing half-written stays beside it either.
    assert not [path for path in out.parent.glob(".*") if out.name in path.name]


class TestFromCameras:
    def test_normalises_the_world(self, posed: Path, tmp_path: Path, source: Path) -> None:
        stages: list[str] = []
        prepared = prepare(posed, tmp_path / "out", progress=stages.append)
        assert stages == ["box"]
        assert prepared.missing == ()
        assert len(prepared.registered) == 18
        loaded = load_scene(prepared.folder, "holdout8")
        original = load_scene(source, "first18", test=[]).train
        rows = [original.names.index(name) for name in loaded.train.names]
        assert torch.equal(loaded.train.rgba, original.rgba[rows])
        torch.testing.assert_close(loaded.train.intrinsics, original.intrinsics[rows])
        # Up is up again, the object is in the middle, and distances are in proportion.
        assert float(loaded.train.poses[:, :3, 1].mean(dim=0)[2]) > 0.5
        assert loaded.bounds.mean(dim=0).abs().max() < 1e-5
        assert float(loaded.bounds.max()) == pytest.approx(1.3)
        distances = loaded.train.poses[:, :3, 3].norm(dim=-1)
        torch.testing.assert_close(distances, distances[:1].expand_as(distances), rtol=1e-3, atol=0)
        assert 0 < loaded.near < float(distances[0]) < loaded.far
        assert (loaded.near, loaded.far) == (prepared.extent.near, prepared.extent.far)

    def test_reports_in_two_lines(self, posed: Path, tmp_path: Path) -> None:
        first, second = str(prepare(posed, tmp_path / "out")).split("\n")
        assert first.endswith("out: 18 of 18 images have cameras")
        assert second.startswith("near ")
        assert second.endswith("out/cameras.png")
        drawing = np.asarray(Image.open(tmp_path / "out/cameras.png").convert("RGB")).astype(int)
        red = (drawing[..., 0] > 150) & (drawing[..., 1] < 90)
        blue = (drawing[..., 2] > 130) & (drawing[..., 0] < 90)
        assert red.sum() > 200
        assert blue.sum() > 200

    def test_keeps_lenses_and_masks(self, posed: Path, tmp_path: Path) -> None:
        content = json.loads((posed / "transforms.json").read_text())
        content.update(fl_x=21.0, fl_y=22.0, cx=8.5, cy=7.5, w=SIZE, h=SIZE, k1=0.1, p2=0.01)
        for k, frame in enumerate(content["frames"]):
            frame["mask_path"] = f"images/r_{5 if k == 3 else k}.png"
        content["frames"][4]["fl_x"] = 23.0
        (posed / "transforms.json").write_text(json.dumps(content))
        prepare(posed, tmp_path / "out")
        before, after = load_scene(posed, "holdout8"), load_scene(tmp_path / "out", "holdout8")
        by_name = {name: i for i, name in enumerate(before.train.names + before.test.names)}
        rgba = torch.cat([before.train.rgba, before.test.rgba])
        intrinsics = torch.cat([before.train.intrinsics, before.test.intrinsics])
        rows = [by_name[name] for name in after.train.names]
        torch.testing.assert_close(after.train.rgba, rgba[rows])
        torch.testing.assert_close(after.train.intrinsics, intrinsics[rows])

    def test_reduces_large_images_with_their_cameras_and_masks(self, posed: Path, tmp_path: Path) -> None:
        content = json.loads((posed / "transforms.json").read_text())
        content.update(fl_x=21.0, fl_y=22.0, cx=8.5, cy=7.5, w=SIZE, h=SIZE)
        (posed / "transforms.json").write_text(json.dumps(content))
        (tmp_path / "masks").mkdir()
        for k in range(18):
            mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
            mask[:, : SIZE // 2] = 255
            Image.fromarray(mask).convert("1").save(tmp_path / f"masks/r_{k}.png")
            image = np.zeros((SIZE, SIZE, 3), dtype=np.uint8)
            image[: SIZE // 2], image[1::2, :, 1] = (10 * k, 0, 200), 100
            Image.fromarray(image).save(posed / f"images/r_{k}.png")
        prepare(posed, tmp_path / "out", masks=tmp_path / "masks", longest_edge=SIZE // 2)
        prepare(posed, tmp_path / "same", masks=tmp_path / "masks", longest_edge=SIZE)
        small, large = load_scene(tmp_path / "out", "holdout8"), load_scene(tmp_path / "same", "holdout8")
        assert small.train.rgba.shape[1:] == (SIZE // 2, SIZE // 2, 4)
        expected = large.train.rgba.unflatten(1, (-1, 2)).unflatten(3, (-1, 2)).mean(dim=(2, 4))
        torch.testing.assert_close(small.train.rgba, expected, atol=1 / 255, rtol=0)
        torch.testing.assert_close(small.train.intrinsics, large.train.intrinsics / 2)
        assert torch.equal(small.train.poses, large.train.poses)
        refused(posed, tmp_path / "none", "longest_edge: found 0, expected at least 8 pixels", longest_edge=0)

    def test_a_folder_of_masks(self, posed: Path, tmp_path: Path) -> None:
        (tmp_path / "masks").mkdir()
        for k in range(18):
            mask = Image.new("L", (SIZE, SIZE), 255)
            mask.paste(51 if k == 3 else 255, (SIZE // 2, 0, SIZE // 2 + 2, SIZE))
            mask.save(tmp_path / f"masks/r_{k}.png")
        prepare(posed, tmp_path / "out", masks=tmp_path / "masks")
        views = load_scene(tmp_path / "out", "holdout8").train
        # A soft edge two pixels wide stays one.
        edge = views.rgba[:, :, SIZE // 2 : SIZE // 2 + 2, 3]
        for name, factor in (("r_3", 0.2), ("r_5", 1.0)):
            alpha = read_rgba(posed / f"images/{name}.png")[:, SIZE // 2 : SIZE // 2 + 2, 3]
            np.testing.assert_allclose(edge[views.names.index(name)], factor * alpha, rtol=1e-6)
        (tmp_path / "masks/r_9.png").unlink()
        refused(posed, tmp_path / "again", r"no mask for image r_9\.png", masks=tmp_path / "masks")

    def test_two_images_of_one_name(self, posed: Path, tmp_path: Path) -> None:
        (posed / "more").mkdir()
        shutil.move(posed / "images/r_1.png", posed / "more/r_0.png")
        content = json.loads((posed / "transforms.json").read_text())
        content["frames"][1]["file_path"] = "more/r_0.png"
        (posed / "transforms.json").write_text(json.dumps(content))
        prepared = prepare(posed, tmp_path / "out")
        assert {"more_r_0.png", "images_r_0.png"} <= set(prepared.registered)

    def test_what_needs_no_preparation(self, source: Path, tmp_path: Path) -> None:
        refused(source, tmp_path / "out", "needs no preparation, load it as it is")

    def test_a_damaged_scene_is_not_taken_for_images(self, posed: Path, tmp_path: Path) -> None:
        (posed / "transforms.json").write_text("{")
        refused(posed, tmp_path / "out", r"transforms\.json: not valid JSON")

    def test_cameras_that_look_away(self, posed: Path, tmp_path: Path) -> None:
        content = json.loads((posed / "transforms.json").read_text())
        pose = np.array(content["frames"][2]["transform_matrix"])
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1, 1, -1])
        content["frames"][2]["transform_matrix"] = pose.tolist()
        (posed / "transforms.json").write_text(json.dumps(content))
        refused(posed, tmp_path / "out", "1 of 18 look away from the point that the others look at")


class TestFolders:
    def test_out_exists(self, posed: Path, tmp_path: Path) -> None:
        (tmp_path / "out").write_text("mine")
        refused(posed, tmp_path / "out", "out: exists already, expected the name of a new folder")
        assert (tmp_path / "out").read_text() == "mine"

    def test_no_source(self, tmp_path: Path) -> None:
        refused(tmp_path / "nothing", tmp_path / "out", "nothing: no such folder of images")

    def test_unwritable(self, posed: Path, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(InputError, match="cannot be written"):
            prepare(posed, tmp_path / "file/out")

    def test_full_disk(self, posed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Path, "write_text", full)
        refused(posed, tmp_path / "out", r"out: cannot be written \(No space left on device\)")

    def test_interrupted(self, posed: Path, tmp_path: Path) -> None:
        def interrupt(stage: str) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            prepare(posed, tmp_path / "out", progress=interrupt)
        assert [path.name for path in tmp_path.iterdir()] == ["posed"]


def test_smallest_rotation_upwards() -> None:
    rng = np.random.default_rng(0)
    for up in [*rng.standard_normal((20, 3)), np.array([0, 0, 2.0]), np.array([0, 0, -3.0])]:
        rotation = _upwards(up)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(rotation @ up, [0, 0, np.linalg.norm(up)], atol=1e-9)
        angle = np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1))
        assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(angle))
    np.testing.assert_array_equal(_upwards(np.zeros(3)), np.eye(3))


def test_drawing_that_cannot_be_written(tmp_path: Path) -> None:
    poses = np.stack([look_at_origin(60 * k, 20) for k in range(6)])
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    with pytest.raises(InputError, match=r"a\.png: cannot be written"):
        draw_cameras(tmp_path / "no/a.png", poses, np.full((6, 4), 10.0), (20, 20), bounds)
