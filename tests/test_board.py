"""The sheet to print, and the built-in photographs of an object on it."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from gridreg.cli import main
from gridreg.errors import InputError
from gridreg.scenes import builtin_photographs, photograph_mesh
from gridreg.scenes.board import BOARDS, Board, board_image, draw_board, get_board, marker_bits
from gridreg.scenes.transforms import read_transforms

SIZE = 400


@pytest.mark.parametrize("board", BOARDS.values(), ids=list(BOARDS))
class TestBoard:
    def test_page_has_the_size_of_its_paper(self, board: Board, tmp_path: Path) -> None:
        draw_board(tmp_path / "a.pdf", board.paper)
        data = (tmp_path / "a.pdf").read_bytes()
        box = re.search(rb"/MediaBox \[ ?([\d. ]+)\]", data)
        assert box is not None
        points = [float(value) for value in box[1].split()]
        sizes = {"a4": (210, 297), "letter": (215.9, 279.4), "a3": (297, 420)}
        np.testing.assert_allclose(points, [0, 0, *np.array(sizes[board.paper]) / 25.4 * 72], atol=1e-3)
        # The first marker's corner in the page's own drawing, in points from the lower left.
        drawing = b"".join(
            zlib.decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)endstream", data, re.S)
        )
        numbers = np.array(
            [[float(a), float(b)] for a, b in re.findall(rb"([\d.]+) ([\d.]+) [ml]\b", drawing)]
        )
        corner = (np.array(board.middle) + board.corners[board.first][0]) / 0.0254 * 72
        assert np.abs(numbers - corner).max(axis=1).min() < 1e-3
        draw_board(tmp_path / "b.pdf", board.paper.upper())
        assert (tmp_path / "b.pdf").read_bytes() == data

    def test_opencv_finds_every_marker_in_its_place(self, board: Board) -> None:
        cv2 = pytest.importorskip("cv2")
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
        for number in board.corners:
            drawn = dictionary.generateImageMarker(number, 6)[1:5, 1:5] > 0
            np.testing.assert_array_equal(marker_bits(number), drawn)
        image = board_image(board, 5)
        np.testing.assert_allclose(image.shape, [5e3 * board.height, 5e3 * board.width], atol=1)
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
        assert sorted(numbers.ravel().tolist()) == sorted(board.corners)
        for found, number in zip(corners, numbers.ravel().tolist(), strict=True):
            place = (found[0] + 0.5) / 5e3
            place[:, 1] = board.height - place[:, 1]
            np.testing.assert_allclose(place - board.middle, board.corners[number], atol=0.3e-3)

    def test_middle_is_free_and_markers_keep_off_the_edge(self, board: Board) -> None:
        image = board_image(board, 2)
        x, y = 2e3 * np.array(board.middle)
        half = 1e3 * np.array(board.free) - 1
        rows = slice(int(len(image) - y - half[1]), int(len(image) - y + half[1]))
        assert (image[rows, int(x - half[0]) : int(x + half[0])] == 255).all()
        everything = np.concatenate(list(board.corners.values())) + board.middle
        assert everything.min() > 0.008
        assert (everything < [board.width - 0.008, board.height - 0.008]).all()

    def test_ruler(self, board: Board) -> None:
        image = board_image(board, 10)
        dark = (image < 128)[len(image) - 270 :]
        widest = max(
            np.flatnonzero(row).tolist()[-1] - np.flatnonzero(row)[0] for row in dark[50:] if row.any()
        )
        line = max(
            np.diff(np.flatnonzero(np.diff(np.pad(row.astype(int), 1)))).max(initial=0) for row in dark
        )
        assert line == pytest.approx(1002, abs=1)
        assert widest > line


def test_papers_share_no_marker() -> None:
    numbers = [number for board in BOARDS.values() for number in board.corners]
    assert len(set(numbers)) == len(numbers) == 72


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_photographs(tmp_path_factory.getbasetemp() / "scenes", count=6, size=SIZE)


class TestPhotographs:
    def test_are_what_a_telephone_stores(self, made: Path) -> None:
        paths = sorted((made / "photographs").iterdir())
        assert [path.name for path in paths] == [f"IMG_000{k}.jpg" for k in range(1, 7)]
        for path, orientation in zip(paths, (1, 1, 1, 6, 1, 1), strict=True):
            image = Image.open(path)
            assert image.size == (SIZE, SIZE * 3 // 4)
            assert image.getexif()[ExifTags.Base.Orientation] == orientation
            assert image.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 25
            upright = np.asarray(ImageOps.exif_transpose(image), dtype=float)
            truth = np.asarray(Image.open(made / "truth/images" / path.name), dtype=float)
            assert np.abs(upright - truth).mean() < 3

    def test_true_cameras_see_the_markers_where_they_are(self, made: Path) -> None:
        cv2 = pytest.importorskip("cv2")
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100))
        board, errors = get_board("a4"), []
        for frame in read_transforms(made / "truth").test:
            image = cv2.imread(str(made / "truth" / frame.file_path), cv2.IMREAD_GRAYSCALE)
            image = cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
            corners, numbers, _ = detector.detectMarkers(image)
            fx, fy, cx, cy = frame.camera.intrinsics(0, 0)
            for found, number in zip(
                corners, [] if numbers is None else numbers.ravel().tolist(), strict=True
            ):
                points = np.pad(board.corners[number], ((0, 0), (0, 1))) - frame.pose[:3, 3]
                x, y, z = (points @ frame.pose[:3, :3]).T
                x, y = frame.camera.distortion.distort(x / -z, y / z)
                expected = np.stack([fx * x + cx, fy * y + cy], axis=-1)
                # Corners move inwards, since light spreads over dark ink; their mean does not.
                errors.append(np.linalg.norm(((found[0] + 0.5) / 3 - expected).mean(axis=0)))
        assert len(errors) > 80
        assert np.median(errors) < 0.2

    def test_truth_is_a_scene_whose_masks_hold_the_mesh(self, made: Path) -> None:
        vertices, _ = photograph_mesh(0.05)
        np.testing.assert_allclose(vertices[:, 2].min(), 0, atol=1e-12)
        np.testing.assert_allclose(vertices[:, 2].max(), 0.06 * (1.22 + 1.24), atol=1e-3)
        frames = read_transforms(made / "truth")
        assert (len(frames.train), len(frames.test)) == (6, 8)
        for frame in frames.train:
            mask = np.asarray(Image.open(made / "truth" / str(frame.mask_path))) / 255
            fx, fy, cx, cy = frame.camera.intrinsics(0, 0)
            x, y, z = ((vertices - frame.pose[:3, 3]) @ frame.pose[:3, :3]).T
            x, y = frame.camera.distortion.distort(x / -z, y / z)
            column, row = (fx * x + cx).astype(int), (fy * y + cy).astype(int)
            assert (mask[row, column] > 0).mean() > 0.98
            drawn = np.zeros(mask.shape)
            drawn[row, column] = 1
            # The outline of what is solid is where the outermost vertices are.
            for axis in (0, 1):
                ends = [np.flatnonzero(each.any(axis=axis))[[0, -1]] for each in (mask > 0.02, drawn)]
                assert np.abs(ends[0] - ends[1]).max() <= 2

    def test_once_and_the_same(self, made: Path, tmp_path: Path) -> None:
        before = (made / "photographs/IMG_0002.jpg").stat().st_mtime_ns
        assert builtin_photographs(made.parent, count=6, size=SIZE) == made
        assert (made / "photographs/IMG_0002.jpg").stat().st_mtime_ns == before
        first, second = (builtin_photographs(tmp_path / name, count=1, size=64) for name in "ab")
        for path in (first / "photographs").iterdir():
            assert path.read_bytes() == (second / "photographs" / path.name).read_bytes()

    def test_refuses(self, tmp_path: Path) -> None:
        for options, text in (({"size": 66}, "size: found 66"), ({"count": 0}, "count: found 0")):
            with pytest.raises(InputError, match=text):
                builtin_photographs(tmp_path, **options)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["board", "--out", "b.pdf", "--photographs", "shots", "--count", "1", "--size", "64"]) == 0
    assert "b.pdf: a4, 210 x 297 mm" in capsys.readouterr().out
    assert (tmp_path / "shots/photographs_a4_1x64/photographs/IMG_0001.jpg").is_file()
    assert main(["board", "--out", "c.pdf", "--paper", "leter"]) == 2
    assert "found 'leter', expected a4, letter, a3; did you mean 'letter'?" in capsys.readouterr().err
    assert main(["board", "--out", "none/c.pdf"]) == 2
    assert "none/c.pdf: cannot be written" in capsys.readouterr().err
    assert main(["board"]) == 2
