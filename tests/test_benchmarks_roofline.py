"""Counts of a step, rates of the machine, and what the roofline makes of them."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from timing import common, machine, main, roofline, situations
from timing.work import Work

from tests.speed_runs import COUNTS


def test_touched_nodes_against_sets() -> None:
    resolution = (4, 5, 3)
    generator = torch.Generator().manual_seed(0)
    u = torch.cat([torch.rand(6, 3, generator=generator), torch.tensor([[0.0, 1.0, 1.0], [1.0, 0.0, 0.5]])])
    nodes = set()
    for point in u.tolist():
        below = [min(int(x * (n - 1)), n - 2) for x, n in zip(point, resolution, strict=True)]
        for a, b in ((0, 1), (0, 2), (1, 2)):
            nodes |= {(a, b, below[a] + i, below[b] + j) for i in (0, 1) for j in (0, 1)}
        nodes |= {(axis, below[axis] + i) for axis in range(3) for i in (0, 1)}
    assert roofline.touched_nodes(u, resolution) == len(nodes)
    assert roofline.touched_nodes(u[:0], resolution) == 0


def test_bounds_and_account() -> None:
    rates = machine.Machine(memory=10.0, cache=20.0, float32=4.0, bfloat16=8.0)
    found = roofline.bounds(Work(bytes=50, operations=8, low=8, cached=120), rates)
    assert found == {"memory": 5.0, "arithmetic": 3.0, "roof": 5.0, "cached": 6.0}
    figures = roofline.account(COUNTS, {"optimiser": 500.0, "march": 100.0}, rates, whole=1000.0)
    assert figures["rows"]["optimiser"]["seconds"] == 500.0
    assert figures["share"] == pytest.approx(sum(row["roof"] for row in figures["rows"].values()) / 1000)
    assert sum(figures["above"].values()) == pytest.approx(1000 - figures["roof"])
    assert figures["above"]["between stages"] == 400


def test_rates() -> None:
    found = machine.measure(megabytes=1, size=32)
    assert min(found.memory, found.cache, found.float32, found.bfloat16) > 1e6


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=16)


SET = ["train.rays=32", "field.density_components=4", "field.appearance_components=6"]


def test_counts_of_a_step(scene: Path) -> None:
    changes = [*SET, "field.density_shift=-4.0", "train.weight_bound=0.001"]
    arguments = Namespace(scene=scene, protocol=None, preset="few_tensorf", seed=0, set=changes)
    config = common.configuration(arguments)
    found = situations.early(config, common.scene_of(config, test=()), edge=8, learning=2)
    counts = roofline.counts_of(found)
    assert (counts.rays, counts.cells) == (32, 7**3)
    assert 0 < counts.coloured <= counts.samples <= counts.steps
    # The masks of the preset are at their beginning: a block of three channels is open, and the next begins to open.
    assert (counts.density_channels, counts.appearance_channels) == (4, 6)
    assert counts.density_nodes <= 3 * 64 + 3 * 8
    assert counts.layers == (27 * 5 + 3 * 13 + 3 * 13, 128, 128, 3)
    total = sum(p.numel() for p in found.trainer.field.parameters())
    assert 0 < counts.parameters <= total
    bare = replace(config, field={**config.field, "decoder": "sh"}, composition=[])
    other = situations.early(bare, found.trainer.scene, edge=6, learning=1)
    with pytest.raises(InputError, match="roofline: found a decoder without layers"):
        roofline.counts_of(other)


def test_roofline(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["roofline", "--scene", str(scene), "--early-edge", "8", "--only", "early", "--begin", "2"]
    words += ["--repeats", "2", "--megabytes", "1", "--matrix", "32", "--threads", "1"]
    words += [
        "--results",
        str(tmp_path),
        "--set",
        *SET,
        "field.density_shift=-4.0",
        "train.weight_bound=0.001",
    ]
    assert main.main(words) == 0
    record = json.loads((tmp_path / "speed.jsonl").read_text())
    (one,) = record["situations"]
    assert {"rays", "march", "density", "optimiser"} < one["rows"].keys()
    assert 0 < one["share"] <= one["share_with_caches"]
    assert one["rows"]["backward/lookup"]["seconds"] > 0
    assert 0.8 < one["sum_of_stages"] <= 1
    printed = capsys.readouterr().out
    assert "| colour/network |" in printed
    assert "Gflop/s" in printed


def test_roofline_of_another_backbone_is_refused(scene: Path) -> None:
    words = ["roofline", "--scene", str(scene), "--preset", "cp", "--only", "early", "--early-edge", "6"]
    with pytest.raises(InputError, match="expected VMField"):
        main.main([*words, "--repeats", "1", "--begin", "1", "--megabytes", "1", "--matrix", "8"])
