"""Every command of benchmarks/speed.py through its main function, at tiny sizes."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from gridreg.errors import InputError
from gridreg.ops.cpu import composite
from gridreg.scenes import builtin_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from timing import common, main, masks, whole_run
from timing.ball import ball_step

from tests.speed_runs import SMALL, TINY, die, one_thread, run


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=16)


@pytest.fixture(autouse=True, scope="module")
def single() -> Iterator[None]:
    with one_thread():
        yield


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
    words += ["--early-edge", "8", "--channels", "4x6", "--beside", "1"]
    record, printed = run(words, tmp_path / "r", capsys)
    assert {name: list(rows) for name, rows in record["tables"].items()} == {
        "rays": ["16", "32"],
        "edge": ["8", "10"],
        "channels": ["4x6", "8x12"],
    }
    assert list(record["threads_tables"]) == list(record["speedup"])
    for rows in record["threads_tables"].values():
        assert list(rows) == ["1", "2"]
    assert printed.count("Two threads against one") == 2
    assert printed.count("to the power") == 3
    assert "busy loops beside: 1." in printed
    assert torch.get_num_threads() == 1


def test_growth_is_a_power() -> None:
    from timing.scaling import exponent

    rows = {f"{size}x9": {"seconds": {"median": 0.1 * size**1.5}} for size in (10, 20, 50)}
    assert exponent(rows) == pytest.approx(1.5)
    assert exponent({"10": rows["10x9"]}) is None


def test_threads_to_try() -> None:
    from timing.scaling import powers_up_to

    assert [powers_up_to(n) for n in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]


@pytest.mark.parametrize("backbone", ["vm", "cp"])
def test_masks_do_not_change_the_samples(
    backbone: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["masks", "--backbone", backbone, "--rays", "32", "--edge", "10", "--repeats", "2"]
    record, printed = run([*words, "--shares", "0.25", "1"], tmp_path / "r", capsys)
    rows = record["rows"]
    assert list(rows) == ["no masks", "no masks again", "opened", "half-way", "0.25", "1"]
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
    assert record["stolen"] is None or 0 <= record["stolen"] <= 1


def test_time_that_the_host_gives_to_others(tmp_path: Path) -> None:
    stat = tmp_path / "stat"
    stat.write_text("cpu  100 0 50 800 10 0 0 40 7 0\ncpu0 1 2 3\n")
    stolen = whole_run.Stolen(stat)
    assert stolen.fraction() is None
    stat.write_text("cpu  160 0 60 810 10 0 0 60 9 0\ncpu0 1 2 3\n")
    assert stolen.fraction() == pytest.approx(0.2)
    for other in ("cpu  1 2 3\n", "intr 1 2 3 4 5 6 7 8\n", "nothing"):
        stat.write_text(other)
        assert stolen.fraction() is None
        assert whole_run.Stolen(stat).fraction() is None
    assert whole_run.Stolen(tmp_path / "missing").fraction() is None


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


def test_compiling_is_counted(
    scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(whole_run, "run_apart", whole_run.run_here)
    # Read from the cache once more.
    monkeypatch.setattr(composite._pixels_forward, "_compiled", None)
    record, printed = run(["compile", *whole(scene, 3)], tmp_path / "r", capsys)
    assert record["first"]["count"] >= 1
    assert record["first"]["seconds"] > 0
    assert record["later"] == {"count": 0, "seconds": 0.0}
    assert "| later | 0 | 0.0 |" in printed


def test_a_run_that_fails_says_why(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no_such_preset"):
        main.main(["schedule", "--scene", str(scene), "--preset", "no_such_preset"])
    # What the process of its own finds arrives as it is.
    with pytest.raises(InputError, match="expected"):
        main.main(["schedule", "--scene", str(tmp_path), "--protocol", "builtin8", "--steps", "3"])


def test_a_run_that_is_killed_says_so(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole_run, "run_here", die)
    with pytest.raises(InputError, match="the run in a process of its own was killed"):
        main.main(["schedule", "--scene", str(scene)])


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


def test_fully_open_masks_leave_the_step_as_it_is() -> None:
    opened = masks.opening_step("vm", 10, 32, masks.COMPONENTS + masks.ENCODINGS, 1.0)
    opened.handle.step(opened.at)
    assert torch.equal(ball_step("vm", 10, 32).render().colour, opened.render().colour)
    half = masks.opening_step("vm", 10, 32, masks.COMPONENTS + masks.ENCODINGS, 0.25)
    half.handle.step(half.at)
    assert not torch.equal(half.render().colour, opened.render().colour)
