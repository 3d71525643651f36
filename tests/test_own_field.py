"""The example of a voxel field of one's own: it runs, it draws, and its field knows nothing of gridreg."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import imageio.v3 as imageio
import pytest
import torch

import gridreg
from tests.programs import ROOT, module_at

PATH = ROOT / "examples" / "own_field.py"


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    yield module_at(PATH)
    del sys.modules["own_field"]


def test_it_runs_and_draws_truth_bare_and_regularized(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "picture.png"
    monkeypatch.setattr(sys, "argv", ["own_field.py", "--steps", "3", "--out", str(out)])
    example.main()
    picture = imageio.imread(out)
    assert picture.shape == (2 * 4 * example.SIZE, 3 * 4 * example.SIZE, 3)
    assert picture.std() > 5
    printed = capsys.readouterr().out
    assert "FourierLowPass" in printed
    assert printed.count(" dB on ") == 2


def test_its_field_has_never_heard_of_gridreg(example: ModuleType) -> None:
    code = inspect.getsource(example.VoxelField).split('"""')
    assert not any("gridreg" in part for part in code[2:])
    assert len(inspect.getsource(example.regularizers).splitlines()) <= 11


def test_the_truth_is_exact(example: ModuleType) -> None:
    origins, directions = example.rays(0.0, 0.0)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(()))
    assert torch.allclose(origins.norm(dim=-1), torch.tensor(3.0))
    colour = example.truth(origins, directions).view(example.SIZE, example.SIZE, 3)
    assert (colour[0, 0] == 1).all()
    middle = colour[example.SIZE // 2, example.SIZE // 2]
    assert middle[0] > middle[1:].max()  # the red ball


def test_training_lowers_the_loss_and_leaves_the_field_bare(example: ModuleType) -> None:
    field = example.train(example.regularizers(), steps=12, seed=0)
    assert type(field) is example.VoxelField
    origins, directions = example.rays(0.0, 20.0)
    with torch.no_grad():
        colour, samples = example.render(field, origins, directions)
        fresh, _ = example.render(example.VoxelField(), origins, directions)
    assert isinstance(samples, gridreg.RaySamples)
    target = example.truth(origins, directions)
    assert (colour - target).square().mean() < (fresh - target).square().mean()
