"""What goes wrong for newcomers, on the real command line: one line, status 2, and nothing half-written."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.cli import main
from gridreg.scenes import builtin_scene
from gridreg.training import RunConfig, build_trainer, open_scene, save_run
from gridreg.training.checkpoint import FORMAT_VERSION
from tests.tiny_training import NO_EVENTS

Refused = Callable[..., str]
SMALL = ("--steps", "5", "--set", "train.rays=64", "train.voxels_start=1000", "train.voxels_end=1000")

# Without viser, `view` has another complaint: see `test_without_viser`.
VIEW = pytest.param(
    "view",
    marks=pytest.mark.skipif(
        find_spec("viser") is None, reason="viser is not installed: pip install '.[viewer]'"
    ),
)


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a command in an empty folder; give the one line that it ends with."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str, leaves: tuple[str, ...] = ()) -> str:
        before = {path for path in tmp_path.rglob("*") if not path.is_dir()}
        capsys.readouterr()
        assert main(list(words)) == 2
        said = capsys.readouterr()
        errors = [line for line in said.err.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1
        assert said.err.splitlines()[-1] == errors[0]
        assert "Traceback" not in said.err
        new = {path for path in tmp_path.rglob("*") if not path.is_dir()} - before
        assert {path.name for path in new} == set(leaves)
        return errors[0]

    return run


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=24)


@pytest.fixture
def scene(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "scene"))


def picture(path: Path, size: tuple[int, int] = (32, 24), **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, **options)


@pytest.fixture(scope="module")
def empty_run(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a field that holds nothing."""
    config = RunConfig(
        scene=str(source),
        protocol="builtin8",
        field={"density_components": 2, "appearance_components": 2, "density_shift": -40.0, "width": 8},
        train=NO_EVENTS,
    )
    trainer = build_trainer(config, open_scene(config, tmp_path_factory.getbasetemp(), test=()))
    folder = tmp_path_factory.mktemp("empty")
    save_run(folder / "checkpoint", trainer, config, {})
    return folder


# --- pictures


def test_no_folder_and_no_pictures(refused: Refused, tmp_path: Path) -> None:
    assert "nowhere: no such folder of images" in refused("prepare", "nowhere", "out")
    (tmp_path / "pictures").mkdir()
    assert "found nothing, expected images" in refused("prepare", "pictures", "out")
    (tmp_path / "pictures/film.mov").write_text("")
    assert "only .mov files, expected images" in refused("prepare", "pictures", "out")
    for k in range(3):
        picture(tmp_path / f"pictures/{k}.jpg")
    assert "found 3 images, expected at least 4" in refused("prepare", "pictures", "out")


def test_pictures_of_different_sizes_with_one_intrinsics(refused: Refused, tmp_path: Path) -> None:
    posed_pictures(tmp_path / "scene", back=False)
    picture(tmp_path / "scene/images/3.png", (40, 24))
    for words in (["train", "--scene", "scene", "--out", "run", *SMALL], ["prepare", "scene", "out"]):
        line = refused(*words)
        assert "3.png: " in line
        assert "40x24, expected " in line
        assert "32x24" in line


def test_unreadable_exif(refused: Refused, tmp_path: Path) -> None:
    for k in range(5):
        picture(tmp_path / f"pictures/{k}.jpg", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" if k == 2 else b"")
    assert "2.jpg: EXIF" in refused("prepare", "pictures", "out")


def test_pictures_cut_off(refused: Refused, tmp_path: Path) -> None:
    for k in range(5):
        picture(tmp_path / f"pictures/{k}.jpg")
    cut = tmp_path / "pictures/4.jpg"
    cut.write_bytes(cut.read_bytes()[:-200])
    assert "4.jpg: not a whole image" in refused("prepare", "pictures", "out")


def test_pictures_that_cannot_be_registered(refused: Refused, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    for k in range(4):
        path = tmp_path / f"pictures/{k}.png"
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (64, 48), (30 * k, 90, 90)).save(path)
    line = refused("prepare", "pictures", "out")
    assert "only 0 of 4 images could be registered; take more images" in line


def test_without_pycolmap(refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(4):
        picture(tmp_path / f"pictures/{k}.png")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pycolmap is not installed: pip install 'gridreg[colmap]'" in refused("prepare", "pictures", "out")


def test_output_that_exists(refused: Refused, tmp_path: Path) -> None:
    for k in range(4):
        picture(tmp_path / f"pictures/{k}.png")
    (tmp_path / "out").mkdir()
    assert "out: exists already" in refused("prepare", "pictures", "out")


# --- cameras and boxes


def colmap_model(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
    lines = [f"{k + 1} 1 0 0 0 {0.1 * k} 0 3 1 {name}\n\n" for k, name in enumerate(names)]
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


def test_two_colmap_models(refused: Refused, tmp_path: Path) -> None:
    names = [f"{k}.png" for k in range(9)]
    for name in names:
        picture(tmp_path / "scene/images" / name)
    for number in "01":
        colmap_model(tmp_path / "scene/sparse" / number, names)
    for words in (["train", "--scene", "scene", *SMALL], ["prepare", "scene", "out"]):
        line = refused(*words)
        assert "expected one COLMAP model, found sparse/0, sparse/1; leave only the one to use" in line


def posed_pictures(folder: Path, back: bool) -> None:
    frames = []
    for k in range(9):
        picture(folder / f"images/{k}.png")
        angle = 2 * np.pi * k / 9
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        right, up = np.array([-np.sin(angle), np.cos(angle), 0.0]), np.array([0.0, 0.0, 1.0])
        # A camera looks along its -z: outward from the ring, or inward.
        axis = -out if back else out
        pose = np.eye(4)
        pose[:3] = np.stack([-right if back else right, up, axis, 3 * out], axis=1)
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()})
    content = {"fl_x": 40.0, "w": 32, "h": 24, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def test_cameras_that_look_away_from_each_other(refused: Refused, tmp_path: Path) -> None:
    posed_pictures(tmp_path / "scene", back=True)
    for words in (["train", "--scene", "scene", *SMALL], ["prepare", "scene", "out"]):
        assert "look away from the point" in refused(*words)


def test_a_box_that_holds_nothing(refused: Refused, tmp_path: Path) -> None:
    posed_pictures(tmp_path / "scene", back=False)
    content = json.loads((tmp_path / "scene/transforms.json").read_text())
    content["gridreg"] = {"near": 1.0, "far": 5.0, "bounds": [[50, 50, 50], [51, 51, 51]]}
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    assert "no training camera sees the box" in refused("train", "--scene", "scene", *SMALL)
    box = ["--box", "50", "50", "50", "51", "51", "51"]
    assert "no camera sees the box" in refused("prepare", "scene", "out", *box)
    upside_down = ["--box", "1", "1", "1", "-1", "2", "2"]
    assert "lower corner below upper" in refused("prepare", "scene", "out", *upside_down)
    assert "expected 0 <= near < far" in refused("prepare", "scene", "out", "--near", "9", "--far", "3")


def test_silhouettes_that_leave_nothing(refused: Refused, scene: Path) -> None:
    for path in (scene / "train").glob("*.png"):
        Image.new("RGBA", (24, 24), (0, 0, 0, 0)).save(path)
    line = refused("train", "--scene", "scene", "--out", "run", *SMALL)
    assert "silhouettes of the training views leave no cell" in line


# --- what cannot be trained


def test_scenes_that_are_none(refused: Refused, tmp_path: Path, scene: Path) -> None:
    assert "nowhere: no such scene folder" in refused("train", "--scene", "nowhere", *SMALL)
    (tmp_path / "other").mkdir()
    assert "other: not a scene" in refused("train", "--scene", "other", *SMALL)
    line = refused("train", "--scene", "scene", "--protocol", "dietnerf8", *SMALL)
    assert "view 26 is not in" in line


def test_names_and_numbers(refused: Refused, scene: Path) -> None:
    words = ["train", "--scene", "scene"]
    assert "did you mean 'quick'?" in refused(*words, "--preset", "quik")
    assert "expected one of" in refused(*words, "--protocol", "dietnerf")
    assert "expected one of" in refused(*words, "--backbone", "vmx")
    assert "--steps: found 0, expected a number of at least 1" in refused(*words, "--steps", "0")
    assert "train.ray" in refused(*words, "--set", "train.ray=5")
    assert "found 'train.rays', expected KEY=VALUE" in refused(*words, "--set", "train.rays")
    assert "missing.yaml" in refused(*words, "--config", "missing.yaml")
    assert "--resume" in refused(*words, "--resume")


# --- checkpoints


@pytest.mark.parametrize("command", ["eval", "mesh", "render", VIEW])
def test_no_checkpoint(refused: Refused, tmp_path: Path, command: str) -> None:
    more = ["--port", "0"] if command == "view" else []
    assert "nowhere: no checkpoint here" in refused(command, "nowhere", *more)
    (tmp_path / "run").mkdir()
    line = refused(command, "run", *more)
    assert "run: holds no checkpoint, expected the output folder of a run" in line


@pytest.mark.parametrize("command", ["eval", "mesh", "render", VIEW])
def test_a_checkpoint_from_a_newer_version(
    refused: Refused, tmp_path: Path, empty_run: Path, command: str
) -> None:
    shutil.copytree(empty_run, tmp_path / "run")
    state = tmp_path / "run/checkpoint/state.json"
    content = json.loads(state.read_text())
    content["version"] = FORMAT_VERSION + 1
    state.write_text(json.dumps(content))
    line = refused(command, "run", *(["--port", "0"] if command == "view" else []))
    assert "written by a newer gridreg" in line
    assert "upgrade gridreg to read it" in line


def test_a_damaged_checkpoint(refused: Refused, tmp_path: Path, empty_run: Path) -> None:
    shutil.copytree(empty_run, tmp_path / "run")
    tensors = tmp_path / "run/checkpoint/tensors.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-1])
    assert "damaged checkpoint" in refused("eval", "run")


def test_an_empty_field(refused: Refused, tmp_path: Path, empty_run: Path) -> None:
    run = str(empty_run)
    line = refused("mesh", run, "--resolution", "16", "--out", "mesh.ply")
    assert "field: " in line
    assert "opaque, expected 0.5 for a surface" in line
    line = refused("mesh", run, "--resolution", "16", "--threshold", "5", "--out", "mesh.ply")
    assert "threshold=5" in line
    assert "found suffix '.xyz'" in refused("mesh", run, "--out", "mesh.xyz")


def test_another_scene(refused: Refused, tmp_path: Path, empty_run: Path, scene: Path) -> None:
    first = scene / "train/r_0.png"
    Image.new("RGBA", (24, 24), (9, 9, 9, 255)).save(first)
    line = refused("eval", str(empty_run), "--scene", "scene")
    assert "trained on another scene" in line
    assert "expected the same training images" in line


# --- meshes, films, ports


def test_meshes_that_are_none(refused: Refused, tmp_path: Path) -> None:
    assert "mesh.ply: mesh file not found" in refused("compare-mesh", "mesh.ply", "builtin")
    (tmp_path / "mesh.ply").write_text("ply\nnonsense")
    assert "mesh.ply" in refused("compare-mesh", "mesh.ply", "builtin")


def test_films(refused: Refused, empty_run: Path, monkeypatch: pytest.MonkeyPatch, source: Path) -> None:
    words = ["render", str(empty_run), "--frames", "2", "--width", "16"]
    assert "expected .mp4, .gif" in refused(*words, "--out", "film.avi")
    assert "path: found 'loop', expected turntable" in refused(*words, "--path", "loop", "--out", "a.gif")
    assert "frames=0" in refused("render", str(empty_run), "--frames", "0", "--out", "a.gif")
    assert "--width: found 0" in refused("render", str(empty_run), "--width", "0", "--out", "a.gif")
    assert "checkpoints: found none" in refused("render")

    def no_program() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", no_program)
    assert "ffmpeg: found none, expected the program for .mp4" in refused(*words, "--out", "film.mp4")


def test_ffmpeg_missing_is_said_before_training(
    refused: Refused, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_program() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", no_program)
    line = refused("train", "--scene", "scene", "--out", "run", *SMALL)
    assert "ffmpeg" in line
    assert "--no-video" in line


def test_a_taken_port(refused: Refused, empty_run: Path, scene: Path) -> None:
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        line = refused("view", str(empty_run), "--port", port)
        assert f"cannot listen on 127.0.0.1:{port}" in line
        assert "choose another port" in line
        line = refused("train", "--scene", "scene", "--out", "run", "--view", "--port", port, *SMALL)
        assert "choose another port" in line
    assert "expected a number from 0 to 65535" in refused("view", str(empty_run), "--port", "70000")


def test_without_viser(refused: Refused, empty_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gridreg.export.browser.importlib.util.find_spec", lambda name: None)
    assert "pip install 'gridreg[viewer]'" in refused("view", str(empty_run))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_place_that_is_not_writable(refused: Refused, tmp_path: Path, empty_run: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "cannot write here" in refused("mesh", str(empty_run), "--out", "locked/mesh.ply")


def test_a_file_where_the_folder_should_be(refused: Refused, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "run").write_text("")
    assert "run: cannot write here" in refused("train", "--scene", "scene", "--out", "run", *SMALL)
    assert torch.is_grad_enabled()
