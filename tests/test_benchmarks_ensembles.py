"""The benchmark of joined seeds: what it stores, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gridreg.errors import InputError
from gridreg.rendering import Camera, Lens
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, execute, load_run
from gridreg.training.loading import ensemble_of
from tests.programs import ROOT, module_at

FIELD = {"density_components": 4, "appearance_components": 4, "decoder": "sh"}
SETTINGS = TrainSettings(
    steps=30,
    rays=128,
    voxels_start=4096,
    resample_at=(),
    occupancy_at=(20,),
    occupancy_every=0,
    occupancy_resolution=24,
    shrink_at=(),
    learning_rate_grid=0.1,
)


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return module_at(ROOT / "benchmarks" / "ensembles.py")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene, and the folder of three seeds as benchmarks/quality.py --keep leaves it."""
    folder = tmp_path_factory.mktemp("kept")
    place = builtin_scene(tmp_path_factory.mktemp("data"), size=32)
    scene = load_scene(place, "builtin8")
    for seed in range(3):
        config = RunConfig(
            scene=str(place),
            protocol="builtin8",
            seed=seed,
            backbone="vm",
            field=FIELD,
            train=SETTINGS,
            composition=[],
        )
        execute(config, scene, folder / f"{place.name}-builtin8-small-seed{seed}")
    return place, folder


def words(kept: tuple[Path, Path], results: Path, *more: str) -> list[str]:
    place, folder = kept
    return [
        *("--data", str(place.parent), "--kept", str(folder), "--scenes", place.name, "--runs", "small"),
        *("--protocol", "builtin8", "--results", str(results), *more),
    ]


def test_two_seeds_then_three(program: ModuleType, kept: tuple[Path, Path], tmp_path: Path) -> None:
    assert program.main(words(kept, tmp_path)) == 0
    name = f"{kept[0].name}-builtin8-small-seeds"
    two, record = map(json.loads, (tmp_path / "ensembles.jsonl").read_text().splitlines())
    assert [two["name"], record["name"]] == [f"{name}0,1", f"{name}0,1,2"]
    alone = [
        json.loads((kept[1] / f"{kept[0].name}-builtin8-small-seed{seed}" / "metrics.json").read_text())
        for seed in range(3)
    ]
    assert [member["seed"] for member in record["members"]] == [0, 1, 2]
    assert [member["mean"] for member in record["members"]] == [one["mean"] for one in alone]
    assert record["seconds"]["train"] == pytest.approx(sum(one["seconds"]["train"] for one in alone))
    assert set(record["images"]) == set(alone[0]["images"])
    assert record["config"]["scene"] == kept[0].name
    # The mean of three fields that agree in part is no worse than the worst of them.
    assert record["mean"]["psnr"] > min(one["mean"]["psnr"] for one in alone)


def test_what_is_stored_is_not_computed_again(
    program: ModuleType, kept: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = tmp_path / "ensembles.jsonl"
    text = json.dumps({"name": f"{kept[0].name}-builtin8-small-seeds0,1"})
    stored.write_text(text)
    assert program.main(words(kept, tmp_path, "--seeds", "0", "1")) == 0
    assert stored.read_text() == text
    assert capsys.readouterr().out == ""


def test_runs_that_are_missing_and_one_seed(
    program: ModuleType, kept: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(
        InputError, match=r"found no finished run, expected what benchmarks/quality\.py --keep leaves"
    ):
        program.main(words(kept, tmp_path, "--seeds", "0", "7"))
    with pytest.raises(InputError, match="--seeds: found 1, expected at least two"):
        program.main(words(kept, tmp_path, "--seeds", "0"))


def test_whether_deviation_tells_where_they_are_wrong(
    program: ModuleType, kept: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(words(kept, tmp_path, "--deviation")) == 0
    (record,) = map(json.loads, (tmp_path / "deviations.jsonl").read_text().splitlines())
    assert record["members"] == 3
    assert len(record["object_pixels"]) == len(record["all_pixels"]) == 25
    assert all(-1 <= value <= 1 for value in [*record["object_pixels"].values(), record["views"]])
    # By hand, for one view: ranks, and their linear correlation.
    joined = ensemble_of(
        [load_run(kept[1] / f"{kept[0].name}-builtin8-small-seed{seed}") for seed in range(3)]
    )
    views = load_scene(kept[0], "builtin8").test
    rendered = joined.render(
        Camera(views.poses[0], Lens.from_tensor(views.intrinsics[0], views.height, views.width)),
        deviation=True,
    )
    error = (rendered.colour - views.composited(joined.background)[0]).square().mean(-1).sqrt()
    ranks = [
        np.unique(x.flatten().numpy(), return_inverse=True, return_counts=True)
        for x in (rendered.deviation, error)
    ]
    means = [(np.cumsum(counts) - (counts - 1) / 2)[inverse] for _, inverse, counts in ranks]
    assert record["all_pixels"][views.names[0]] == pytest.approx(np.corrcoef(*means)[0, 1], abs=1e-6)
    assert "rank correlation of deviation and error" in capsys.readouterr().out
    assert program.main(words(kept, tmp_path, "--deviation")) == 0
    assert capsys.readouterr().out == ""
