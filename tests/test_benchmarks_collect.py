"""Runs of a study, copied out of its store for the page of results."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gridreg.ablation import Store
from gridreg.errors import InputError
from tests import ablation_results
from tests.programs import ROOT, module_at


@pytest.fixture
def collect() -> ModuleType:
    return module_at(ROOT / "benchmarks" / "collect.py")


class _Store:
    def __init__(self, runs: list[Any]) -> None:
        self.runs = runs

    def study(self, name: str) -> Any:
        return ablation_results.study_of([run.spec for run in self.runs], baseline="tensorf")

    def results(self, study: Any) -> list[Any]:
        return self.runs


def test_finished_runs_become_records(
    collect: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [
        ablation_results.done(ablation_results.spec("grid to 200^3"), psnr=25.0),
        ablation_results.done(ablation_results.spec("tensorf", seed=2), psnr=24.0),
        ablation_results.failed(ablation_results.spec("none"), "died"),
    ]
    monkeypatch.setattr(collect.Store, "open", lambda folder, create: _Store(runs))
    names = collect.collect(tmp_path, "example", tmp_path / "results")
    assert names == ["lego-grid_to_200_3-seed0", "lego-tensorf-seed2"]
    text = (tmp_path / "results" / "example.jsonl").read_text()
    record, other = map(json.loads, text.splitlines())
    assert [record["name"], other["name"]] == names
    assert (record["label"], record["baseline"], record["mean"]["psnr"]) == ("grid to 200^3", "tensorf", 25.0)
    assert record["config"]["scene"] == "lego"
    assert str(tmp_path) not in text


def test_a_store_that_is_not_there(
    collect: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError):
        collect.collect(tmp_path / "nothing", "example", tmp_path / "results")
    Store.open(tmp_path / "empty")
    monkeypatch.setattr(sys, "argv", ["collect.py", str(tmp_path / "empty"), "example"])
    with pytest.raises(InputError, match="example"):
        collect.main()
