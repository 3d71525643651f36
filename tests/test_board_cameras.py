"""`prepare` on photographs of the sheet: cameras from its markers, against those that took them."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any

import imageio
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageFilter, ImageOps

from gridreg.errors import InputError
from gridreg.scenes import Prepared, builtin_photographs, load_scene, photograph_mesh, prepare
from gridreg.scenes.board import BOARDS, get_board
from gridreg.scenes.board_cameras import board_extent, look_for_board, place_on_board
from gridreg.scenes.bundle_adjustment import Photograph
from gridreg.scenes.crops import crop_to_one_size
from gridreg.scenes.decoding import _TURNS
from gridreg.scenes.frames import Frame, StatedIntrinsics
from gridreg.scenes.lens import LensDistortion
from gridreg.scenes.photographs import doubtful_photographs, sharpest_frames
from gridreg.scenes.transforms import read_transforms

pytest.importorskip("cv2")
SIZE = 400


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_photographs(tmp_path_factory.getbasetemp() / "scenes", count=6, size=SIZE)


@pytest.fixture
def photographs(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "photographs", tmp_path / "photographs"))


def truth_of(made: Path) -> dict[str, Frame]:
    return {Path(frame.file_path).name: frame for frame in read_transforms(made / "truth").train}


def errors(scene: Path, made: Path) -> tuple[np.ndarray, np.ndarray]:
    """Angles in degrees, and distances in parts of that from the camera to the sheet's middle."""
    files = read_transforms(scene)
    frames, truth = [*files.train, *files.test], truth_of(made)
    found = np.array([frame.pose for frame in frames])
    true = np.array([truth[Path(frame.file_path).name].pose for frame in frames])
    cosine = (np.einsum("nij,nij->n", found[:, :3, :3], true[:, :3, :3]) - 1) / 2
    apart = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), apart / np.linalg.norm(true[:, :3, 3], axis=1)


def set_exif(path: Path, **tags: Any) -> None:
    """Store an image anew with other EXIF data, None takes one away."""
    with Image.open(path) as image:
        exif, lens = image.getexif(), image.getexif().get_ifd(ExifTags.IFD.Exif)
        image.load()
    for name, value in tags.items():
        tag = ExifTags.Base[name]
        target = lens if name.startswith("Focal") else exif
        target.pop(tag, None)
        if value is not None:
            target[tag] = value
    image.save(path, quality=95, exif=exif)


class TestPrepare:
    @pytest.fixture(scope="class")
    @classmethod
    def prepared(cls, made: Path, tmp_path_factory: pytest.TempPathFactory) -> Prepared:
        return prepare(made / "photographs", tmp_path_factory.mktemp("scene") / "scene")

    def test_cameras_are_true(self, prepared: Prepared, made: Path) -> None:
        assert len(prepared.registered) == 6
        assert prepared.missing == ()
        angles, apart = errors(prepared.folder, made)
        # At 400 pixels; at 1200 they are a tenth of it (benchmarks/own_photographs.py).
        assert angles.max() < 0.3
        assert apart.max() < 0.004

    def test_lens_is_true(self, prepared: Prepared, made: Path) -> None:
        content = json.loads((prepared.folder / "transforms.json").read_text())
        for frame in content["frames"]:
            assert frame["w"] == frame["h"] < 200
            assert frame["fl_x"] == pytest.approx(0.735 * SIZE, rel=0.005)
            assert frame["k1"] == pytest.approx(0.055, abs=0.02)

    def test_box_stands_on_the_sheet_and_holds_the_object(self, prepared: Prepared) -> None:
        assert prepared.extent.bounds[0].tolist() == [-0.096, -0.129, 0]
        assert 0.06 * 2.46 < prepared.extent.bounds[1, 2] < 0.42
        content = json.loads((prepared.folder / "transforms.json").read_text())
        assert (content["gridreg"]["unit"], content["gridreg"]["board"]) == ("metre", "a4")

    def test_photographs_are_cut_to_the_object(self, prepared: Prepared, made: Path) -> None:
        vertices, truth = photograph_mesh(0.05)[0], truth_of(made)
        files = read_transforms(prepared.folder)
        for frame in (*files.train, *files.test):
            width, height = (int(edge) for edge in frame.camera.size or (0, 0))
            mask = np.asarray(Image.open(prepared.folder / str(frame.mask_path)))
            assert mask.shape == (height, width)
            pose = truth[Path(frame.file_path).name].pose
            places = project_points(dataclasses.replace(frame, pose=pose), vertices)
            assert ((places > 0) & (places < [width, height])).all(axis=1).mean() > 0.99
            # The object fills what is left.
            assert np.ptp(places, axis=0).max() > 0.6 * width

    def test_scene_is_trained_on_at_home_and_its_world_is_in_metres(self, prepared: Prepared) -> None:
        scene = load_scene(prepared.folder, "holdout8")
        assert float(scene.bounds[1].max()) == pytest.approx(1.3)
        np.testing.assert_allclose(
            scene.world.outward(scene.bounds.double().numpy()), prepared.extent.bounds, atol=1e-6
        )
        files = read_transforms(prepared.folder)
        np.testing.assert_allclose(
            scene.world.outward(scene.train.poses[:, :3, 3].double().numpy()),
            [frame.pose[:3, 3] for frame in files.train],
            atol=1e-6,
        )
        tight = load_scene(prepared.folder, "holdout8", bounds=[[-0.06, -0.06, 0], [0.06, 0.06, 0.15]])
        torch.testing.assert_close(tight.bounds[1], torch.tensor([1.04, 1.04, 1.3]))

    def test_crops_show_what_their_cameras_say(self, made: Path, tmp_path: Path) -> None:
        whole = prepare(made / "photographs", tmp_path / "whole", masks="none")
        seen = look_for_board(
            [(path, (300, 300), None) for path in sorted((whole.folder / "images").iterdir())]
        )
        assert seen is not None
        board, found = seen
        files = read_transforms(whole.folder)
        frames = {Path(frame.file_path).name: frame for frame in (*files.train, *files.test)}
        off = []
        for photograph in found:
            expected = project(
                frames[photograph.name], np.concatenate([board.corners[n] for n in photograph.markers])
            )
            off += np.linalg.norm(
                np.concatenate(list(photograph.markers.values())) - expected, axis=1
            ).tolist()
        assert np.median(off) < 0.2


def project(frame: Frame, corners: np.ndarray) -> np.ndarray:
    return project_points(frame, np.pad(corners, ((0, 0), (0, 1))))


def project_points(frame: Frame, points: np.ndarray) -> np.ndarray:
    x, y, z = ((points - frame.pose[:3, 3]) @ frame.pose[:3, :3]).T
    x, y = frame.camera.distortion.distort(x / -z, y / z)
    fx, fy, cx, cy = frame.camera.intrinsics(0, 0)
    return np.stack([fx * x + cx, fy * y + cy], axis=-1)


class TestPhotographsOfPeople:
    def test_too_few_markers_are_named_and_left_out(
        self, photographs: Path, made: Path, tmp_path: Path
    ) -> None:
        Image.new("RGB", (SIZE, SIZE * 3 // 4), "grey").save(photographs / "IMG_0002.jpg")
        said: list[str] = []
        prepared = prepare(photographs, tmp_path / "scene", progress=said.append)
        assert prepared.missing == ("IMG_0002.jpg",)
        assert "IMG_0002.jpg is left out: 0 markers seen, expected 3" in said
        assert errors(prepared.folder, made)[1].max() < 0.004

    def test_every_exif_orientation(self, photographs: Path, made: Path, tmp_path: Path) -> None:
        with Image.open(photographs / "IMG_0001.jpg") as image:
            upright, exif = ImageOps.exif_transpose(image), image.getexif()
        back = {
            2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
            5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE,
            8: Image.Transpose.ROTATE_270,
        }  # fmt: skip
        for orientation, turn in back.items():
            # Each a telephone of its own: its lens turns along.
            exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Model] = orientation, f"number {orientation}"
            upright.transpose(turn).save(photographs / f"turned_{orientation}.jpg", quality=95, exif=exif)
        prepared = prepare(photographs, tmp_path / "scene")
        assert len(prepared.registered) == 13
        files = read_transforms(prepared.folder)
        poses = {Path(frame.file_path).stem: frame.pose for frame in (*files.train, *files.test)}
        for orientation in back:
            np.testing.assert_allclose(poses[f"turned_{orientation}"], poses["IMG_0001"], atol=0.03)

    def test_several_telephones_without_a_word_about_focal_length(
        self, photographs: Path, made: Path, tmp_path: Path
    ) -> None:
        for name in ("IMG_0002.jpg", "IMG_0003.jpg", "IMG_0005.jpg"):
            with Image.open(photographs / name) as image:
                larger = image.resize((600, 450), Image.Resampling.BICUBIC)
            larger.save(photographs / name, quality=95)
        for path in photographs.iterdir():
            set_exif(path, FocalLengthIn35mmFilm=None, Make=None)
        prepared = prepare(photographs, tmp_path / "scene")
        angles, apart = errors(prepared.folder, made)
        assert len(angles) == 6
        assert angles.max() < 0.7
        assert apart.max() < 0.01
        focal = {
            round(f["fl_x"]) for f in json.loads((prepared.folder / "transforms.json").read_text())["frames"]
        }
        assert len(focal) == 2

    def test_wrong_focal_length_in_exif(self, photographs: Path, made: Path, tmp_path: Path) -> None:
        for path in photographs.iterdir():
            set_exif(path, FocalLengthIn35mmFilm=33)
        prepared = prepare(photographs, tmp_path / "scene")
        assert errors(prepared.folder, made)[1].max() < 0.01

    def test_without_opencv(self, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        said: list[str] = []
        with pytest.raises(InputError, match="pycolmap is not installed"):
            prepare(photographs, tmp_path / "scene", progress=said.append)
        assert "markers are not looked for, that needs OpenCV (pip install 'gridreg[photos]')" in said

    def test_blurred_and_duplicates_are_named(self, photographs: Path) -> None:
        shutil.copy(photographs / "IMG_0001.jpg", photographs / "IMG_0007.jpg")
        with Image.open(photographs / "IMG_0003.jpg") as image:
            image.filter(ImageFilter.BoxBlur(4)).save(photographs / "IMG_0003.jpg")
        assert doubtful_photographs(sorted(photographs.iterdir())) == [
            "blurred beside the others: IMG_0003.jpg",
            "show the same, one of them adds nothing: IMG_0001.jpg and IMG_0007.jpg",
        ]

    def test_a_video_gives_its_sharpest_frames(self, photographs: Path, made: Path, tmp_path: Path) -> None:
        upright = [
            ImageOps.exif_transpose(Image.open(path)).crop((0, 0, 300, 300))
            for path in sorted(photographs.iterdir())
        ]
        with imageio.get_writer(tmp_path / "walk.mp4", fps=12, macro_block_size=1) as writer:
            for image in upright:
                for k in range(6):
                    writer.append_data(np.asarray(image if k == 4 else image.filter(ImageFilter.BoxBlur(3))))
        assert sharpest_frames(tmp_path / "walk.mp4", tmp_path / "frames", count=6) == 6
        for path, image in zip(sorted((tmp_path / "frames").iterdir()), upright, strict=True):
            taken = np.asarray(Image.open(path), dtype=float)
            blurred = np.asarray(image.filter(ImageFilter.BoxBlur(3)), dtype=float)
            assert np.abs(taken - image).mean() < 0.6 * np.abs(taken - blurred).mean()
        (tmp_path / "broken.mp4").write_bytes(b"no video")
        with pytest.raises(InputError, match=r"broken\.mp4: not a video that ffmpeg can read"):
            prepare(tmp_path / "broken.mp4", tmp_path / "scene")


def looking(count: int, focal: float, lens: LensDistortion) -> list[Frame]:
    """Cameras around the sheet, exact."""
    rng, frames = np.random.default_rng(1), []
    for k in range(count):
        a, e = 2 * np.pi * k / count, rng.uniform(0.4, 1.0)
        back = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=-1)
        pose[:3, 3] = rng.uniform(0.4, 0.6) * back + rng.uniform(-0.02, 0.02, 3)
        camera = StatedIntrinsics(fx=focal, fy=focal, cx=606, cy=441, width=1200, height=900, distortion=lens)
        frames.append(Frame(f"images/{k}", pose, camera, str(k)))
    return frames


class TestPlaceOnBoard:
    """Without images: corners are projected by the lens's own formula."""

    def photographs(self, frames: list[Frame], paper: str = "letter", **changes: Any) -> list[Photograph]:
        corners = BOARDS[paper].corners
        return [
            Photograph(
                frame.file_path[7:], (1200, 900), None, ("lens",), changes.get("focal", 900.0),
                {n: project(frame, places) for n, places in corners.items()},
            )
            for frame in frames
        ]  # fmt: skip

    @pytest.mark.parametrize("focal", [900.0, None])
    def test_exact_corners_give_exact_cameras(self, focal: float | None) -> None:
        frames = looking(7, 880.0, LensDistortion(k1=0.05, k2=-0.03))
        found = place_on_board(get_board("letter"), self.photographs(frames, focal=focal), lambda text: None)
        assert found.off < 0.01
        for frame, expected in zip(found.frames, frames, strict=True):
            np.testing.assert_allclose(frame.pose, expected.pose, atol=3e-4)
            assert frame.camera.fx == pytest.approx(880, rel=1e-3)
            assert frame.camera.distortion.k1 == pytest.approx(0.05, abs=2e-3)

    def test_one_that_does_not_fit_is_named(self) -> None:
        photographs = self.photographs(looking(6, 880.0, LensDistortion()))
        photographs[2].markers = dict(
            zip(photographs[2].markers, reversed(photographs[2].markers.values()), strict=True)
        )
        found = place_on_board(get_board("letter"), photographs, lambda text: None)
        assert list(found.left_out) == ["2"]
        assert "was the sheet moved" in found.left_out["2"]
        assert len(found.frames) == 5
        assert found.off < 0.01

    def test_a_marker_of_somebody_else_does_no_harm(self) -> None:
        frames = looking(6, 880.0, LensDistortion())
        photographs = self.photographs(frames)
        for photograph in photographs:
            photograph.markers[30] = photograph.markers[30] + [250.0, -90.0]
        found = place_on_board(get_board("letter"), photographs, lambda text: None)
        for frame, expected in zip(found.frames, frames, strict=True):
            np.testing.assert_allclose(frame.pose, expected.pose, atol=1e-3)

    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_principal_point_turns_with_the_telephone(self, orientation: int) -> None:
        """One lens, off its middle, in images that were stored upright and in others that were turned."""
        turn = {1: None, **_TURNS}[orientation]
        frames = looking(8, 880.0, LensDistortion())
        stored = np.zeros((9, 12), dtype=np.uint8)
        # A mark near the middle, where the principal point is: (606, 441) of 1200 x 900.
        marked = Image.fromarray(stored).resize((1200, 900))
        marked.putpixel((606, 441), 255)
        turned = marked if turn is None else marked.transpose(turn)
        row, column = np.argwhere(np.asarray(turned))[0]
        half = [
            dataclasses.replace(
                f,
                camera=dataclasses.replace(
                    f.camera, cx=float(column), cy=float(row), width=turned.width, height=turned.height
                ),
            )
            for f in frames[4:]
        ]
        photographs = self.photographs([*frames[:4], *half])
        for photograph in photographs[4:]:
            photograph.size, photograph.turn = turned.size, turn
        found = place_on_board(get_board("letter"), photographs, lambda text: None)
        for frame, expected in zip(found.frames, [*frames[:4], *half], strict=True):
            np.testing.assert_allclose(frame.pose, expected.pose, atol=3e-3)
            assert frame.camera.cx == pytest.approx(expected.camera.cx, abs=1.5)
            assert frame.camera.cy == pytest.approx(expected.camera.cy, abs=1.5)

    def test_many_photographs(self) -> None:
        frames = looking(60, 880.0, LensDistortion(k1=0.05))
        found = place_on_board(get_board("letter"), self.photographs(frames), lambda text: None)
        assert len(found.frames) == 60
        for frame, expected in zip(found.frames, frames, strict=True):
            np.testing.assert_allclose(frame.pose, expected.pose, atol=3e-4)


def test_box_is_as_high_as_photographs_show() -> None:
    # Level cameras half a metre away: half of 900 pixels at a focal length of 900 are 0.25 m up or down.
    frames = []
    for a in np.linspace(0, 2 * np.pi, 5)[:-1]:
        back, right = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=-1)
        pose[:3, 3] = 0.5 * back + [0, 0, 0.05]
        frames.append(Frame("a", pose, StatedIntrinsics(fx=900, width=1200, height=900), "a"))
    extent = board_extent(get_board("a4"), frames)
    assert extent.bounds[1, 2] == pytest.approx(0.30, abs=0.003)
    assert 0 < extent.near < 0.5 - 0.129
    assert extent.far > 0.5 + 0.129


def test_crops_keep_every_ray(tmp_path: Path) -> None:
    """A pixel of the crop shows what the ray of its new camera met in the original."""
    (tmp_path / "images").mkdir()
    sizes = {"images/a.png": (40, 30), "images/b.png": (60, 80)}
    frames = looking(2, 30.0, LensDistortion(k1=0.01))
    for k, (name, (width, height)) in enumerate(sizes.items()):
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        Image.fromarray(np.stack([columns, rows, 0 * rows], axis=-1).astype(np.uint8)).save(tmp_path / name)
        camera = StatedIntrinsics(
            fx=30.0 + k, fy=30.0, cx=width / 2, cy=height / 2 + 1, width=width, height=height
        )
        frames[k] = dataclasses.replace(frames[k], file_path=name, camera=camera)
    cropped, size = crop_to_one_size(frames, tmp_path, sizes)
    assert size == (30, 30)
    for before, after in zip(frames, cropped, strict=True):
        image = np.asarray(Image.open(tmp_path / after.file_path), dtype=float)
        assert image.shape == (30, 30, 3)
        old, new = before.camera.intrinsics(0, 0), after.camera.intrinsics(0, 0)
        for row, column in ((3, 4), (20, 11)):
            x, y = (column + 0.5 - new[2]) / new[0], (row + 0.5 - new[3]) / new[1]
            np.testing.assert_allclose(
                image[row, column, :2] + 0.5, [old[0] * x + old[2], old[1] * y + old[3]], atol=0.51
            )
        assert after.pose is before.pose
