"""COLMAP models, text and binary, written from the built-in scene and read back."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from gridreg.errors import InputError
from gridreg.scenes import Scene, builtin_scene, builtin_surface, load_scene
from gridreg.scenes.colmap_model import read_model
from gridreg.scenes.lens import LensDistortion

SIZE = 16
FOCAL = 22.0
POINTS, _ = builtin_surface(400, torch.Generator().manual_seed(0))
MODELS = {
    "SIMPLE_PINHOLE": (0, [FOCAL, 8, 8]),
    "PINHOLE": (1, [FOCAL, FOCAL + 1, 8, 7.5]),
    "SIMPLE_RADIAL": (2, [FOCAL, 8, 8, 0.01]),
    "RADIAL": (3, [FOCAL, 8, 8, 0.01, -0.02]),
    "OPENCV": (4, [FOCAL, FOCAL, 8, 8, 0.01, -0.02, 0.001, 0.002]),
    "FULL_OPENCV": (6, [FOCAL, FOCAL, 8, 8, 0.01, -0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06]),
}
Posed = list[tuple[str, np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)
    return folder, load_scene(folder, "first18", test=[])


def posed(scene: Scene) -> Posed:
    """Names, quaternions (w first) and translations from world to camera, camera y down."""
    listed = []
    for name, pose in zip(scene.train.names, scene.train.poses.numpy().astype(np.float64), strict=True):
        inverse = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        listed.append((f"{name}.png", np.array([w, x, y, z]), inverse[:3, 3]))
    return listed


def write_text(folder: Path, images: Posed, model: str = "SIMPLE_PINHOLE") -> None:
    folder.mkdir(parents=True)
    parameters = " ".join(map(str, MODELS[model][1]))
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {model} {SIZE} {SIZE} {parameters}\n")
    lines = ["# Image list with two lines of data per image:"]
    for k, (name, quaternion, translation) in enumerate(images):
        lines += [
            " ".join(map(repr, [k + 1, *map(float, quaternion), *map(float, translation), 7])) + f" {name}"
        ]
        # Every other image has observations, the others an empty line.
        lines += ["1.5 2.5 -1 3.0 4.0 12" if k % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{k} {x!r} {y!r} {z!r} 10 20 30 0.5 1 2 3 4" for k, (x, y, z) in enumerate(POINTS.tolist())]
    (folder / "points3D.txt").write_text("# 3D points\n" + "\n".join(rows) + "\n")


def write_binary(folder: Path, images: Posed, model: str = "SIMPLE_PINHOLE") -> None:
    folder.mkdir(parents=True)
    number, parameters = MODELS[model]
    camera = struct.pack(f"<iiQQ{len(parameters)}d", 7, number, SIZE, SIZE, *parameters)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    data = struct.pack("<Q", len(images))
    for k, (name, quaternion, translation) in enumerate(images):
        data += struct.pack("<i7di", k + 1, *quaternion, *translation, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", k % 3) + struct.pack("<ddq", 1.5, 2.5, -1) * (k % 3)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for k, point in enumerate(POINTS):
        data += struct.pack("<Q3d3BdQ", k, *point, 1, 2, 3, 0.5, k % 4) + struct.pack("<ii", 1, 2) * (k % 4)
    (folder / "points3D.bin").write_bytes(data)


WRITERS: dict[str, Callable[..., None]] = {"text": write_text, "binary": write_binary}


@pytest.fixture
def scene(original: tuple[Path, Scene], tmp_path: Path) -> Path:
    folder = tmp_path / "statue"
    shutil.copytree(original[0] / "train", folder / "images")
    return folder


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_reads_what_was_written(original: tuple[Path, Scene], scene: Path, form: str, place: str) -> None:
    source = original[1].train
    model = scene / place
    if place == ".":
        WRITERS[form](scene / "made", posed(original[1]))
        for path in (scene / "made").iterdir():
            path.rename(scene / path.name)
    else:
        WRITERS[form](model, posed(original[1]))
    loaded = load_scene(scene, "holdout8")
    # In the order of their names: r_0, r_1, r_10, ...; every eighth is held out.
    names = sorted(f"r_{k}.png" for k in range(18))
    assert loaded.test.names == tuple(Path(name).stem for name in names[::8])
    assert loaded.train.names == tuple(Path(name).stem for i, name in enumerate(names) if i % 8)
    for views in (loaded.train, loaded.test):
        rows = [source.names.index(name) for name in views.names]
        assert torch.equal(views.rgba, source.rgba[rows])
        torch.testing.assert_close(views.poses, source.poses[rows], atol=1e-5, rtol=0)
        assert views.intrinsics[0].tolist() == [FOCAL, FOCAL, 8, 8]


def test_box_near_and_far_come_from_the_points(original: tuple[Path, Scene], scene: Path) -> None:
    write_binary(scene / "sparse/0", posed(original[1]))
    loaded = load_scene(scene, "holdout8")
    low, high = loaded.bounds.numpy()
    assert (np.quantile(POINTS, 0.01, axis=0) > low).all()
    assert (np.quantile(POINTS, 0.99, axis=0) < high).all()
    assert (low > -2.2).all()
    assert (high < 2.2).all()
    distances = np.linalg.norm(POINTS[None] - loaded.train.poses[:, None, :3, 3].numpy(), axis=-1)
    assert 2 < loaded.near < np.quantile(distances, 0.01)
    assert distances.max() < loaded.far < 7


def test_without_points_the_cameras_tell(original: tuple[Path, Scene], scene: Path) -> None:
    write_text(scene / "sparse/0", posed(original[1]))
    (scene / "sparse/0/points3D.txt").write_text("# none\n")
    loaded = load_scene(scene, "holdout8")
    assert loaded.bounds.tolist() == [[-1.5] * 3, [1.5] * 3]


def test_protocols_index_the_frames_that_are_not_held_out(original: tuple[Path, Scene], scene: Path) -> None:
    write_text(scene / "sparse/0", posed(original[1]))
    loaded = load_scene(scene, "spread3")
    assert loaded.train.ids == (0, 7, 14)
    assert len(loaded.test) == 3
    assert len(load_scene(scene, "views4").test) == 3
    assert load_scene(scene, "spread3", test=[2]).test.ids == (2,)


@pytest.mark.parametrize("name", list(MODELS))
@pytest.mark.parametrize("form", ["text", "binary"])
def test_camera_models(original: tuple[Path, Scene], tmp_path: Path, name: str, form: str) -> None:
    WRITERS[form](tmp_path / "m", posed(original[1]), name)
    camera = read_model(tmp_path / "m").cameras[7]
    assert (camera.model, camera.width, camera.height) == (name, SIZE, SIZE)
    assert list(camera.parameters.values()) == MODELS[name][1]
    lens = LensDistortion(**{key: value for key, value in camera.parameters.items() if key[0] in "kp"})
    if name == "FULL_OPENCV":
        assert lens == LensDistortion(
            k1=0.01, k2=-0.02, p1=0.001, p2=0.002, k3=0.03, k4=0.04, k5=0.05, k6=0.06
        )
    if name == "SIMPLE_RADIAL":
        assert lens == LensDistortion(k1=0.01)


def test_a_distorting_camera_is_undone(original: tuple[Path, Scene], scene: Path) -> None:
    write_text(scene / "sparse/0", posed(original[1]), "OPENCV")
    loaded = load_scene(scene, "holdout8")
    assert loaded.train.rgba.shape == (15, SIZE, SIZE, 4)
    assert loaded.train.intrinsics[0, 0] != FOCAL


class TestMasks:
    def test_become_alpha(self, original: tuple[Path, Scene], scene: Path) -> None:
        write_text(scene / "sparse/0", posed(original[1]))
        for path in (scene / "images").iterdir():
            Image.open(path).convert("RGB").save(path)
        (scene / "masks").mkdir()
        half = np.zeros((SIZE, SIZE), np.uint8)
        half[: SIZE // 2] = 255
        for k in range(18):
            Image.fromarray(half).save(scene / f"masks/r_{k}.png{'.png' if k % 2 else ''}")
        loaded = load_scene(scene, "holdout8")
        assert bool((loaded.train.rgba[:, : SIZE // 2, :, 3] == 1).all())
        assert bool((loaded.train.rgba[:, SIZE // 2 :, :, 3] == 0).all())
        # Points may lie on what the masks cut away, so the cameras tell the box.
        assert loaded.bounds.tolist() == [[-1.5] * 3, [1.5] * 3]

    def test_missing(self, original: tuple[Path, Scene], scene: Path) -> None:
        write_text(scene / "sparse/0", posed(original[1]))
        (scene / "masks").mkdir()
        with pytest.raises(InputError, match=r"masks: no mask for image r_0\.png, expected r_0\.png\.png"):
            load_scene(scene, "holdout8")

    def test_of_another_size(self, original: tuple[Path, Scene], scene: Path) -> None:
        write_text(scene / "sparse/0", posed(original[1]))
        (scene / "masks").mkdir()
        for k in range(18):
            Image.new("L", (SIZE, 9)).save(scene / f"masks/r_{k}.png")
        with pytest.raises(InputError, match=r"masks/r_1\.png: mask is 16x9, expected 16x16 as its image"):
            load_scene(scene, "holdout8")


def refused(folder: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        load_scene(folder, "holdout8", **options)
    assert "\n" not in str(error.value)


class TestBadInput:
    @pytest.fixture(autouse=True)
    def write(self, original: tuple[Path, Scene], scene: Path) -> None:
        write_binary(scene / "sparse/0", posed(original[1]))
        write_text(scene / "text", posed(original[1]))

    def use_text(self, scene: Path) -> Path:
        shutil.rmtree(scene / "sparse")
        shutil.move(scene / "text", scene / "sparse")
        return scene / "sparse"

    def test_two_models(self, scene: Path) -> None:
        shutil.copytree(scene / "sparse/0", scene / "sparse/1")
        refused(scene, r"expected one COLMAP model, found sparse/0, sparse/1; leave only the one to use")

    def test_no_images(self, scene: Path) -> None:
        shutil.rmtree(scene / "images")
        refused(scene, r"folder images/ with the images of the COLMAP model not found")

    def test_missing_image(self, scene: Path) -> None:
        (scene / "images/r_3.png").unlink()
        loaded = load_scene(scene, "holdout8")
        assert len(loaded.train) + len(loaded.test) == 17
        assert "1 of 18 frames have no image and are left out" in loaded.notes[0]
        for path in list((scene / "images").iterdir())[1:]:
            path.unlink()
        refused(scene, r"image r_.*\.png: image .*images/r_.*\.png not found \(nor 16 more of 18\)")

    def test_image_of_another_size(self, scene: Path) -> None:
        Image.new("RGBA", (SIZE, 12)).save(scene / "images/r_3.png")
        refused(scene, r"images/r_3\.png: image is 16x12, expected w x h of its camera, 16x16")

    @pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
    @pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
    def test_cut_binary(self, scene: Path, name: str, share: float) -> None:
        path = scene / f"sparse/0/{name}.bin"
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        refused(scene, rf"{name}\.bin: not a COLMAP file, or cut short")

    @pytest.mark.parametrize("name", ["cameras", "points3D"])
    def test_missing_file(self, scene: Path, name: str) -> None:
        (scene / f"sparse/0/{name}.bin").unlink()
        refused(scene, rf"{name}\.bin: file not found")

    def test_huge_counts(self, scene: Path) -> None:
        (scene / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", 2**63) + b"x" * 100)
        refused(scene, r"points3D\.bin: not a COLMAP file, or cut short")

    def test_unknown_camera_number(self, scene: Path) -> None:
        data = struct.pack("<QiiQQ8d", 1, 7, 5, SIZE, SIZE, *range(8))
        (scene / "sparse/0/cameras.bin").write_bytes(data)
        refused(scene, r"cameras\.bin: camera model 5 is not supported, expected one of SIMPLE_PINHOLE")

    @pytest.mark.parametrize(
        ("line", "pattern"),
        [
            ("7 OPENCV_FISHEYE 16 16 1 1 8 8 0 0 0 0", "camera model OPENCV_FISHEYE is not supported"),
            ("7 PINHOLE 16 16 22 8 8", "camera model PINHOLE has 3 parameters, expected 4"),
            ("7 SIMPLE_PINHOLE 16 16 nan 8 8", "are not finite"),
            ("7 SIMPLE_PINHOLE 16 16 -22 8 8", "the focal length is not positive"),
            ("7 SIMPLE_PINHOLE 16", "not a COLMAP file, or cut short"),
            ("seven SIMPLE_PINHOLE 16 16 22 8 8", "not a COLMAP file, or cut short"),
        ],
    )
    def test_camera_lines(self, scene: Path, line: str, pattern: str) -> None:
        (self.use_text(scene) / "cameras.txt").write_text(line + "\n")
        refused(scene, rf"cameras\.txt: .*{pattern}")

    @pytest.mark.parametrize(
        ("line", "pattern"),
        [
            ("1 0 0 0 0 0 0 0 7 r_0.png", r"image r_0\.png: rotation \(0\.0, .*\) is no quaternion"),
            ("1 nan 0 0 0 0 0 0 7 r_0.png", "is no quaternion"),
            ("1 1 0 0 0 0 inf 0 7 r_0.png", r"image r_0\.png: translation \(0\.0, inf, 0\.0\) is not finite"),
            (
                "1 1 0 0 0 0 0 0 8 r_0.png",
                r"images\.txt: image 'r_0\.png' has camera 8, not in .*cameras\.txt",
            ),
            ("1 1 0 0 0 0 0 7 r_0.png", "not a COLMAP file, or cut short"),
            ("", r"images\.txt: holds no registered image"),
        ],
    )
    def test_image_lines(self, scene: Path, line: str, pattern: str) -> None:
        (self.use_text(scene) / "images.txt").write_text(line + "\n\n")
        refused(scene, pattern)

    def test_a_name_that_climbs_out(self, scene: Path) -> None:
        model = self.use_text(scene)
        os.rename(scene / "images/r_1.png", scene.parent / "r_1.png")
        lines = (model / "images.txt").read_text().replace(" r_1.png", " ../../r_1.png")
        (model / "images.txt").write_text(lines)
        refused(scene, r"file_path 'images/\.\./\.\./r_1\.png' leads out of the scene folder")

    def test_one_image_is_too_few(self, scene: Path) -> None:
        (self.use_text(scene) / "images.txt").write_text("1 1 0 0 0 0 0 4 7 r_0.png\n\n")
        refused(scene, r"found 1 frames, expected at least 2")

    def test_a_box_that_holds_no_point(self, scene: Path) -> None:
        refused(
            scene, "bounds: the box .* holds none of the scene's 400 points", bounds=[[5, 5, 5], [6, 6, 6]]
        )

    def test_no_camera_has_points_before_it(self, scene: Path) -> None:
        model = self.use_text(scene)
        (model / "points3D.txt").write_text("1 0 0 90 1 1 1 0\n")
        (model / "images.txt").write_text("1 1 0 0 0 0 0 99 7 r_0.png\n\n2 1 0 0 0 0 0 99 7 r_1.png\n\n")
        loaded = load_scene(scene, "holdout8")
        assert loaded.near > 100
        (model / "points3D.txt").write_text("1 0 0 -990 1 1 1 0\n")
        refused(scene, "cameras: none has a point of the model before it; give bounds, near and far")
