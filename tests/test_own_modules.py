"""A field of one's own, named in ``modules:``: trained by the installed command, then read again by the others."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from gridreg.errors import ConfigError
from gridreg.fields import field_names, import_modules
from gridreg.scenes import builtin_scene
from gridreg.training import TrainOptions, configure

FIELD = """
from backbones.vm import VMField
from gridreg.fields import register_field

register_field("mine", VMField)
"""
CONFIG = """
modules: [field_of_mine]
backbone: mine
field: {density_components: 4, appearance_components: 4}
train: {steps: 20, rays: 128, voxels_start: 4096, voxels_end: 8000, resample_at: [10], occupancy_at: [10],
        learning_rate_grid: 0.1, occupancy_resolution: 24}
"""


def gridreg(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The command as installed: the current folder is not where Python looks."""
    code = "import sys; from gridreg.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-P" if sys.version_info >= (3, 11) else "-s", "-c", code, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    (folder / "field_of_mine.py").write_text(FIELD)
    (folder / "mine.yaml").write_text(CONFIG)
    builtin_scene(folder / "outputs", size=32)
    done = gridreg(folder, *TRAIN, "--scene", str(scene_in(folder)), "--out", "run")
    assert done.returncode == 0, done.stderr
    return folder


TRAIN = ("train", "--config", "mine.yaml", "--no-mesh", "--no-video")


def scene_in(folder: Path) -> Path:
    return next((folder / "outputs").glob("lighthouse*"))


def test_the_run_remembers_its_modules(desk: Path) -> None:
    state = json.loads((desk / "run" / "checkpoint" / "state.json").read_text())
    assert state["config"]["modules"] == ["field_of_mine"]
    assert "modules: [field_of_mine]" in (desk / "run" / "config.yaml").read_text()


@pytest.mark.parametrize(
    "words",
    [
        ("eval", "run"),
        ("mesh", "run", "--resolution", "24", "--threshold", "1e-4", "--out", "run.ply"),
        ("render", "run", "--frames", "2", "--width", "16", "--out", "run.gif"),
    ],
    ids=lambda words: words[0],
)
def test_other_commands_read_it(desk: Path, words: Sequence[str]) -> None:
    done = gridreg(desk, *words)
    assert done.returncode == 0, done.stderr


def test_elsewhere_the_error_names_the_module(desk: Path, tmp_path: Path) -> None:
    done = gridreg(tmp_path, "eval", str(desk / "run"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "modules: cannot import 'field_of_mine'" in done.stderr


def test_code_in_the_folder_of_a_run_is_not_run(desk: Path, tmp_path: Path) -> None:
    """A run of somebody else's may hold any file, and its checkpoint any name."""
    shutil.copytree(desk / "run", tmp_path / "run")
    (tmp_path / "run" / "field_of_mine.py").write_text("print('code of a stranger')\n" + FIELD)
    done = gridreg(tmp_path / "run", "eval", ".")
    assert done.returncode == 2
    assert "code of a stranger" not in done.stdout + done.stderr
    assert "whose code is not run" in done.stderr


def test_modules_beside_the_file_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", sys.path[:])
    (tmp_path / "field_beside_the_file.py").write_text(FIELD.replace("mine", "beside"))
    (tmp_path / "mine.yaml").write_text("modules: [field_beside_the_file]\nbackbone: beside\n")
    assert configure(TrainOptions(config=tmp_path / "mine.yaml")).modules == ("field_beside_the_file",)
    assert "beside" in field_names()


def test_studies_too_and_their_runs_remember(desk: Path) -> None:
    (desk / "study.yaml").write_text(
        "modules: [field_of_mine]\ncompositions: [none]\nbackbones: [mine]\nsteps: 5\nsize: 32\n"
        "set: {train.rays: 64, train.voxels_start: 4096, train.voxels_end: 4096, train.occupancy_resolution: 16}\n"
    )
    done = gridreg(desk, "ablate", "study.yaml")
    assert done.returncode == 0, done.stderr
    (run,) = (desk / "outputs" / "study" / "runs").iterdir()
    assert "modules" in json.loads((run / "checkpoint" / "state.json").read_text())["config"]


def test_a_module_that_fails_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", sys.path[:])
    (tmp_path / "broken_module_of_mine.py").write_text("1 / 0")
    with pytest.raises(
        ConfigError, match=r"mine.yaml: modules: cannot import 'broken_module_of_mine': division"
    ):
        import_modules(["broken_module_of_mine"], "mine.yaml", beside=tmp_path)
