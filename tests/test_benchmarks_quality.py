"""The benchmark of quality: a run that was stopped goes on, and its record says how it was made."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gridreg.scenes import builtin_scene
from tests.programs import ROOT, module_at

SMALL = (
    "field.density_components=4",
    "field.appearance_components=4",
    "train.voxels_start=4096",
    "train.voxels_end=4096",
    "train.rays=64",
)


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return module_at(ROOT / "benchmarks" / "quality.py")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("data"), size=24)


def run(program: ModuleType, place: Path, keep: Path, results: Path, *more: str) -> list[dict[str, Any]]:
    """Do a short run, and return what is stored then."""
    words = ["--data", str(place.parent), "--scenes", place.name, "--steps", "12", "--protocol", "builtin8"]
    program.main([*words, "--keep", str(keep), "--results", str(results), *more, "--set", *SMALL])
    return [json.loads(line) for line in (results / "quality.jsonl").read_text().splitlines()]


def test_a_stopped_run_goes_on(
    program: ModuleType, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # There is nothing to go on with yet.
    (whole,) = run(program, place, tmp_path / "kept whole", tmp_path / "whole", "--resume")

    each = program.Trained.step

    def interrupted(self: Any, report: Any) -> None:
        each(self, report)
        if self.run.trainer.step == 7:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(program.Trained, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(program, place, tmp_path / "kept", tmp_path / "stopped")
    assert not (tmp_path / "stopped").exists()
    (resumed,) = run(program, place, tmp_path / "kept", tmp_path / "stopped", "--resume")
    assert resumed["images"] == whole["images"]
    assert resumed["command"] == whole["command"]
    assert resumed["spans"][0]["from"] == 7


def test_the_command_says_the_protocol(program: ModuleType, place: Path, tmp_path: Path) -> None:
    (record,) = run(program, place, tmp_path / "kept", tmp_path)
    command = record["command"]
    assert command[command.index("--protocol") + 1] == "builtin8"


def test_resume_needs_a_place(program: ModuleType, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        program.main(["--data", str(place.parent), "--scenes", place.name, "--resume"])
    assert ended.value.code == 2
    assert "--keep" in capsys.readouterr().err


def test_opaque_runs_see_no_alpha_and_are_called_so(program: ModuleType, place: Path, tmp_path: Path) -> None:
    (record,) = run(program, place, tmp_path / "kept", tmp_path / "results", "--opaque")
    assert record["run"] == "quick-opaque"
    assert record["uses_alpha"] is False
    assert "--opaque" in record["command"]
    scene = program.on_paper(program.open_scene(program.configure(program.TrainOptions(scene=place)), place))
    assert bool((scene.train.rgba[..., 3] == 1).all())
    assert scene.train.backdrop is not None
