"""A training step by stage, its situations, its stopwatch and its peers."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene
from gridreg.training import build_trainer, save_run

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from timing import common, main, peer, situations, step
from timing.stopwatch import STAGES, Stopwatch, places_of, watched_step

from tests.speed_runs import SMALL, TINY, one_thread, run


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=16)


@pytest.fixture(autouse=True, scope="module")
def single() -> Iterator[None]:
    with one_thread():
        yield


FAKE = """
import torch


class AlphaGridMask:
    def __init__(self, device, aabb, volume):
        self.volume = volume


class TensorVMSplit(torch.nn.Module):
    def __init__(self, aabb, gridSize, device, density_n_comp, appearance_n_comp, step_ratio, **options):
        super().__init__()
        self.alphaMask, self.called = None, []
        sizes = [(gridSize[0], gridSize[1]), (gridSize[0], gridSize[2]), (gridSize[1], gridSize[2])]
        for name, channels in (("density", density_n_comp), ("app", appearance_n_comp)):
            planes = [torch.nn.Parameter(torch.zeros(1, c, b, a)) for c, (a, b) in zip(channels, sizes)]
            lines = [torch.nn.Parameter(torch.zeros(1, c, gridSize[v], 1)) for c, v in zip(channels, (2, 1, 0))]
            setattr(self, f"{name}_plane", torch.nn.ParameterList(planes))
            setattr(self, f"{name}_line", torch.nn.ParameterList(lines))

    def density_L1(self):
        return sum(p.abs().mean() for p in self.density_plane)

    def forward(self, rays, white_bg=True, is_train=False, N_samples=-1):
        assert rays.shape[1] == 6 and is_train and white_bg and N_samples == -1
        self.called.append(rays)
        colour = sum(p.mean() for p in self.app_plane).expand(len(rays), 3)
        return colour, colour[:, 0]
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "peer" / "models").mkdir(parents=True)
    (tmp_path / "peer" / "models" / "tensoRF.py").write_text(FAKE)
    return tmp_path / "peer"


def tiny_step(scene: Path) -> list[str]:
    edges = ["--early-edge", "8", "--late-edge", "12", "--learn", "12", "--begin", "2", "--warm-up", "2"]
    return ["--scene", str(scene), *edges, "--repeats", "2", *TINY]


def test_step_beside_a_peer(
    scene: Path, checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, printed = run(["step", *tiny_step(scene), "--peer", str(checkout)], tmp_path / "r", capsys)
    early, late = record["situations"]
    assert early["occupied_cells"] == 1
    assert late["occupied_cells"] < 1
    for one in (early, late):
        assert set(one["seconds"]) == {"compiled", "compiled, watched", "plain, watched", "peer"}
        assert one["density_samples_per_ray"] > 0
        for watched in one["watched"].values():
            assert set(watched["stages"]) == set(STAGES)
            assert min(watched["stages"].values()) > 0
            assert 0.9 < watched["sum_of_stages"] <= 1
        assert one["ratios"]["peer"]["quarter"] <= one["ratios"]["peer"]["median"]
        assert one["peer"]["same_grids"]
        assert one["peer"]["l1"]
    assert [one["peer"]["occupancy"] for one in (early, late)] == [False, True]
    # A compiled backward pass is told apart by what it is for.
    assert {"backward/density", "march", "colour/network"} <= set(late["parts"])
    assert "8³ without occupancy" in printed
    assert "peer peer" in printed
    assert not list(checkout.rglob("*.pyc"))
    assert "models" not in sys.modules


def test_step_without_occupancy_mask_of_the_peer(
    scene: Path, checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = FAKE.replace("class AlphaGridMask", "class Other").replace("density_L1", "other")
    (checkout / "models" / "tensoRF.py").write_text(other.replace("b, a))", "a, b + 1))"))
    words = ["step", *tiny_step(scene), "--peer", str(checkout), "--no-plain", "--only", "late"]
    record, printed = run(words, tmp_path / "r", capsys)
    (late,) = record["situations"]
    assert late["peer"] == {"name": "peer", "same_grids": False, "occupancy": False, "l1": False}
    assert set(late["seconds"]) == {"compiled", "compiled, watched", "peer"}
    assert "its own initial values, no occupancy and no penalty" in printed


def _break(folder: Path, how: str) -> None:
    file = folder / "models" / "tensoRF.py"
    match how:
        case "empty":
            file.unlink()
        case "import":
            file.write_text("import a_module_that_is_not_there")
        case "class":
            file.write_text("class Other: ...")


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("missing", "no such folder"),
        ("empty", "found no models/tensoRF.py"),
        ("import", "cannot be imported: ModuleNotFoundError"),
        ("class", "has no class TensorVMSplit"),
    ],
)
def test_bad_peers(checkout: Path, scene: Path, how: str, said: str) -> None:
    _break(checkout, how)
    folder = checkout / "other" if how == "missing" else checkout
    with pytest.raises(InputError, match=said) as caught:
        main.main(["step", *tiny_step(scene), "--peer", str(folder)])
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def trainer(scene: Path) -> Any:
    arguments = Namespace(scene=scene, protocol=None, preset="tensorf", seed=0, set=TINY[1:])
    config = common.configuration(arguments)
    return situations.early(config, common.scene_of(config, test=()), edge=8, learning=1)


def test_a_peer_that_fails_says_so_in_one_line(checkout: Path, trainer: Any) -> None:
    file = checkout / "models" / "tensoRF.py"
    file.write_text(FAKE.replace("        self.called.append(rays)", "        raise KeyError('x')"))
    own = peer.Peer(checkout, trainer.trainer, occupancy=False)
    with pytest.raises(InputError, match="TensorVMSplit cannot do a step: KeyError: 'x'"):
        own.step(*trainer.batch(0))
    file.write_text(FAKE.replace("def __init__(self, aabb, gridSize", "def __init__(self, aabb"))
    with pytest.raises(InputError, match="TensorVMSplit cannot be built: "):
        peer.Peer(checkout, trainer.trainer, occupancy=False)


def test_a_peer_gets_our_values(checkout: Path, trainer: Any) -> None:
    own = peer.Peer(checkout, trainer.trainer, occupancy=True)
    field = trainer.trainer.field
    for k, (plane, line) in enumerate(zip(field.density_planes, field.density_lines, strict=True)):
        assert own.model.density_plane[k][0, 2, 5, 3] == plane[3, 5, 2]
        assert own.model.density_line[k][0, 1, 4, 0] == line[4, 1]
    assert own.model.alphaMask.volume.shape == trainer.trainer.occupancy.cells.shape[::-1]
    rays, target = trainer.batch(3)
    own.step(rays, target)
    assert torch.equal(own.model.called[0], torch.cat([rays.origins, rays.directions], dim=1))


def test_a_situation_is_held_still(trainer: Any) -> None:
    before = [p.clone() for p in trainer.trainer.field.parameters()]
    trainer.run(1)
    first = trainer.trainer.train_step
    trainer.rewind(1)
    one = first()["mse"]
    trainer.rewind(1)
    assert first()["mse"] == one
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.trainer.field.parameters(), strict=True))


def test_stages_add_up_and_leave_no_trace(trainer: Any) -> None:
    places = places_of(trainer.trainer)
    before = [vars(owner).get(name) for owner, name, _ in places]
    trainer.rewind(0)
    whole, watch = watched_step(trainer.trainer)
    total = sum(watch.by_stage().values())
    assert 0.9 * whole < total <= whole
    # An iteration is mostly stages, little is between them.
    assert watch.by_stage()["rest"] < 0.5 * whole
    assert [vars(owner).get(name) for owner, name, _ in places] == before


def test_a_stage_within_another_stops_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 4.0, 10.0])
    monkeypatch.setattr("timing.stopwatch.time.perf_counter", lambda: next(clock))
    watch = Stopwatch()
    inner = watch.timed(lambda: None, "march")
    watch.timed(inner, "density/part")()
    assert watch.seconds == {"march": 3.0, "density/part": 7.0}
    assert watch.by_stage()["density"] == 7.0


def test_a_stage_that_fails_is_still_left() -> None:
    watch = Stopwatch()
    owner = Namespace(call=lambda: 1 / 0)
    original = owner.call
    with pytest.raises(ZeroDivisionError), watch.watching([common_place(owner)]):
        owner.call()
    assert owner.call is original
    assert watch.seconds["rays"] > 0


def common_place(owner: Any) -> Any:
    from timing.stopwatch import Place

    return Place(owner, "call", "rays")


def test_watched_figures_leave_the_first_turns_out(trainer: Any) -> None:
    watched = step.Watched(trainer, "auto")
    for turn in range(4):
        watched(turn)
    watched.turns[0][1].seconds["rays"] = 1e9
    assert watched.figures(skip=1)["stages"]["rays"] < 1
    wholes = sorted(whole for whole, _ in watched.turns[1:])
    whole, parts = watched.typical(skip=1)
    assert whole == wholes[1]
    assert 0.9 * whole < sum(parts.values()) <= whole


def test_a_finished_run_instead_of_a_taught_field(scene: Path, tmp_path: Path) -> None:
    changes = [*TINY[1:], *SMALL, "train.resample_at=[3]", "train.occupancy_at=[]", "train.shrink_at=[]"]
    changes += [
        "train.filter_rays_at=[]",
        "train.steps=5",
        "field.density_shift=-4.0",
        "train.weight_bound=0.001",
    ]
    arguments = Namespace(scene=scene, protocol=None, preset="tensorf", seed=0, set=changes)
    config = common.configuration(arguments)
    views = common.scene_of(config, test=())
    trained = build_trainer(config, views)
    trained.train()
    save_run(tmp_path / "checkpoint", trained, config, {})
    found = situations.late(config, views, edge=99, learning=1, warm_up=1, trained=tmp_path)
    grid = "x".join(map(str, trained.field.resolution))
    assert found.describe()["situation"] == f"{grid} with occupancy"
    assert found.step == 4
    assert torch.equal(found.trainer.occupancy.cells, trained.occupancy.cells)
    other = replace(views, fingerprint="another")
    with pytest.raises(InputError, match="a run on other views"):
        situations.late(config, other, edge=9, learning=1, warm_up=1, trained=tmp_path)
