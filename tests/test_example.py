"""The reference example: short, all of it in one file, and the numbers of ``gridreg train``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import gridreg
from gridreg.cli.train import run
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainOptions, TrainSettings, build_trainer, load_preset, load_run
from gridreg.training.run import regularizers_of
from tests.programs import ROOT, module_at

PATH = ROOT / "examples" / "few_tensorf_blender.py"


@pytest.fixture(scope="module")
def example():
    return module_at(PATH)


def test_it_is_read_on_two_screens():
    text = PATH.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    for piece in ("FrequencyMask(", "OcclusionLoss(", "VMField", "while self.step", "handle.loss("):
        assert piece in text


def test_its_composition_is_that_of_the_default_preset(example):
    assert regularizers_of(load_preset("quick")) == example.FEW_TENSORF
    assert TrainOptions().preset == "quick"


@pytest.mark.parametrize("backbone", ["vm", "cp", "mlp"])
def test_same_numbers_as_the_trainer_of_the_library(example, tmp_path, backbone):
    torch.manual_seed(0)
    scene = load_scene(builtin_scene(tmp_path, size=32), "builtin8")
    settings = TrainSettings(
        steps=12,
        rays=64,
        voxels_start=12**3,
        voxels_end=20**3,
        resample_at=(6,),
        occupancy_at=(4,),
        shrink_at=(4,),
        carve=True,
        occupancy_resolution=24,
        average_from=0.5,
    )
    composition = load_preset("quick").composition
    if backbone == "mlp":
        composition = gridreg.to_config(gridreg.composition("freenerf"))
    config = RunConfig(backbone=backbone, train=settings, composition=composition, seed=3)
    finals = []
    for make in (build_trainer, example.few_tensorf):
        trainer = make(config, scene)
        trainer.train(until=9)
        trainer.train()
        finals.append(dict(trainer.field.named_parameters()))
    ours, theirs = finals
    assert trainer.step == 12
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_it_stops_goes_on_and_records_its_command(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = builtin_scene(tmp_path, size=32)
    small = (
        "train.rays=64",
        "train.voxels_start=1728",
        "train.voxels_end=1728",
        "train.occupancy_resolution=16",
    )
    options = TrainOptions(scene=scene, steps=4, out=tmp_path / "run", mesh=False, video=False, set=small)
    assert run(options, example.few_tensorf, ["few_tensorf_blender.py"]) == 0
    assert load_run(tmp_path / "run").step == 4
    assert '"few_tensorf_blender.py"' in (tmp_path / "run" / "metrics.json").read_text()


def test_its_help_and_options_are_those_of_gridreg_train():
    done = subprocess.run(
        [sys.executable, str(PATH), "--help"], capture_output=True, text=True, timeout=120, check=True
    )
    assert "--preset" in done.stdout
    assert Path(PATH).name in done.stdout


def test_the_score_is_printed_before_mesh_and_video_are_made(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    drawn = []
    monkeypatch.setattr(
        "gridreg.cli.train.draw_run", lambda *_, **__: drawn.append(capsys.readouterr().out) or []
    )
    scene = builtin_scene(tmp_path, size=32)
    small = (
        "train.rays=64",
        "train.voxels_start=1728",
        "train.voxels_end=1728",
        "train.occupancy_resolution=16",
    )
    assert run(TrainOptions(scene=scene, steps=2, out=tmp_path / "run", set=small)) == 0
    (before,) = drawn
    assert "PSNR" in before
    assert "trained in" in before
