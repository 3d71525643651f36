"""Scenes and runs as notebooks and terminals show them, and curves in TensorBoard."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.training import Execution, RunConfig, TrainSettings, execute, load_run
from gridreg.training.tensorboard import TensorBoard

TINY = TrainSettings(
    steps=6, rays=64, voxels_start=12**3, voxels_end=12**3, resample_at=(), occupancy_at=(), shrink_at=(),
    filter_rays_at=(), occupancy_resolution=16,
)  # fmt: skip
CONFIG = RunConfig(train=TINY, composition=[{"name": "FrequencyMask", "site": "density", "until": 1.0}])


class Writer:
    """A stand-in for TensorBoard's writer: what was written."""

    opened: ClassVar[list[Writer]] = []

    def __init__(self, folder: str, purge_step: int) -> None:
        self.folder, self.first, self.points, self.closed = folder, purge_step, [], False
        Writer.opened.append(self)

    def add_scalar(self, name: str, value: float, step: int) -> None:
        self.points.append((name, value, step))

    def close(self) -> None:
        self.closed = True


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=32), "builtin8", test=(0, 3))


@pytest.fixture(scope="module")
def run(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Execution:
    return execute(CONFIG, scene, tmp_path_factory.mktemp("out") / "run")[0]


def images_in(text: str) -> int:
    return len(re.findall(r'<img alt="" style="[^"]*" src="data:image/png;base64,iVBOR', text))


def test_a_scene_is_one_line_and_its_views_are_seen(scene: Scene) -> None:
    assert repr(scene.train) == "Views(8 of 32x32)"
    assert repr(scene) == f"Scene({scene.name!r}, builtin8, train=Views(8 of 32x32), test=Views(2 of 32x32))"
    assert images_in(scene._repr_html_()) == 8
    assert len(scene._repr_html_()) < 60_000


def test_a_run_is_one_line_and_its_test_views_are_seen(run: Execution) -> None:
    assert repr(run).startswith("Execution('")
    assert repr(run).endswith("step 6 of 6)")
    assert len(repr(run)) < 300
    text = run._repr_html_()
    assert images_in(text) == 1
    assert "psnr" in text


def test_a_loaded_run_is_one_line_and_shows_its_regularizers(run: Execution) -> None:
    loaded = load_run(run.out)
    assert repr(loaded) == "LoadedRun(run, VMField, step 6 of 6, seed 0)"
    assert "FrequencyMask" in loaded._repr_html_()


def test_names_of_strangers_are_escaped(run: Execution, tmp_path: Path) -> None:
    odd = Execution(run.config, run.scene, tmp_path / "<b>", run.trainer, run.history, {})
    assert "&lt;b&gt;" in odd._repr_html_()
    assert "<b></b>" not in odd._repr_html_()


def test_tensorboard_gets_means_and_masks(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    module: Any = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    losses: list[float] = []
    torch.manual_seed(0)
    board = TensorBoard(every=4)
    execute(
        CONFIG, scene, tmp_path / "run", watch=[board], on_step=lambda report: losses.append(report["loss"])
    )
    (writer,) = Writer.opened
    assert writer.closed
    assert writer.folder == str(tmp_path / "run" / "tensorboard")
    found = {(name, step): value for name, value, step in writer.points}
    assert found["loss", 4] == pytest.approx(sum(losses[:4]) / 4)
    assert found["loss", 6] == pytest.approx(sum(losses[4:]) / 2)
    assert 0 < found["open/FrequencyMask(density)", 4] < found["open/FrequencyMask(density)", 6] <= 1


def test_tensorboard_that_is_missing_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"tensorboard: not installed, expected: pip install 'gridreg\[tensorboard\]'"
    ):
        TensorBoard()
