"""Masks that nobody drew: from the sheet against the true ones, by a network, and none where there is no way."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gridreg.cli import main
from gridreg.errors import InputError
from gridreg.export.cameras import look_at
from gridreg.scenes import builtin_photographs, load_scene
from gridreg.scenes.auto_masks import check_masks, cut_masks, draw_masks
from gridreg.scenes.board import board_image, get_board
from gridreg.scenes.frames import Frame
from gridreg.scenes.lens import LensDistortion
from gridreg.scenes.sheet_masks import _print_at, cut_from_sheet
from gridreg.scenes.sheet_views import SheetView
from gridreg.scenes.transforms import read_transforms

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_photographs(tmp_path_factory.getbasetemp() / "scenes", count=6, size=400)


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> tuple[Path, list[Frame]]:
    """The true photographs and cameras, without their masks."""
    shutil.copytree(made / "truth/images", tmp_path / "images")
    frames = [replace(frame, mask_path=None) for frame in read_transforms(made / "truth").train]
    return tmp_path, frames


def mask_at(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("L")) > 127


def agreement(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union."""
    return float((one & other).sum() / (one | other).sum())


def test_masks_from_the_sheet_are_the_true_ones(made: Path, scene: tuple[Path, list[Frame]]) -> None:
    folder, frames = scene
    cut, said = cut_masks(folder, frames, get_board("a4"))
    assert said.startswith("masks from the sheet")
    found = [
        agreement(mask_at(folder / str(frame.mask_path)), mask_at(made / f"truth/{frame.mask_path}"))
        for frame in cut
    ]
    assert len(found) == 6
    # At 1200 pixels and eight photographs 0.97; thin parts are lost at this size.
    assert np.mean(found) > 0.93
    assert min(found) > 0.88
    again, _ = cut_masks(folder, frames, get_board("a4"))
    assert all(frame.mask_path for frame in again)
    with Image.open(folder / "masks.jpg") as sheet:
        assert sheet.size == (4 * 360, 2 * 376)


def test_prepare_cuts_masks_by_itself_or_not_at_all(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    photographs = str(made / "photographs")
    assert main(["prepare", photographs, str(tmp_path / "cut")]) == 0
    assert "look at masks.jpg" in capsys.readouterr().err
    frames = json.loads((tmp_path / "cut/transforms.json").read_text())["frames"]
    assert all(mask_at(tmp_path / "cut" / frame["mask_path"]).any() for frame in frames)
    assert (tmp_path / "cut/masks.jpg").is_file()
    alpha = load_scene(tmp_path / "cut", "holdout8").train.rgba[..., 3]
    assert 0.02 < float(alpha.mean()) < 0.3
    assert main(["prepare", photographs, str(tmp_path / "whole"), "--masks", "none"]) == 0
    assert not any((tmp_path / "whole" / name).exists() for name in ("masks", "masks.jpg"))


def page_view(azimuth: float, elevation: float) -> SheetView:
    """The empty sheet on a grey table."""
    board = get_board("a4")
    a, e = np.radians([azimuth, elevation])
    place = 0.4 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    pose = look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])).double().numpy()
    view = SheetView(
        np.zeros((150, 200, 3), np.uint8), pose, (170.0, 170.0, 100.0, 75.0), LensDistortion(k1=0.02)
    )
    printed = _print_at(view.on_table(), board, board_image(board, 4) / 255)
    view.rgb[:] = np.rint(np.where(printed < 0, 120, 40 + 180 * printed))[..., None]
    return view


def test_an_empty_sheet_has_nothing_on_it() -> None:
    views = [page_view(60.0 * k, 30.0 + 5 * k) for k in range(6)]
    assert cut_from_sheet(views, get_board("a4")) is None


def test_places_on_the_table_are_where_the_pixels_are() -> None:
    view = page_view(30.0, 40.0)
    places = view.on_table()
    found, inside = view.pixels(places[40:-40:7, 40:-40:9].reshape(-1, 3))
    rows, columns = np.meshgrid(np.arange(40, 110, 7), np.arange(40, 160, 9), indexing="ij")
    assert inside.all()
    assert np.abs(found - np.stack([rows, columns], -1).reshape(-1, 2)).max() <= 1


def test_where_there_is_no_way_images_stay_whole(scene: tuple[Path, list[Frame]]) -> None:
    folder, frames = scene
    assert cut_masks(folder, frames) == (frames, "")
    masked = [replace(frame, mask_path="own.png") for frame in frames]
    assert cut_masks(folder, masked, get_board("a4"))[0] == masked
    clear = Image.open(folder / frames[0].file_path).convert("RGBA")
    clear.putpixel((0, 0), (0, 0, 0, 0))
    for frame in frames:
        clear.save(folder / frame.file_path, format="PNG")
    assert cut_masks(folder, frames, get_board("a4")) == (frames, "")
    assert not (folder / "masks").exists()


def test_a_network_that_the_user_brings(
    scene: tuple[Path, list[Frame]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder, frames = scene
    model = tmp_path / "u2netp.onnx"
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="no such model file"):
        cut_masks(folder, frames, network=check_masks("rembg", model))
    model.write_bytes(b"a network")
    with pytest.raises(
        InputError, match="masks by rembg: onnxruntime is not installed, expected: pip install"
    ):
        cut_masks(folder, frames, network=check_masks("rembg", model))

    class Session:
        """Sees the object in what is bright in the red channel."""

        def __init__(self, path: str, providers: list[str]) -> None:
            assert providers == ["CPUExecutionProvider"]
            if Path(path).read_bytes() != b"a network":
                raise ValueError("INVALID_PROTOBUF\nmore")

        def get_inputs(self) -> list[SimpleNamespace]:
            return [SimpleNamespace(name="input.1", shape=[1, 3, 320, 320])]

        def run(self, names: None, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            values = feed["input.1"]
            assert values.shape == (1, 3, 320, 320)
            assert values.dtype == np.float32
            # ImageNet's mean and deviation: undone, colours are in [0, 1] again.
            red = values[:, :1] * 0.229 + 0.485
            assert red.min() >= -0.01
            assert red.max() <= 1.01
            return [red]

    runtime = ModuleType("onnxruntime")
    runtime.InferenceSession = Session
    monkeypatch.setitem(sys.modules, "onnxruntime", runtime)
    image = np.zeros((90, 120, 3), np.uint8)
    image[20:70, 30:100] = (255, 0, 0)
    for frame in frames:
        Image.fromarray(image).save(folder / frame.file_path, format="PNG")
    cut, said = cut_masks(folder, frames, network=check_masks("rembg", model))
    assert said.startswith("masks by u2netp.onnx")
    assert agreement(mask_at(folder / str(cut[0].mask_path)), image[..., 0] > 0) > 0.97
    model.write_bytes(b"something else")
    with pytest.raises(
        InputError, match=r"u2netp\.onnx: cannot be read as a network of rembg: INVALID_PROTOBUF$"
    ):
        cut_masks(folder, frames, network=check_masks("rembg", model))


def test_words_that_do_not_go_together(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    photographs, out = str(made / "photographs"), str(tmp_path / "out")
    for words, said in (
        (["--masks", "rembg"], "rembg takes a model file"),
        (["--model", "u2net.onnx"], "rembg takes a model file"),
        (
            ["--masks", str(made / "truth/masks"), "--model", "u2net.onnx"],
            "and nothing else does",
        ),
        (["--masks", "automatic"], "expected a folder of masks, or auto, none, rembg"),
    ):
        assert main(["prepare", photographs, out, *words]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith("error: ")
        assert said in error
        assert not Path(out).exists()


def test_contact_sheet(tmp_path: Path) -> None:
    image = np.full((100, 200, 3), 200, np.uint8)
    mask = np.zeros((100, 200), dtype=bool)
    mask[30:70, 50:150] = True
    draw_masks(tmp_path / "sheet.jpg", ["a", "b"], [image, image], [mask, mask])
    shown = np.asarray(Image.open(tmp_path / "sheet.jpg")).astype(int)
    assert np.abs(shown[16 + 50, 100] - 200).max() < 12
    assert np.abs(shown[16 + 10, 20] - 50).max() < 12
    assert np.abs(shown[16 + 50, 360 + 100] - 200).max() < 12
