"""The program: options, what it prints, and how it ends."""

from __future__ import annotations

import io
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import tyro

from gridreg.ablation import command
from gridreg.ablation.command import AblationOptions, make_runner, run
from gridreg.ablation.processes import Processes
from gridreg.ablation.progress import StudyProgress, dry_run_lines, left_in_words, seconds_left
from gridreg.ablation.records import RunResult
from gridreg.ablation.runners import Event, InProcess
from gridreg.ablation.store import Store
from gridreg.ablation.study import study_from_text
from gridreg.errors import InputError
from tests.ablation_runs import metrics, spec, write_study

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "ablations.md"
TITLED = re.compile(r'^```(\w+) title="(\w+)"\n(.*?)^```$', re.S | re.M)


def result(label="a", status="done", seconds=4.0, steps=100, seed=0, **changes):
    config = {"train": {"steps": steps}, "composition": label}
    return RunResult(
        spec(label, seed, config=config, **changes), status, metrics(), "", Path(), seconds, "machine"
    )


def test_the_estimate_likens_runs_to_finished_ones():
    done = [result("a", seconds=4.0), result("b", seconds=6.0), result("c", seconds=60.0, steps=1000)]
    left = [result("d", "waiting", 0.0), result("e", "running", 0.0), result("f", "failed", 0.0)]
    assert left_in_words([*done, *left]) == "2 runs left, about 0:10 (from 3 finished runs)"
    assert seconds_left([*done, *left]) == pytest.approx(5.0 + 5.0)
    # Nothing like it is finished: seconds of a step count.
    other = seconds_left([*done, result("d", "waiting", 0.0, steps=600)])
    assert other == pytest.approx(600 * 70 / 1200)


def test_the_estimate_in_words():
    assert left_in_words([]) == "no run is left"
    one = [result("a", "waiting", 0.0)]
    assert left_in_words(one) == "1 run left; no run is finished yet, so there is no estimate of their time"
    some = [result("a", seconds=60.0), *(result("b", "waiting", 0.0, seed=seed) for seed in range(4))]
    assert left_in_words(some) == "4 runs left, about 4:00 (from 1 finished run)"
    assert left_in_words(some, workers=3) == "4 runs left, about 1:20 with 3 at a time (from 1 finished run)"


def test_a_dry_run_lists_rows_and_counts_runs():
    shared = result("a")
    twin = RunResult(replace(shared.spec, label="twin"), "done", None, "", Path(), 4.0, "")
    lines = dry_run_lines([shared, twin, result("b", "waiting", 0.0)])
    assert len(lines) == 4
    assert lines[0].split() == [shared.spec.hash, "done", *shared.spec.describe().split()]
    assert (
        lines[-1] == "2 runs (1 rows share a run with another); 1 run left, about 0:04 (from 1 finished run)"
    )


def test_progress_tells_rate_and_time_left():
    out, now = io.StringIO(), iter([0.0, 30.0, 60.0, 60.0, 60.0])
    waiting = [result("a", "waiting", 0.0, seed=seed) for seed in range(4)]
    progress = StudyProgress([*waiting, result("b", "failed")], out, clock=lambda: next(now))
    one = waiting[0].spec
    progress(Event("started", one))
    progress(Event("done", one, psnr=21.456, seconds=3.21))
    progress(Event("failed", one, reason="it broke"))
    progress(Event("lost", one))
    progress(Event("interrupted", one))
    assert out.getvalue().splitlines() == [
        f"[2/5, 1 failed, 2.0 runs/min, left 1:30] {one.describe()}: PSNR 21.46 dB in 3.2 s",
        f"[3/5, 2 failed, 2.0 runs/min, left 1:00] {one.describe()}: FAILED: it broke",
        f"[3/5, 2 failed, 2.0 runs/min, left 1:00] {one.describe()}: lost with its worker, waits again",
        f"[3/5, 2 failed, 2.0 runs/min, left 1:00] {one.describe()}: stopped, its checkpoint is kept",
    ]


def options(path, **changes):
    return AblationOptions(study=Path(path), **changes)


def test_runners_by_name():
    assert make_runner(options("s")) == InProcess(None, True)
    assert make_runner(options("s", threads=2, keep_checkpoints=False)) == InProcess(2, False)
    assert make_runner(options("s", runner="processes", workers=3)) == Processes(3, 1, True)
    pytest.importorskip("ray", reason="Ray is not installed (extra: ray)")
    from gridreg.ablation import RayRunner

    runner = make_runner(options("s", runner="ray", address="auto", ship_scenes=True, threads=2))
    assert runner == RayRunner("auto", None, 2, True, True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "--workers: found 0"),
        ({"threads": 0}, "--threads: found 0"),
        ({"workers": 2}, "expected --runner processes"),
        ({"address": "auto"}, "--address: found with --runner local"),
        ({"ship_scenes": True, "runner": "processes"}, "--ship-scenes: found with --runner processes"),
    ],
)
def test_options_that_do_not_fit(changes, message):
    with pytest.raises(InputError, match=message):
        make_runner(options("s", **changes))


@pytest.fixture
def quick_runs(monkeypatch):
    """Runs that cost nothing; the one of seed 1 fails, that of seed 2 is interrupted."""
    seen = []

    class Quick:
        def run(self, store, study, report):
            from gridreg.ablation.workers import Worker

            while (claim := store.claim(Worker.current(), study)) is not None:
                seen.append(claim.spec.seed)
                claim.folder.mkdir(parents=True, exist_ok=True)
                if claim.spec.seed == 2:
                    store.release(claim)
                    raise KeyboardInterrupt
                if claim.spec.seed == 1 and seen.count(1) == 1:
                    store.fail(claim, "it broke")
                else:
                    store.finish(claim, metrics())

    monkeypatch.setattr(command, "make_runner", lambda options: Quick())
    return seen


def test_the_program(tmp_path, quick_runs, capsys):
    path = write_study(tmp_path, rows="[none]", seeds="[0, 1]")
    out = tmp_path / "out"
    assert run(options(path, out=out, export=tmp_path / "table.csv")) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines() == ["tiny: 1 done, 1 failed", f"table: {tmp_path / 'table.csv'}"]
    assert "failed: none | builtin | builtin8 | quick vm | seed 1: it broke" in printed.err
    # What has failed stays so, until somebody asks.
    assert run(options(path, out=out)) == 1
    assert quick_runs == [0, 1]
    assert run(options(path, out=out, retry_failed=True)) == 0
    assert quick_runs == [0, 1, 1]
    assert "failed runs that are tried again: 1" in capsys.readouterr().err


def test_the_program_is_stopped(tmp_path, quick_runs, capsys):
    path = write_study(tmp_path, rows="[none]", seeds="[0, 2]")
    assert run(options(path, out=tmp_path / "out")) == 130
    printed = capsys.readouterr()
    assert printed.out == "tiny: 1 waiting, 1 done\n"
    assert "the same command goes on from here" in printed.err


def test_a_dry_run_writes_nothing(tmp_path, quick_runs, capsys):
    path = write_study(tmp_path, rows="[none]", seeds="[0, 3]")
    out = tmp_path / "out"
    assert run(options(path, out=out, dry_run=True)) == 0
    assert not out.exists()
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "tiny: 1 rows, compared with 'none'"
    assert [line.split()[1] for line in printed[1:3]] == ["waiting", "waiting"]
    assert "no run is finished yet" in printed[-1]
    assert run(options(path, out=out)) == 0
    capsys.readouterr()
    path = write_study(tmp_path, rows="[none]", seeds="[0, 3, 4]")
    assert run(options(path, out=out, dry_run=True)) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "3 runs; 1 run left, about 0:04 (from 2 finished runs)"
    assert quick_runs == [0, 3]


def test_the_table_is_refused_before_hours_of_work(tmp_path, quick_runs):
    path = write_study(tmp_path)
    with pytest.raises(InputError, match=r"--export: found .*table\.xls"):
        run(options(path, out=tmp_path / "out", export=tmp_path / "table.xls"))
    assert quick_runs == []
    assert not (tmp_path / "out").exists()


def test_the_default_folder(tmp_path, quick_runs, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(options(write_study(tmp_path, rows="[none]"))) == 0
    assert (tmp_path / "outputs" / "tiny" / "store.sqlite").is_file()


def test_the_report_is_written_on_request(tmp_path, quick_runs, monkeypatch, capsys):
    written = []

    class Report:
        @staticmethod
        def write_report(store, study, path):
            written.append((store.counts(study)["done"], study.name, path))

    monkeypatch.setitem(sys.modules, "gridreg.ablation.report", Report)
    out = tmp_path / "out"
    assert run(options(write_study(tmp_path, rows="[none]"), out=out, report=True)) == 0
    assert written == [(1, "tiny", out / "report.html")]
    assert f"report: {out / 'report.html'}" in capsys.readouterr().out


def test_bad_input_ends_with_one_line_and_status_2(tmp_path):
    program = [sys.executable, str(ROOT / "examples" / "ablation.py")]
    ended = subprocess.run(
        [*program, str(tmp_path / "none.yaml")], capture_output=True, text=True, timeout=100
    )
    assert ended.returncode == 2
    assert ended.stderr.splitlines() == [f"error: {tmp_path / 'none.yaml'}: study not found"]


def test_studies_that_come_along_are_found_by_name(tmp_path, capsys):
    assert run(AblationOptions(example="smoke", out=tmp_path / "out", dry_run=True)) == 0
    assert "waiting" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    with pytest.raises(
        InputError, match=r"--example: found 'smok', expected one of .*did you mean 'smoke'\?"
    ):
        run(AblationOptions(example="smok"))
    for wrong in (AblationOptions(), AblationOptions(Path("study.yaml"), example="smoke")):
        with pytest.raises(InputError, match="expected a YAML file, or --example NAME"):
            run(wrong)


def titled(language, title):
    return [
        text for lang, name, text in TITLED.findall(PAGE.read_text()) if (lang, name) == (language, title)
    ]


def test_commands_of_the_page_are_accepted():
    (block,) = titled("bash", "run")
    for line in block.strip().splitlines():
        program, example, *words = shlex.split(line)
        assert (program, example) == (".venv/bin/gridreg", "ablate")
        found = tyro.cli(AblationOptions, args=words)
        assert found.study == Path("study.yaml")


def test_studies_of_the_page_are_accepted():
    blocks = titled("yaml", "study")
    assert len(blocks) == 2
    for block in blocks:
        assert len(study_from_text(block).runs) >= 5


def test_the_page_lists_every_key_and_option():
    import dataclasses

    from gridreg.ablation.rows import KEYS
    from gridreg.ablation.study_file import StudyFile

    page = PAGE.read_text()
    for field in dataclasses.fields(StudyFile):
        assert f"`{field.name}`" in page, field.name
    for kind, (_, keys) in KEYS.items():
        assert all(re.search(rf"\b{key}\b", page) for key in (kind, *keys)), kind
    for field in dataclasses.fields(AblationOptions):
        name = field.name.replace("_", "-")
        assert field.name == "study" or f"--{name}`" in page or f"--no-{name}`" in page, name


def test_threads_are_those_of_torch(tmp_path):
    before = torch.get_num_threads()
    try:
        store = Store.open(tmp_path)
        study = study_from_text("compositions: [none]")
        InProcess(threads=1).run(store, replace(study, runs=()), lambda event: None)
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
