"""Runners: real runs, in this process and in others; stopped, killed, and gone on with."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from gridreg.ablation import perform as performing
from gridreg.ablation import runners
from gridreg.ablation import store as store_module
from gridreg.ablation.claims import ClaimLostError
from gridreg.ablation.database import DiskFullError
from gridreg.ablation.perform import LOG_NAME, Scenes, describe_machine, locate_scene, perform
from gridreg.ablation.processes import Processes
from gridreg.ablation.runners import InProcess
from gridreg.ablation.store import Store
from gridreg.ablation.worker import main as worker_main
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.machine import usable_cores
from gridreg.scenes import builtin_scene
from gridreg.training import execute
from gridreg.training.checkpoint import has_checkpoint
from gridreg.training.files import output_errors
from tests.ablation_runs import assert_same_numbers, tiny_study, write_study

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    builtin_scene(folder, size=32)
    return folder


@pytest.fixture
def store(tmp_path, cache):
    """A store that has the built-in scene already."""
    store = Store.open(tmp_path / "store")
    (store.folder / "scenes").symlink_to(cache)
    return store


@pytest.fixture(scope="module")
def expected(tmp_path_factory, cache):
    """Numbers of the tiny study, run by run, without a store."""
    study, folder = tiny_study(seeds="[0, 1]"), tmp_path_factory.mktemp("expected")
    return {
        spec.hash: perform(spec, folder / spec.hash, Scenes(cache)).metrics["images"] for spec in study.runs
    }


def images(store):
    return {r.spec.hash: r.metrics["images"] for r in store.results() if r.metrics}


def kinds(events):
    return [event.kind for event in events]


def test_in_process(store, expected):
    study, events = tiny_study(seeds="[0, 1]"), []
    store.add(study)
    InProcess(threads=1).run(store, study, events.append)
    assert kinds(events) == ["started", "done"] * 4
    assert images(store) == expected
    result = store.results(study)[0]
    assert result.machine == describe_machine()
    assert events[1].psnr == result.metrics["mean"]["psnr"]
    assert events[1].seconds == result.seconds > 0
    assert result.metrics["versions"]["threads"] == 1
    for name in ("config.yaml", "history.jsonl", "metrics.json", "result.json", "test.png"):
        assert (result.folder / name).is_file()
    assert len(list((result.folder / "test").glob("*.png"))) >= 2
    assert has_checkpoint(result.folder / "checkpoint")
    assert result.history()[-1]["step"] == 6
    # Nothing is left to do.
    InProcess().run(store, study, events.append)
    assert len(events) == 8


def test_without_checkpoints(store):
    study = tiny_study(rows="[none]")
    store.add(study)
    InProcess(keep_checkpoints=False).run(store, study, lambda event: None)
    (result,) = store.results(study)
    assert result.status == "done"
    assert not has_checkpoint(result.folder / "checkpoint")


def test_a_run_that_fails_does_not_stop_the_others(store):
    rows = "[{name: none, label: bad, set: {train.learning_rate_grid: 1.0e+30}}, none]"
    study, events = tiny_study(rows=rows), []
    store.add(study)
    InProcess().run(store, study, events.append)
    assert kinds(events) == ["started", "failed", "started", "done"]
    bad, good = store.results(study)
    assert (bad.status, good.status) == ("failed", "done")
    assert "the loss is nan" in bad.reason
    assert "\n" not in bad.reason


def test_an_unforeseen_error_is_kept_with_its_traceback(store, monkeypatch):
    def broken(*arguments, **options):
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setattr(performing, "execute", broken)
    study = tiny_study(rows="[none]")
    store.add(study)
    (claim_folder,) = [store.run_folder(h) for h in {run.hash for run in study.runs}]
    claim_folder.mkdir(parents=True)
    InProcess().run(store, study, lambda event: None)
    (result,) = store.results(study)
    assert (result.status, result.reason) == ("failed", f"ZeroDivisionError: by (see {LOG_NAME})")
    assert "Traceback" in (result.folder / LOG_NAME).read_text()


def test_a_claim_that_is_lost_ends_the_run(store, monkeypatch):
    study, events = tiny_study(rows="[none]"), []
    store.add(study)
    claim = store.claim(Worker.current())
    claim.lost.set()
    with pytest.raises(ClaimLostError):
        perform(claim.spec, claim.folder, Scenes(store.folder / "scenes"), watch=claim.check)
    store.release(claim)
    taken = []

    def given_to_another(spec, folder, scenes, *, watch, log):
        if not taken:
            taken.append(1)
            raise ClaimLostError("x")
        return perform(spec, folder, scenes, watch=watch, log=log)

    monkeypatch.setattr(runners, "perform", given_to_another)
    # The other one gives it back.
    monkeypatch.setattr(runners.time, "sleep", lambda seconds: store.mark_lost(Worker.current(), "x"))
    InProcess().run(store, study, events.append)
    assert kinds(events) == ["started", "lost", "started", "done"]


def test_ctrl_c_saves_and_the_next_go_resumes(store, expected):
    study, events, steps = tiny_study(seeds="[0, 1]"), [], []
    store.add(study)
    claims = []

    def stop_at_step_3(*arguments, **options):
        steps.append(1)
        if len(steps) == 3:
            signal.raise_signal(signal.SIGINT)

    original = runners.perform

    def watched(*arguments, watch, **options):
        claims.append(1)
        return original(*arguments, watch=stop_at_step_3, **options)

    runners.perform = watched
    try:
        with pytest.raises(KeyboardInterrupt):
            InProcess().run(store, study, events.append)
    finally:
        runners.perform = original
    assert kinds(events) == ["started", "interrupted"]
    assert len(steps) == 3
    assert store.counts()["waiting"] == 4
    assert has_checkpoint(store.run_folder(study.runs[0].hash) / "checkpoint")
    InProcess().run(store, study, events.append)
    assert images(store) == expected
    assert [a["outcome"] for a in store.attempts()] == ["interrupted", "done", "done", "done", "done"]


def test_a_damaged_checkpoint_means_starting_over(store, expected, capsys):
    study = tiny_study(rows="[none]")
    (spec,) = study.runs
    folder = store.run_folder(spec.hash)
    scenes = Scenes(store.folder / "scenes")
    perform(spec, folder, scenes)
    (folder / "checkpoint" / "state.json").write_text("{")
    assert perform(spec, folder, scenes).metrics["images"] == expected[spec.hash]
    assert "starting over: " in capsys.readouterr().err


def test_scenes_are_opened_once(cache):
    runs = tiny_study(seeds="[0, 1]").runs
    scenes = Scenes(cache)
    assert scenes.get(runs[0]) is scenes.get(runs[3])
    assert len(scenes.get(runs[0]).test) == 2
    assert scenes.get(runs[0]).train.rgba.shape[1:3] == (32, 32)


def test_scenes_on_other_machines(tmp_path, monkeypatch):
    monkeypatch.delenv("GRIDREG_DATA", raising=False)
    with pytest.raises(InputError, match=r"scene lego: not on .*/nowhere/lego, and GRIDREG_DATA is not set"):
        locate_scene("/nowhere/lego")
    monkeypatch.setenv("GRIDREG_DATA", str(tmp_path))
    with pytest.raises(InputError, match="holds none of this name either"):
        locate_scene("/nowhere/lego")
    for folder in ("synthetic/lego", "chair"):
        (tmp_path / folder).mkdir(parents=True)
    assert locate_scene("/nowhere/synthetic/lego") == tmp_path / "synthetic" / "lego"
    assert locate_scene("/nowhere/chair") == tmp_path / "chair"
    assert locate_scene(str(tmp_path / "chair")) == tmp_path / "chair"


def test_a_full_disk_pauses_the_study(store, monkeypatch, expected):
    """No run has failed: the same command goes on when there is space."""
    study, events = tiny_study(rows="[none, tensorf]"), []
    store.add(study)
    original = performing.execute

    def full(*arguments, **options):
        with output_errors("somewhere"):
            raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(performing, "execute", full)
    with pytest.raises(DiskFullError, match=r"no space left on the disk.*; the study is paused"):
        InProcess().run(store, study, events.append)
    assert store.counts() == {"waiting": 2, "running": 0, "done": 0, "failed": 0}
    monkeypatch.setattr(performing, "execute", original)
    monkeypatch.setattr(store_module, "write_json", full)
    with pytest.raises(DiskFullError):
        InProcess().run(store, study, events.append)
    assert store.counts()["waiting"] == 2
    monkeypatch.undo()
    InProcess().run(store, study, events.append)
    assert images(store) == {h: expected[h] for h in {run.hash for run in study.runs}}


def test_a_full_disk_pauses_processes(store, monkeypatch):
    study = tiny_study(rows="[none]")
    store.add(study)
    script = store.folder / "full.sh"
    script.write_text("#!/bin/sh\nexit 3\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(DiskFullError, match="the study is paused"):
        Processes(workers=1).run(store, study, lambda event: None)
    assert store.counts()["waiting"] == 1


def test_a_worker_by_hand(store, expected, capsys):
    study = tiny_study(seeds="[0, 1]")
    store.add(study)
    arguments = ["--store", str(store.folder), "--study", "tiny", "--no-checkpoints"]
    assert worker_main(arguments) == 0
    assert images(store) == expected
    # What a run prints is in its folder.
    assert "step 6/6" in (store.results()[0].folder / LOG_NAME).read_text()
    assert "step" not in capsys.readouterr().err
    assert worker_main(["--store", str(store.folder), "--study", "other"]) == 2
    assert worker_main(["--store", str(store.folder / "none"), "--study", "tiny"]) == 2
    assert capsys.readouterr().err.count("error: ") == 2


def test_processes_give_the_same_numbers_and_a_killed_one_is_replaced(store, expected):
    study, events = tiny_study(seeds="[0, 1]"), []
    store.add(study)
    killed = []

    def report(event):
        events.append(event)
        if event.kind == "started" and not killed:
            (attempt,) = [a for a in store.attempts() if a["hash"] == event.spec.hash]
            victim = Worker.from_text(attempt["worker"]).process
            killed.append(victim)
            os.kill(victim, signal.SIGKILL)

    Processes(workers=1, threads=1).run(store, study, report)
    assert_same_numbers(images(store), expected)
    outcomes = [a["outcome"] for a in store.attempts()]
    assert outcomes.count("done") == 4
    # The kill may come when the run is finished already.
    assert sorted(set(outcomes) - {"done"}) in ([], ["lost"])
    assert kinds(events).count("done") == 4
    assert usable_cores() >= 1


def test_processes_that_cannot_begin(store, monkeypatch):
    study = tiny_study(rows="[none]")
    store.add(study)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(InputError, match=r"3 processes in a row died.*exit status 1.*workers\.log"):
        Processes(workers=1).run(store, study, lambda event: None)
    assert store.counts()["waiting"] == 1


def test_killed_and_gone_on_with(tmp_path, cache, expected):
    """kill -9 of the whole program in the middle; the same command ends with the same numbers, each run once."""
    path = write_study(tmp_path, seeds="[0, 1]")
    out = tmp_path / "out"
    out.mkdir()
    (out / "scenes").symlink_to(cache)
    command = [
        sys.executable,
        str(ROOT / "examples" / "ablation.py"),
        str(path),
        "--out",
        str(out),
        "--threads",
        "1",
    ]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 60
    try:
        while time.monotonic() < end and not list(out.glob("runs/*/result.json")):
            time.sleep(0.02)
        # The copy comes first, then the row in the database.
        while time.monotonic() < end and not Store.open(out, create=False).counts()["done"]:
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = Store.open(out, create=False).counts()
    assert before["done"] >= 1
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "tiny: 4 done" in done.stdout
    store = Store.open(out, create=False)
    assert_same_numbers(images(store), expected)
    finished = [a["hash"] for a in store.attempts() if a["outcome"] == "done"]
    assert sorted(finished) == sorted(expected)


def test_expected_numbers_are_those_of_training(expected, cache, tmp_path):
    """The room adds nothing to what a run computes."""
    from gridreg.training import RunConfig
    from gridreg.training.typed_data import from_data

    spec = tiny_study(seeds="[0, 1]").runs[3]
    scene = Scenes(cache).get(spec)
    _, metrics = execute(from_data(RunConfig, spec.config), scene, tmp_path / "plain")
    assert metrics["images"] == expected[spec.hash]
    stored = json.loads((tmp_path / "plain" / "metrics.json").read_text())
    assert stored["images"] == expected[spec.hash]
