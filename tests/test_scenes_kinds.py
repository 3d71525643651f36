"""Scenes as other people's tools write them: read as they were meant, or refused; never misread without a word."""

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
from gridreg.scenes import Scene, builtin_scene, default_protocol, load_scene, prepare
from gridreg.scenes.extent import points_extent
from gridreg.scenes.images import read_rgba

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


@pytest.fixture
def blender(source: Path, tmp_path: Path) -> Path:
    folder = Path(shutil.copytree(source, tmp_path / "blender"))
    (folder / "builtin.json").unlink()
    return folder


@pytest.fixture
def single(source: Path, tmp_path: Path) -> Path:
    """The training images as one list, with masks of their alpha beside opaque images."""
    folder = tmp_path / "single"
    shutil.copytree(source / "train", folder / "images")
    (folder / "masks").mkdir()
    content = json.loads((source / "transforms_train.json").read_text())
    for k, frame in enumerate(content["frames"]):
        path = folder / f"images/r_{k}.png"
        rgba = np.asarray(Image.open(path))
        Image.fromarray(rgba[..., 3]).save(folder / f"masks/r_{k}.png")
        Image.fromarray(np.ascontiguousarray(rgba[..., :3])).save(path)
        frame.update(file_path=f"images/r_{k}.png")
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def edit(folder: Path, change: Callable[[dict[str, Any]], Any], name: str = "transforms.json") -> None:
    path = folder / name
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def loaded(folder: Path, protocol: str | None = None, **options: Any) -> Scene:
    return load_scene(folder, protocol or default_protocol(folder), **options)


def refused(folder: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        loaded(folder, **options)
    assert "\n" not in str(error.value)


def with_masks(folder: Path, make: Callable[[np.ndarray], Image.Image]) -> np.ndarray:
    """Rewrite all masks, name them in the list, and return the alpha that the training views should have."""
    alphas = []
    for k in range(18):
        path = folder / f"masks/r_{k}.png"
        alpha = np.asarray(Image.open(path))
        make(alpha).save(path)
        alphas.append(alpha / 255)
    edit(folder, lambda c: [f.update(mask_path=f"masks/r_{k}.png") for k, f in enumerate(c["frames"])])
    return np.stack([alpha for k, alpha in enumerate(alphas) if k % 8])


def palette(alpha: np.ndarray) -> Image.Image:
    image = Image.fromarray((alpha > 127).astype(np.uint8), mode="P")
    image.putpalette([0, 0, 0, 128, 0, 0])
    return image


class TestMasks:
    @pytest.mark.parametrize(
        ("make", "soft"),
        [
            (lambda a: Image.fromarray(a), True),
            (
                lambda a: Image.merge("RGBA", [Image.fromarray(a)] * 3 + [Image.new("L", (SIZE, SIZE), 255)]),
                True,
            ),
            (lambda a: Image.merge("LA", [Image.new("L", (SIZE, SIZE), 255), Image.fromarray(a)]), True),
            (lambda a: Image.fromarray((a > 127).astype(np.uint8)), False),
            (lambda a: Image.fromarray((a > 127).astype(np.uint16)), False),
            (lambda a: Image.fromarray(a > 127), False),
            (lambda a: Image.fromarray((a > 127).astype(np.uint8) * 128), False),
            (palette, False),
        ],
        ids=[
            "grey",
            "opaque RGBA",
            "alpha",
            "zeros and ones",
            "16 bits of ones",
            "1 bit",
            "0 and 128",
            "palette",
        ],
    )
    def test_are_read_as_meant(
        self, single: Path, make: Callable[[np.ndarray], Image.Image], soft: bool
    ) -> None:
        alpha = with_masks(single, make)
        meant = alpha if soft else (alpha > 127 / 255).astype(float)
        found = loaded(single, test=()).train.rgba[..., 3]
        np.testing.assert_allclose(found.numpy(), meant, atol=1e-6)

    def test_labels_are_refused(self, single: Path) -> None:
        def labels(alpha: np.ndarray) -> Image.Image:
            made = np.zeros((SIZE, SIZE), np.uint8)
            made[2:8, 2:8], made[8:14, 2:14] = 1, 2
            return Image.fromarray(made)

        with_masks(single, labels)
        refused(single, r"masks/r_1\.png: mask holds the values 0, 1, 2 \(labels\?\), expected white")

    def test_colours_are_refused(self, single: Path) -> None:
        def colours(alpha: np.ndarray) -> Image.Image:
            made = np.zeros((SIZE, SIZE, 3), np.uint8)
            made[2:8, 2:8], made[8:14, 2:14] = (255, 0, 0), (0, 0, 255)
            return Image.fromarray(made)

        with_masks(single, colours)
        refused(single, r"masks/r_1\.png: mask has several colours")

    @pytest.mark.parametrize("size", [(SIZE, SIZE // 2), (SIZE // 2, SIZE // 2)])
    def test_of_another_shape_are_refused_by_train_and_prepare(
        self, single: Path, tmp_path: Path, size: tuple[int, int]
    ) -> None:
        with_masks(single, lambda a: Image.fromarray(a).resize(size))
        pattern = rf"mask is {size[0]}x{size[1]}, expected 16x16 as its image"
        refused(single, pattern)
        with pytest.raises(InputError, match=pattern):
            prepare(single, tmp_path / "out")

    def test_for_some_frames_are_refused(self, single: Path) -> None:
        edit(single, lambda c: c["frames"][3].update(mask_path="masks/r_3.png"))
        refused(single, "frame 1: has no mask, others have; expected one for every frame, or none")

    def test_of_the_stored_pixels_turn_with_their_image(self, tmp_path: Path) -> None:
        # A photograph of 16x12 stored sideways, and its mask made of the stored pixels.
        folder, masks = tmp_path / "photos", tmp_path / "photos/masks"
        (folder / "images").mkdir(parents=True)
        masks.mkdir()
        exif = Image.Exif()
        exif[274] = 6
        pixels = np.zeros((12, 16, 3), np.uint8)
        pixels[:4, :5] = 200
        frames = []
        for k in range(4):
            Image.fromarray(np.ascontiguousarray(np.rot90(pixels))).save(
                folder / f"images/{k}.png", exif=exif
            )
            Image.fromarray(np.ascontiguousarray(np.rot90(pixels[..., 0] > 0))).save(masks / f"{k}.png")
            pose = np.eye(4)
            pose[:3, 3] = [0.2 * k, 0, 4]
            frames.append(
                {
                    "file_path": f"images/{k}.png",
                    "mask_path": f"masks/{k}.png",
                    "transform_matrix": pose.tolist(),
                }
            )
        content = {"w": 16, "h": 12, "fl_x": 20, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content))
        found = load_scene(folder, "holdout8", bounds=[[-1] * 3, [1] * 3], near=1, far=6, test=()).train
        np.testing.assert_array_equal(found.rgba[0, ..., 3].numpy(), pixels[..., 0] > 0)


class TestIntrinsics:
    def test_principal_point_outside(self, single: Path) -> None:
        edit(single, lambda c: c.update(fl_x=44, cx=32, cy=32, camera_angle_x=None))
        refused(
            single, r"frame 1 \(r_1\.png\): principal point \(32, 32\) lies outside of the image of 16x16"
        )

    def test_focal_length_of_another_size(self, single: Path) -> None:
        edit(single, lambda c: c.update(fl_x=4 * 22.2))
        refused(single, "fl_x and camera_angle_x belong to images 64 wide, found 16")

    @pytest.mark.parametrize("w", [16.4, 15.7])
    def test_fractions_of_a_pixel(self, blender: Path, w: float) -> None:
        edit(blender, lambda c: c.update(w=w, h=w), "transforms_train.json")
        assert loaded(blender, "first8").train.width == SIZE


class TestSplits:
    def test_of_the_file_are_used(self, single: Path, tmp_path: Path) -> None:
        names = [f"images/r_{k}.png" for k in range(18)]
        edit(
            single, lambda c: c.update(train_filenames=names[3:], val_filenames=[], test_filenames=names[:3])
        )
        scene = loaded(single)
        assert scene.test.names == ("r_0", "r_1", "r_2")
        assert len(scene.train) == 15
        assert "its own split, 15 training and 3 test frames" in scene.notes[0]
        prepare(single, tmp_path / "out")
        assert set(loaded(tmp_path / "out").test.names) == {"r_0", "r_1", "r_2"}

    def test_bad_ones(self, single: Path) -> None:
        edit(
            single, lambda c: c.update(train_filenames=["images/r_1.png"], test_filenames=["images/r_1.png"])
        )
        refused(single, "trains on a test frame, 'images/r_1.png'")
        edit(single, lambda c: c.update(test_filenames=["images/x.png"]))
        refused(single, "'test_filenames' names 'images/x.png', which is not among the frames")
        edit(single, lambda c: c.update(test_filenames="all"))
        refused(single, "'test_filenames' is not a list of file names")


class TestExporters:
    @pytest.mark.parametrize("empty", [True, False])
    def test_no_test_images(self, blender: Path, empty: bool) -> None:
        shutil.rmtree(blender / "test")
        if empty:
            edit(blender, lambda c: c.update(frames=[]), "transforms_test.json")
        assert default_protocol(blender) == "holdout8"
        scene = loaded(blender)
        assert (len(scene.train), len(scene.test)) == (15, 3)
        assert "every 8th frame of" in scene.notes[0]
        assert len(loaded(blender, "first8").train) == 8

    def test_validation_list_in_place_of_the_test_list(self, blender: Path) -> None:
        (blender / "transforms_test.json").rename(blender / "transforms_val.json")
        assert len(loaded(blender, "first8").test) == 4

    def test_backslashes_cases_and_extensions(self, blender: Path) -> None:
        plain = loaded(blender, "first8")
        for k in range(0, 8, 2):
            (blender / f"train/r_{k}.png").rename(blender / f"train/R_{k}.PNG")

        def windows(content: dict[str, Any]) -> None:
            for k, frame in enumerate(content["frames"]):
                frame["file_path"] = f".\\train\\r_{k}" + (".png" if k % 3 else "")

        edit(blender, windows, "transforms_train.json")
        assert torch.equal(loaded(blender, "first8").train.rgba, plain.train.rgba)

    @pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
    def test_byte_order_marks(self, blender: Path, encoding: str) -> None:
        path = blender / "transforms_train.json"
        path.write_text(path.read_text(), encoding=encoding)
        assert len(loaded(blender).train) == 18

    def test_lists_longer_than_the_images(self, single: Path) -> None:
        (single / "images/r_3.png").unlink()
        scene = loaded(single)
        assert len(scene.train) + len(scene.test) == 17
        assert "1 of 18 frames have no image and are left out" in scene.notes[0]

    def test_images_without_alpha(self, blender: Path) -> None:
        for path in blender.glob("t*/*.png"):
            Image.open(path).convert("RGB").save(path)
        scene = loaded(blender)
        assert bool((scene.train.rgba[..., 3] == 1).all())
        assert "image has no alpha channel; such images are taken as opaque" in scene.notes[0]
        Image.new("RGBA", (SIZE, SIZE)).save(blender / "train/r_4.png")
        refused(blender, r"train/r_0\.png: image has no alpha channel, expected RGBA as r_4\.png")
        assert loaded(blender, opaque=True).train.rgba[4].max() == 0

    def test_a_protocol_that_does_not_fit_names_one_that_does(self, blender: Path) -> None:
        assert default_protocol(blender) == "first18"
        refused(blender, "frames 0 to 17; first18 would fit, or views8", protocol="gs8")
        assert len(loaded(blender, "views8").train) == 8


class TestLengths:
    @pytest.mark.parametrize(("unit", "shift"), [(100.0, 0.0), (1e-3, 0.0), (1.0, 5.2e6)])
    def test_neither_unit_nor_origin_matter(self, single: Path, unit: float, shift: float) -> None:
        def move(content: dict[str, Any]) -> None:
            for frame in content["frames"]:
                matrix = np.array(frame["transform_matrix"])
                matrix[:3, 3] = unit * matrix[:3, 3] + [shift, -shift, 0]
                frame["transform_matrix"] = matrix.tolist()

        where = np.array(
            [f["transform_matrix"] for f in json.loads((single / "transforms.json").read_text())["frames"]]
        )
        edit(single, move)
        scene = loaded(single, test=())
        assert scene.bounds.tolist() == [[pytest.approx(-1.3)] * 3, [pytest.approx(1.3)] * 3]
        files = scene.world.outward(scene.train.poses[:, :3, 3].double().numpy())
        expected = np.array([unit * p[:3, 3] + [shift, -shift, 0] for k, p in enumerate(where) if k % 8])
        np.testing.assert_allclose(files, expected, atol=1e-5 * unit)

    def test_fingerprints_tell_worlds_apart(self, single: Path) -> None:
        prints = set()
        for factor in (10.0, 1.0):

            def move(content: dict[str, Any], factor: float = factor) -> None:
                for frame in content["frames"]:
                    for row in frame["transform_matrix"][:3]:
                        row[3] *= factor

            edit(single, move)
            prints.add(loaded(single, test=()).fingerprint)
            prints.add(loaded(single, test=(), bounds=[[-9] * 3, [9] * 3], near=1, far=99).fingerprint)
        assert len(prints) == 2

    def test_points_times_views_as_numpy_counts_them(self) -> None:
        rng = np.random.default_rng(0)
        poses = np.tile(np.eye(4), (5, 1, 1))
        poses[:, :3, 3] = rng.normal([0, 0, 4], 0.3, (5, 3))
        points = rng.normal(0, 0.5, (4000, 3))
        found = points_extent(poses, points)
        inside = points[((points >= found.bounds[0]) & (points <= found.bounds[1])).all(axis=1)]
        distance = np.linalg.norm(inside[None] - poses[:, None, :3, 3], axis=-1)
        before = inside[None, :, 2] < poses[:, None, 2, 3]
        assert found.near == pytest.approx(0.9 * np.quantile(distance[before], 0.001), rel=1e-12)
        assert found.far == pytest.approx(1.1 * distance[before].max(), rel=1e-12)


class TestDoubts:
    def test_images_of_one_colour_are_said_to_mean_nothing(self, single: Path) -> None:
        Image.new("RGB", (SIZE, SIZE), (9, 9, 9)).save(single / "images/r_0.png")
        assert any(
            "1 of 3 test images show nothing but one colour (r_0, ...)" in n for n in loaded(single).notes
        )

    def test_long_images_are_reduced(self, tmp_path: Path) -> None:
        (tmp_path / "images").mkdir()
        rng = np.random.default_rng(0)
        frames = []
        for k in range(3):
            Image.fromarray(rng.integers(0, 256, (30, 2701, 3), dtype=np.uint8)).save(
                tmp_path / f"images/{k}.png"
            )
            pose = np.eye(4)
            pose[:3, 3] = [0.1 * k, 0, 4]
            frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
        content = {"fl_x": 2700, "cx": 1350, "cy": 15, "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        options: dict[str, Any] = {"bounds": [[-1] * 3, [1] * 3], "near": 1, "far": 9}
        scene = loaded(tmp_path, **options)
        assert (scene.train.width, scene.train.height) == (900, 10)
        assert scene.train.intrinsics[0].tolist() == [900, 900, 450, 5]
        assert "images of 2701x30 are reduced to 900x10 (--size chooses)" in scene.notes
        full = read_rgba(tmp_path / "images/1.png", opaque=True)
        np.testing.assert_allclose(
            scene.train.rgba[0, 2, 3].numpy(), full[6:9, 9:12].mean(axis=(0, 1)), rtol=1e-5
        )
        assert loaded(tmp_path, size=2701, **options).train.width == 2701


class TestColmapText:
    @pytest.fixture
    def model(self, source: Path, tmp_path: Path) -> Path:
        folder = tmp_path / "colmap"
        shutil.copytree(source / "train", folder / "images")
        (folder / "images/r_3.png").rename(folder / "images/r  3 and 4 5.png")
        (folder / "images/r_4.png").rename(folder / "images/0004.png")
        (folder / "images/.DS_Store").write_text("")
        (folder / "sparse/0").mkdir(parents=True)
        (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 16 16 22 22 8 8\n")
        (folder / "sparse/0/points3D.txt").write_text(
            "".join(f"{k} 0.{k} 0 0.1 9 9 9 0.5\n" for k in range(9))
        )
        return folder

    @pytest.mark.parametrize("between", ["", "\n", "1.0 2.0 -1 3.0 4.0 7\n"])
    @pytest.mark.parametrize("mark", ["", "\ufeff"])
    def test_with_and_without_observations(self, model: Path, between: str, mark: str) -> None:
        names = ["r_0.png", "r_1.png", "r_2.png", "r  3 and 4 5.png", "0004.png", "r_5.png"]
        lines = [f"{k + 1} 1 0.0{k} 0 0 0.{k} 0 4 1 {name}\n{between}" for k, name in enumerate(names)]
        (model / "sparse/0/images.txt").write_text(mark + "# a list\n" + "".join(lines), encoding="utf-8")
        scene = loaded(model)
        assert len(scene.train) + len(scene.test) == 6
        assert "r  3 and 4 5" in scene.train.names + scene.test.names

    def test_own_split(self, model: Path) -> None:
        lines = [f"{k + 1} 1 0.0{k} 0 0 0.{k} 0 4 1 r_{k + 5}.png\n\n" for k in range(6)]
        (model / "sparse/0/images.txt").write_text("".join(lines))
        (model / "sparse/0/test.txt").write_text("r_6.png\nr_8.png\n")
        assert loaded(model).test.names == ("r_6", "r_8")


def test_llff_with_reduced_images_alone(source: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fern"
    shutil.copytree(source / "train", folder / "images_4")
    for path in folder.glob("images_4/*"):
        Image.open(path).convert("RGB").save(path)
    os.symlink("nowhere", folder / "images_4/._r_0.png")
    rows = np.zeros((18, 17))
    for k in range(18):
        pose = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        rows[k] = [*np.column_stack([pose, [0.1 * k, 0, 0], [4 * SIZE + 1, 4 * SIZE, 80]]).ravel(), 1, 10]
    np.save(folder / "poses_bounds.npy", rows)
    scene = loaded(folder)
    assert scene.ndc
    assert scene.train.intrinsics[0].tolist() == [20, 20, 8, 8]


def test_linked_folder_of_images(single: Path, tmp_path: Path) -> None:
    plain = loaded(single)
    shutil.move(single / "images", tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", single / "images")
    assert torch.equal(loaded(single).train.rgba, plain.train.rgba)


def test_advice_has_an_effect(single: Path, tmp_path: Path) -> None:
    def outward(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] = -0.1 * matrix[:3, 3]
            frame["transform_matrix"] = matrix.tolist()

    edit(single, outward)
    refused(single, "look away from the point .* --box, --near and --far")
    box: dict[str, Any] = {"bounds": [[-2] * 3, [2] * 3], "near": 0.1, "far": 4.0}
    prepare(single, tmp_path / "out", **box)
    for folder, options in ((tmp_path / "out", {}), (single, box)):
        scene = loaded(folder, **options)
        assert (scene.near, scene.far, scene.bounds.tolist()) == (0.1, 4.0, [[-2] * 3, [2] * 3])
