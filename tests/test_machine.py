"""What the memory cannot hold is refused before it is begun, in one line that says how much it would take."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gridreg import machine
from gridreg.errors import InputError
from gridreg.export import Mesh, camera_path, compare_meshes
from gridreg.export.writers import check_target
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, build_trainer


def test_says_how_much(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 3 * 10**9)
    machine.check_memory(2.9e9, "this")
    with pytest.raises(InputError, match=re.escape("that: needs 3.1 GB of memory, found 3.0 GB")):
        machine.check_memory(3.1e9, "that")
    monkeypatch.setattr(machine, "available_memory", lambda: None)
    machine.check_memory(1e18, "where nobody knows")


def test_the_machine_has_some() -> None:
    left = machine.available_memory()
    assert left is None or 2**20 < left < 2**50


def test_scenes_are_measured_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = builtin_scene(tmp_path, size=16)
    # 33 images of 16x16, seven floats a pixel: more than 200,000 bytes, which a single image does not take.
    monkeypatch.setattr(machine, "available_memory", lambda: 200_000)
    with pytest.raises(InputError, match=r"lighthouse_16: 33 images of 16x16 .*: needs 0\.0 GB"):
        load_scene(folder, "builtin8")
    assert len(load_scene(folder, "builtin8", test=()).train) == 8


@pytest.mark.parametrize("changes", [{"rays": 10**9}, {"voxels_start": 10**9}, {"voxels_end": 10**9}])
def test_grids_and_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]) -> None:
    scene = load_scene(builtin_scene(tmp_path, size=16), "builtin8", test=())
    monkeypatch.setattr(machine, "available_memory", lambda: 5 * 10**8)
    config = RunConfig(train=TrainSettings(**changes))
    with pytest.raises(InputError, match=r"train\..*: needs .* GB of memory"):
        build_trainer(config, scene)


def test_videos_and_samples(tmp_path: Path) -> None:
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    with pytest.raises(InputError, match="frames=10000000000: needs 10000"):
        camera_path("turntable", box, frames=10**10)
    corner = Mesh(np.eye(3), np.array([[0, 1, 2]]), None)
    with pytest.raises(InputError, match="samples=1000000000000: needs"):
        compare_meshes(corner, corner, samples=10**12)
    with pytest.raises(InputError, match=r"fps=1e-09: expected frames per second .* from 0\.002 to 1000"):
        check_target(tmp_path / "a.gif", 1e-9)
