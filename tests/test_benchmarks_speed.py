"""Every command of benchmarks/speed.py through its main function, at tiny sizes."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import overhead
from speed import common, main, peer, situations, step, whole_run
from speed.ball import ball_step
from speed.stopwatch import STAGES, Stopwatch, places_of, watched_step

TINY = ["--set", "train.rays=48", "field.density_components=4", "field.appearance_components=6"]
SMALL = ["train.voxels_start=512", "train.voxels_end=1728", "train.occupancy_resolution=12"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=16)


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def run(words: list[str], results: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """Run a command; what it stored and what it printed."""
    before = set(results.glob("*.json"))
    assert main.main([*words, "--threads", "1", "--results", str(results)]) == 0
    (target,) = set(results.glob("*.json")) - before
    record = json.loads(target.read_text())
    assert record["threads"] == record["versions"]["threads"] == 1
    assert target.name.startswith(words[0])
    assert str(results) not in target.read_text()
    return record, capsys.readouterr().out


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
    assert {"backward/density", "march", "colour/network"} <= set(late["watched"]["compiled"]["parts"])
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
    monkeypatch.setattr("speed.stopwatch.time.perf_counter", lambda: next(clock))
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
    from speed.stopwatch import Place

    return Place(owner, "call", "rays")


def test_frame(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "frame",
        "--scene",
        str(scene),
        "--steps",
        "6",
        "--sizes",
        "20",
        "10",
        "--views",
        "3",
        *TINY,
        *SMALL,
    ]
    record, printed = run(words, tmp_path / "r", capsys)
    assert record["views"] == 3
    assert record["sizes"]["20"]["height"] == 20
    assert all(size["seconds"]["median"] > 0 for size in record["sizes"].values())
    assert "| 10x10 |" in printed


def test_scaling(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["scaling", "--repeats", "2", "--rays", "32", "--edge", "10", "--rays-list", "16", "32"]
    words += ["--edge-list", "8", "10", "--channels-list", "4x6", "8x12", "--threads-list", "1", "2"]
    record, printed = run([*words, "--early-edge", "8", "--channels", "4x6"], tmp_path / "r", capsys)
    assert {name: list(rows) for name, rows in record["tables"].items()} == {
        "rays": ["16", "32"],
        "edge": ["8", "10"],
        "channels": ["4x6", "8x12"],
    }
    assert list(record["threads_tables"]) == list(record["speedup"])
    for rows in record["threads_tables"].values():
        assert list(rows) == ["1", "2"]
    assert printed.count("Two threads against one") == 2
    assert torch.get_num_threads() == 1


def test_threads_to_try() -> None:
    from speed.scaling import powers_up_to

    assert [powers_up_to(n) for n in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]


@pytest.mark.parametrize("backbone", ["vm", "cp"])
def test_masks_do_not_change_the_samples(
    backbone: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["masks", "--backbone", backbone, "--rays", "32", "--edge", "10", "--repeats", "2"]
    record, printed = run([*words, "--shares", "0.25", "1"], tmp_path / "r", capsys)
    rows = record["rows"]
    assert list(rows) == ["no masks", "no masks again", "0.25", "1"]
    assert rows["0.25"]["colour_samples_per_ray"] == pytest.approx(
        rows["no masks"]["colour_samples_per_ray"], rel=0.05
    )
    assert rows["no masks"]["ratio"]["median"] == 1
    assert "encoding.position" in printed


def test_masks_that_close_everything_are_refused() -> None:
    with pytest.raises(InputError, match="opens none of 16 channels"):
        main.main(["masks", "--rays", "8", "--edge", "6", "--shares", "0.01"])


def whole(scene: Path, steps: int) -> list[str]:
    schedule = [
        "train.occupancy_at=[2]",
        "train.shrink_at=[2]",
        "train.resample_at=[3]",
        "train.filter_rays_at=[]",
    ]
    own = ["field.density_shift=-4.0", "train.weight_bound=0.001"]
    return ["--scene", str(scene), "--steps", str(steps), *TINY, *SMALL, *schedule, *own, "train.steps=6"]


def test_schedule_in_a_process_of_its_own(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, printed = run(["schedule", *whole(scene, 6)], tmp_path / "r", capsys)
    assert [(span["from"], span["to"]) for span in record["spans"]] == [(0, 2), (2, 3), (3, 6)]
    first, _, last = record["spans"]
    assert first["resolution"] == [8, 8, 8]
    assert last["resolution"] != first["resolution"]
    assert sum(span["seconds"] for span in record["spans"]) > 0
    assert record["mean"]["psnr"] > 3
    peaks = record["peak_bytes"]
    assert 50e6 < peaks["imports"] <= peaks["scene"] <= peaks["training"] <= peaks["scoring"] < 4e9
    assert "PSNR" in printed


def test_memory(
    scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(whole_run, "run_apart", whole_run.run_here)
    record, printed = run(["memory", *whole(scene, 3)], tmp_path / "r", capsys)
    assert record["steps"] == 3
    assert "| all modules imported |" in printed


def test_a_run_that_fails_says_why(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no_such_preset"):
        main.main(["schedule", "--scene", str(scene), "--preset", "no_such_preset"])
    program = tmp_path / "program.py"
    program.write_text("import sys\nsys.exit('a warning\\nerror: the disk is full')")
    monkeypatch.setattr(whole_run, "PROGRAM", program)
    with pytest.raises(InputError, match=r"failed: the disk is full$"):
        main.main(["schedule", "--scene", str(scene)])
    program.write_text("raise SystemExit(130)")
    with pytest.raises(KeyboardInterrupt):
        main.main(["memory", "--scene", str(scene)])


def test_names_of_files_stay_short() -> None:
    arguments = Namespace(scene=None, preset="quick", set=["train.rays=2"])
    assert common.setting(arguments) == "builtin-quick-train.rays=2"
    arguments.set = [f"train.option{k}=value" for k in range(30)]
    assert len(common.setting(arguments)) < 60
    other = Namespace(scene=None, preset="quick", set=[*arguments.set[:-1], "train.other=1"])
    assert common.setting(other) != common.setting(arguments)


def test_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["table", "--results", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "Nothing is stored yet.\n"
    words = ["masks", "--rays", "8", "--edge", "6", "--repeats", "1", "--shares", "1"]
    _, printed = run(words, tmp_path, capsys)
    assert main.main(["table", "--results", str(tmp_path)]) == 0
    table = capsys.readouterr().out
    assert table.startswith("## masks-vm-1threads\n")
    assert printed in table


@pytest.mark.parametrize(
    "words",
    [["fly"], [], ["step", "--repeats", "0"], ["scaling", "--channels", "16"], ["masks", "--shares", "2"]],
)
def test_bad_arguments_end_with_status_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(words)
    assert ended.value.code == 2
    assert "error" in capsys.readouterr().err


def test_peak_memory_without_proc(tmp_path: Path) -> None:
    table = tmp_path / "status"
    table.write_text("Name:\tpython\nVmHWM:\t    1234 kB\n")
    assert whole_run.peak_bytes(table) == 1234 * 1024
    assert whole_run.peak_bytes(tmp_path / "missing") > 50e6


def test_turns() -> None:
    order: list[tuple[str, int]] = []

    def contestant(name: str) -> Callable[[int], object]:
        return lambda turn: order.append((name, turn))

    times = common.in_turns({"a": contestant("a"), "b": contestant("b")}, 2, warm_up=1)
    assert order == [("a", 0), ("b", 0), ("a", 0), ("b", 0), ("b", 1), ("a", 1)]
    assert {name: len(values) for name, values in times.items()} == {"a": 2, "b": 2}
    figures = common.ratios({"a": [1.0, 2.0, 4.0], "b": [2.0, 4.0, 4.0]}, "a")["b"]
    assert figures == {"median": 2.0, "quarter": 1.5, "three_quarters": 2.0}


def test_arguments_are_stored_without_places() -> None:
    arguments = Namespace(command="step", scene=Path("somewhere/else/lego"), results=Path("x"), rays=3)
    assert common.plain_arguments(arguments) == {"scene": "lego", "rays": 3}


def test_the_ball_is_opaque_and_not_fog() -> None:
    found = ball_step("vm", 32, 64, (4, 4)).samples_per_ray()
    assert 3 < found["colour_samples_per_ray"] < found["density_samples_per_ray"] < 60
    opacity = ball_step("vm", 32, 64, (4, 4)).render().opacity.detach()
    assert float(opacity.median()) > 0.99


def test_overhead_of_an_open_composition(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--rays", "32", "--edge", "10", "--repeats", "2", "--threads", "1"]
    assert overhead.main([*words, "--results", str(tmp_path)]) == 0
    stored = json.loads((tmp_path / "vm-10-1threads.json").read_text())
    assert set(stored["ratios"]) == {"bare again", "masks open", "masks half-way"}
    assert stored["colour_samples_per_ray"] > 1
    assert "masks open / bare" in capsys.readouterr().out


def test_fully_open_masks_leave_the_step_as_it_is() -> None:
    bare, opened = (overhead.make_step("vm", 10, 32, at) for at in (None, 1.0))
    opened.handle.step(opened.at)
    assert torch.equal(bare.render().colour, opened.render().colour)


def test_watched_figures_leave_the_first_turns_out(trainer: Any) -> None:
    watched = step.Watched(trainer, "auto")
    for turn in range(3):
        watched(turn)
    watched.stages["rays"][0] = 1e9
    assert watched.figures(skip=1)["stages"]["rays"] < 1
