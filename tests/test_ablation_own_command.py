"""Runs that a program of the user's does: what it is told, what is read from it, and how it fails."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

import gridreg
from gridreg.ablation import Store
from gridreg.ablation.own_command import words_of
from gridreg.ablation.perform import Scenes, perform
from gridreg.ablation.study import study_from_text
from gridreg.cli import main
from gridreg.errors import ConfigError

PROGRAM = """
import json, pathlib, sys, yaml
label, scene, seed, out, config = sys.argv[1:]
print("training of", label)
composition = yaml.safe_load(open(config))["composition"]
pathlib.Path(out, "metrics.json").write_text(json.dumps({"psnr": 20 + len(composition) + int(seed) / 10, "mine": 0.5}))
"""
STUDY = """
command: {program} '{{label}}' {{scene}} {{seed}} {{out}} {{config}}
compositions:
  - none
  - label: two words
    regularizers:
      - {{name: TotalVariation, site: planes.of.mine, weight: 0.01}}
      - {{name: OcclusionLoss, weight: 0.01, samples: 10}}
seeds: [0, 1]
baseline: none
"""


def study_file(folder: Path, program: str = PROGRAM) -> Path:
    (folder / "program.py").write_text(program)
    path = folder / "study.yaml"
    path.write_text(STUDY.format(program=f"{sys.executable} {folder / 'program.py'}"))
    return path


def test_a_study_of_somebodys_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, table = tmp_path / "store", tmp_path / "table.csv"
    words = ["ablate", str(study_file(tmp_path)), "--out", str(out), "--report", "--export", str(table)]
    assert main(words) == 0, capsys.readouterr().err
    found = {(r.spec.label, r.spec.seed): r for r in Store.open(out).results()}
    assert {key: r.metrics and r.metrics["mean"]["psnr"] for key, r in found.items()} == {
        ("none", 0): 20.0,
        ("none", 1): 20.1,
        ("two words", 0): 22.0,
        ("two words", 1): 22.1,
    }
    result = found["two words", 1]
    assert result.metrics is not None
    assert result.metrics["mean"]["mine"] == 0.5
    assert result.metrics["seconds"]["train"] > 0
    assert (result.folder / "log.txt").read_text() == "training of two words\n"
    config = yaml.safe_load((result.folder / "config.yaml").read_text())
    assert [r.weight for r in gridreg.from_config(config["composition"])] == [0.01, 0.01]  # type: ignore[attr-defined]
    assert config["seed"] == 1
    assert "+2.00" in (out / "report.html").read_text()
    assert "two words" in table.read_text()


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("raise SystemExit(3)", "ended with status 3; see "),
        ("", "no metrics, expected JSON such as"),
        (
            "import sys, pathlib; pathlib.Path(sys.argv[4], 'metrics.json').write_text('[1]')",
            "no metrics, expected",
        ),
        (
            "import sys, pathlib; pathlib.Path(sys.argv[4], 'metrics.json').write_text('{\"ssim\": 1}')",
            "found ssim, expected a number 'psnr' (dB)",
        ),
    ],
)
def test_what_goes_wrong_is_the_reason_of_that_run(tmp_path: Path, program: str, message: str) -> None:
    text = study_file(tmp_path, program).read_text()
    result = perform(study_from_text(text).runs[0], tmp_path / "run", Scenes(tmp_path))
    assert result.metrics is None
    assert message in result.reason


def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    (run,) = study_from_text("command: no-such-program {out}\ncompositions: [none]").runs
    assert perform(run, tmp_path / "run", Scenes(tmp_path)).reason.startswith(
        "command: found 'no-such-program'"
    )


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train {sed}", "command: found {sed}, expected a program and of braces {label}, {scene}"),
        ("''", "cannot start|expected"),
        ("train 'a", "No closing quotation"),
        ("train {", "Single|expected"),
        ("", "found nothing, expected a program"),
    ],
)
def test_a_command_is_read_before_anything_runs(command: str, message: str) -> None:
    if command == "''":
        assert words_of(command) == ("",)
        return
    with pytest.raises(ConfigError, match=message):
        words_of(command)


def test_the_command_tells_runs_apart() -> None:
    text = "compositions: [none]\n"
    hashes = {
        study_from_text(head + text).runs[0].hash for head in ("", "command: a {out}\n", "command: b {out}\n")
    }
    assert len(hashes) == 3


def test_stopping_ends_the_program_and_the_run_waits(tmp_path: Path) -> None:
    note = "pathlib.Path(sys.argv[4], 'pid').write_text(str(os.getpid()))"
    program = f"import os, pathlib, sys, time\n{note}\ntime.sleep(60)"
    run = study_from_text(study_file(tmp_path, program).read_text()).runs[0]
    pid_file = tmp_path / "run" / "pid"

    def stop() -> None:
        while not (pid_file.is_file() and pid_file.read_text()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=stop).start()
    result = perform(run, tmp_path / "run", Scenes(tmp_path))
    assert (result.metrics, result.reason) == (None, "")
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)
    assert json.dumps(run.to_json())
