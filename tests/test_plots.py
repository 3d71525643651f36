"""Plots of schedules, masks and handles, and the notebook that shows them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import gridreg

NOTEBOOK = Path(__file__).parents[1] / "docs" / "own-loop.ipynb"


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    pyplot = pytest.importorskip("matplotlib.pyplot")
    yield
    pyplot.close("all")


def test_a_schedule() -> None:
    (line,) = gridreg.Linear(1.0, 0.0, until=0.5).plot(100).lines
    x, y = line.get_data()
    np.testing.assert_allclose(y, [max(0.0, 1 - step / 50) for step in x], atol=1e-12)
    assert (x[0], x[-1]) == (0, 100)


@pytest.mark.parametrize("channels", [7, (0, 0, 1, 1, 2, 2)])
def test_a_mask(channels: int | tuple[int, ...]) -> None:
    mask = gridreg.FrequencyMask("anything", until=0.8)
    (mesh,) = mask.plot(channels, 20).collections
    values = np.asarray(mesh.get_array()).reshape(-1, 21)
    if isinstance(channels, int):
        expected = [gridreg.frequency_mask(7, step, 16) for step in range(21)]
    else:
        by_octave = [gridreg.frequency_mask(3, step, 16, block=1) for step in range(21)]
        expected = [octaves.repeat_interleave(2) for octaves in by_octave]
    np.testing.assert_allclose(values, torch.stack(expected, 1).numpy())


def test_a_handle_has_a_panel_for_all_that_follows_the_step() -> None:
    field = nn.Linear(6, 4)
    weight = gridreg.parameters("weight", dim=1)
    penalty = gridreg.L1(weight, weight=gridreg.Linear(1.0, 0.0))
    handle = gridreg.apply(field, gridreg.FrequencyMask(weight), penalty, gridreg.L2(weight), total_steps=10)
    titles = [axes.get_title() for axes in handle.plot().axes if axes.get_title()]
    assert titles == ["FrequencyMask(weight)", "L1(weight): weight"]
    handle.remove()
    handle = gridreg.apply(field, gridreg.L2(weight), total_steps=10)
    with pytest.raises(gridreg.InputError, match="nothing here follows the step"):
        handle.plot()
    handle.remove()


def test_without_matplotlib_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(gridreg.InputError, match="plot: matplotlib is not installed, expected it"):
        gridreg.Linear(0.0, 1.0).plot(10)


@pytest.mark.filterwarnings("ignore")
def test_the_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Commands that ran in this process before chose a backend without windows; a notebook has its own.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    kinds = [kind for output in shown for kind in output.get("data", ())]
    assert kinds.count("image/png") >= 3
    assert any("<table><caption>gridreg on" in o.get("data", {}).get("text/html", "") for o in shown)
    assert "paired" in (tmp_path / "results.html").read_text(encoding="utf-8").lower()
