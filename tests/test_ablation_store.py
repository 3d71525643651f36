"""The store: one worker a run, results that stay, and several writers at once."""

from __future__ import annotations

import csv
import json
import sqlite3
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from gridreg.ablation.claims import LEASE_SECONDS, Claim, ClaimLostError, heartbeat
from gridreg.ablation.database import APPLICATION_ID, SCHEMA_VERSION, DiskFullError
from gridreg.ablation.store import MOST_LOSSES, Store
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from tests.ablation_runs import metrics, spec, study_of

HERE = Worker.current()
DEAD = replace(HERE, process=2**22 + 1, started="1")
ELSEWHERE = replace(HERE, machine="another machine", place="another boot")


@pytest.fixture
def store(tmp_path):
    return Store.open(tmp_path / "store")


def claimed(store, worker=HERE, study=None):
    claim = store.claim(worker, study)
    assert claim is not None
    return claim


def finish(store, claim, psnr=20.0, **options):
    claim.folder.mkdir(parents=True, exist_ok=True)
    store.finish(claim, metrics(psnr), **options)


def age(store, seconds):
    """Let the heartbeats of all runs be older."""
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute("UPDATE runs SET heartbeat=heartbeat-?", (seconds,))
    connection.close()


def test_a_study_waits(store):
    study = study_of(spec("a"), spec("b"))
    assert store.add(study) == 2
    assert store.add(study) == 0
    assert store.studies() == [study]
    assert store.study("study") == study
    assert store.counts() == {"waiting": 2, "running": 0, "done": 0, "failed": 0}
    assert [r.status for r in store.results(study)] == ["waiting", "waiting"]
    with pytest.raises(InputError, match=r"found 'other', but .* holds study"):
        store.study("other")


def test_runs_are_handed_out_in_the_order_of_the_study(store):
    study = study_of(spec("b"), spec("a"), spec("b", seed=1))
    store.add(study)
    claims = [claimed(store, study=study) for _ in study.runs]
    assert [c.spec for c in claims] == list(study.runs)
    assert store.claim(HERE, study) is None
    assert store.counts()["running"] == 3


def test_a_result_stays(store):
    study = study_of(spec("a"))
    store.add(study)
    finish(store, claimed(store), 21.5, machine="m", fingerprint="f")
    for again in (store, Store.open(store.folder, create=False)):
        (result,) = again.results("study")
        assert (result.status, result.seconds, result.machine) == ("done", 4.0, "m")
        assert result.metrics == metrics(21.5)
        assert result.folder == store.folder / "runs" / spec("a").hash
    assert store.claim(HERE) is None
    store.add(study)
    assert store.claim(HERE) is None
    assert json.loads((result.folder / "result.json").read_text())["hash"] == spec("a").hash


def test_rows_and_studies_share_runs(store):
    shared = spec("a")
    one = study_of(shared, replace(shared, label="the same"), name="one")
    two = study_of(replace(shared, label="and here"), spec("b"), name="two")
    store.add(one)
    assert store.add(two) == 1
    finish(store, claimed(store, study="one"))
    assert [(r.spec.label, r.status) for r in store.results("one")] == [("a", "done"), ("the same", "done")]
    assert [(r.spec.label, r.status) for r in store.results("two")] == [
        ("and here", "done"),
        ("b", "waiting"),
    ]
    assert store.counts("one") == {"waiting": 0, "running": 0, "done": 1, "failed": 0}
    assert len(store.results()) == 2


def test_a_changed_study_keeps_what_is_done(store):
    store.add(study_of(spec("a"), spec("b")))
    finish(store, claimed(store))
    changed = study_of(spec("c"), spec("a"))
    store.add(changed)
    assert [(r.spec.label, r.status) for r in store.results("study")] == [("c", "waiting"), ("a", "done")]
    assert store.study("study") == changed
    # b waits, but no study asks for it.
    assert claimed(store, study="study").spec.label == "c"


def test_a_failure_stays_until_a_retry(store):
    store.add(study_of(spec("a"), spec("b")))
    store.fail(claimed(store), "it broke\n  in two ")
    (failed, _) = store.results()
    assert (failed.status, failed.reason, failed.metrics) == ("failed", "it broke in two", None)
    assert claimed(store).spec.label == "b"
    assert store.claim(HERE) is None
    assert store.retry("study") == 1
    assert store.retry("study") == 0
    assert claimed(store).spec.label == "a"


def test_a_run_given_back_waits(store):
    store.add(study_of(spec("a")))
    claim = claimed(store)
    store.release(claim)
    assert store.counts()["waiting"] == 1
    second = claimed(store)
    # The first claim is worth nothing any more.
    store.release(claim)
    assert store.counts()["running"] == 1
    assert not store.beat(claim)
    assert store.beat(second)
    for word in (
        lambda: finish(store, claim),
        lambda: store.fail(claim, "x"),
        lambda: store.mark_lost(claim, "x"),
    ):
        claim.lost.clear()
        with pytest.raises(ClaimLostError):
            word()
        assert claim.lost.is_set()
    assert not (claim.folder / "result.json").exists()
    finish(store, second)
    assert [a["outcome"] for a in store.attempts()] == ["interrupted", "done"]


def test_the_run_of_a_dead_worker_is_taken_up(store):
    store.add(study_of(spec("a")))
    lost = claimed(store, DEAD)
    assert store.results()[0].status == "waiting"
    claim = claimed(store)
    assert claim.spec == lost.spec
    with pytest.raises(ClaimLostError):
        finish(store, lost)
    assert [a["outcome"] for a in store.attempts()] == ["lost", "running"]


def test_the_run_of_a_living_worker_is_its_own(store):
    store.add(study_of(spec("a")))
    claimed(store)
    age(store, 10 * LEASE_SECONDS)
    assert store.claim(replace(HERE, process=1)) is None


def test_a_worker_elsewhere_is_dead_when_it_is_silent(store):
    store.add(study_of(spec("a")))
    claim = claimed(store, ELSEWHERE)
    assert store.claim(HERE) is None
    age(store, LEASE_SECONDS + 1)
    assert store.beat(claim)
    assert store.claim(HERE) is None
    age(store, LEASE_SECONDS + 1)
    assert store.results()[0].status == "waiting"
    assert claimed(store).spec == claim.spec
    assert not store.beat(claim)


def test_a_run_that_takes_its_process_down_fails_in_the_end(store):
    store.add(study_of(spec("a")))
    for number in range(1, MOST_LOSSES + 1):
        assert store.counts()["failed"] == 0
        claim = claimed(store)
        if number == 2:
            store.mark_lost(claim, "signal 9")
        else:
            store.mark_lost(HERE, "signal 9")
    (result,) = store.results()
    assert (result.status, result.reason) == ("failed", "took its process down 3 times (last: signal 9)")
    store.retry()
    store.mark_lost(claimed(store), "signal 9")
    assert store.counts()["waiting"] == 1


def test_the_database_is_the_truth_and_not_the_copy(store):
    """Killed between the result's copy and the database: the run is not finished, and goes to the next worker."""
    store.add(study_of(spec("a"), spec("b")))
    finish(store, claimed(store))
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute(
            "UPDATE runs SET status='running', worker=?, metrics=NULL WHERE status='done'", (DEAD.to_text(),)
        )
    connection.close()
    claim = claimed(store)
    assert claim.spec.label == "a"
    finish(store, claim, 22.0)
    assert store.results()[0].metrics == metrics(22.0)


def test_a_lost_database_is_made_again_from_the_runs(store):
    study = study_of(spec("a"), spec("b"))
    store.add(study)
    finish(store, claimed(store), 25.0, machine="m", fingerprint="f")
    for path in store.folder.glob("store.sqlite*"):
        path.unlink()
    again = Store.open(store.folder)
    again.add(study)
    assert [(r.status, r.machine) for r in again.results(study)] == [("done", "m"), ("waiting", "")]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"hash": 3}', json.dumps({"spec": spec("b").to_json(), "metrics": {}})]
)
def test_a_result_of_something_else_does_not_count(store, text):
    folder = store.run_folder(spec("a").hash)
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(text)
    store.add(study_of(spec("a")))
    assert store.counts()["waiting"] == 1
    assert claimed(store).spec.label == "a"


def test_a_scene_that_changed_under_its_name_is_refused(store):
    runs = [spec("a", scene="x/lego"), spec("b", scene="x/lego"), spec("c", scene="x/lego", protocol="gs8")]
    store.add(study_of(*runs))
    finish(store, claimed(store), fingerprint="one")
    with pytest.raises(InputError, match=r"scene lego: training views differ from those of a \| lego"):
        finish(store, claimed(store), fingerprint="two")
    finish(store, claimed(store), fingerprint="three")
    assert [r.status for r in store.results()] == ["done", "running", "done"]


def test_a_scene_may_move(store):
    def at(place, label="a"):
        return spec(label, scene=f"{place}/lego", config={"scene": f"{place}/lego", "preset": label})

    store.add(study_of(at("here")))
    store.add(study_of(at("there", "renamed")))
    claim = claimed(store)
    assert claim.spec.scene == claim.spec.config["scene"] == "there/lego"
    # A checkpoint knows the configuration that it was started with.
    assert claim.spec.config["preset"] == "a"
    assert store.results("study")[0].spec.label == "renamed"


def test_export_csv(store, tmp_path):
    store.add(study_of(spec("a, b"), spec("c"), spec("d")))
    finish(store, claimed(store), 20.123456789, machine="m")
    store.fail(claimed(store), "it broke")
    path = store.export(tmp_path / "table.csv", "study")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["label"], r["status"], r["reason"]) for r in rows] == [
        ("a, b", "done", ""),
        ("c", "failed", "it broke"),
        ("d", "waiting", ""),
    ]
    assert float(rows[0]["psnr"]) == 20.123456789
    assert (rows[0]["seconds"], rows[0]["seconds_train"], rows[0]["threads"]) == ("4.0", "3.0", "1")
    assert rows[1]["psnr"] == rows[2]["seconds"] == ""
    assert rows[0]["hash"] == spec("a, b").hash


def test_cells_that_begin_like_formulas_are_text(store, tmp_path):
    labels = ["=1+1", "+x", "-x", "@x", "\tx", "x=1", "−1"]
    store.add(study_of(*(spec(label) for label in labels)))
    store.fail(claimed(store), "=HYPERLINK(1)")
    finish(store, claimed(store), -2.5)
    with store.export(tmp_path / "table.csv", "study").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == ["'=1+1", "'+x", "'-x", "'@x", "'\tx", "x=1", "−1"]
    assert rows[0]["reason"] == "'=HYPERLINK(1)"
    # Numbers stay numbers.
    assert rows[1]["psnr"] == "-2.5"


def test_export_parquet(store, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    store.add(study_of(spec("a"), spec("b")))
    finish(store, claimed(store), 20.5)
    store.export(tmp_path / "table.parquet")
    rows = parquet.read_table(tmp_path / "table.parquet").to_pylist()
    assert [(r["label"], r["psnr"], r["views"]) for r in rows] == [("a", 20.5, 8), ("b", None, 8)]


def test_parquet_without_pyarrow(store, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"Parquet needs pyarrow.*gridreg\[parquet\]"):
        store.export(tmp_path / "table.parquet")
    assert list(tmp_path.glob("*.parquet")) == []


def test_export_to_something_else(store, tmp_path):
    with pytest.raises(InputError, match=r"found the ending '\.xls'"):
        store.export(tmp_path / "table.xls")
    with pytest.raises(InputError, match=r"expected \.csv or \.parquet"):
        store.export(tmp_path / "table")
    assert store.export(tmp_path / "empty.csv").read_text() == "label\n"


def test_several_writers_some_of_them_killed(store):
    """Every run ends once, whoever dies when."""
    runs = [spec("a", seed=seed) for seed in range(60)]
    store.add(study_of(*runs))
    script = Path(__file__).with_name("ablation_writers.py")
    subprocess.run([sys.executable, str(script), str(store.folder), "8"], check=True, timeout=100)
    results = store.results()
    assert [(r.status, r.metrics) for r in results] == [
        ("done", metrics(float(r.spec.seed))) for r in results
    ]
    attempts = store.attempts()
    # Of a worker killed between the result and its row, the result counts and the attempt is lost.
    done = [a["hash"] for a in attempts if a["outcome"] == "done"]
    assert len(done) == len(set(done))
    assert set(done) <= {r.hash for r in runs}
    assert {a["outcome"] for a in attempts} <= {"done", "lost"}
    assert len(list(store.folder.glob("runs/*/result.json"))) == 60


def test_several_threads_open_one_store(tmp_path):
    """Whoever comes first makes the tables; nobody fails."""
    errors = []

    def work(folder):
        try:
            Store.open(folder).add(study_of(spec("a")))
        except Exception as error:
            errors.append(error)

    for turn in range(10):
        folder = tmp_path / f"new{turn}"
        threads = [threading.Thread(target=work, args=(folder,)) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert errors == []
        assert len(Store.open(folder).results()) == 1


def test_no_store(tmp_path):
    with pytest.raises(InputError, match=r"holds no store \(store.sqlite is missing\)"):
        Store.open(tmp_path, create=False)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="file: cannot write here"):
        Store.open(tmp_path / "file")


def refused(folder, match):
    """Opening is refused in one line, and the file is left as it is."""
    path = folder / "store.sqlite"
    before = path.read_bytes()
    with pytest.raises(InputError, match=match) as caught:
        Store.open(folder, wait=0.1)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "content", [b"no database at all, but long enough to be one" * 30, b"SQLite format 3\0" + b"x" * 5000]
)
def test_a_corrupt_store(tmp_path, content):
    (tmp_path / "store.sqlite").write_bytes(content)
    refused(tmp_path, "the database is corrupt and was left as it is")


def test_a_damaged_page(store):
    store.add(study_of(*(spec("a", seed=seed) for seed in range(60))))
    path = store.folder / "store.sqlite"
    content = bytearray(path.read_bytes())
    content[4096 * 3 : 4096 * 7] = b"\xff" * 4096 * 4
    path.write_bytes(bytes(content))
    refused(store.folder, "corrupt")


def test_a_store_of_a_newer_version(store):
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
    connection.close()
    refused(store.folder, f"a store of version {SCHEMA_VERSION + 1}, written by a newer gridreg")


def test_a_database_of_another_program(tmp_path):
    with sqlite3.connect(tmp_path / "store.sqlite") as connection:
        connection.execute("CREATE TABLE songs (title TEXT)")
    connection.close()
    refused(tmp_path, "an SQLite database of another program")


def test_a_locked_store(store):
    connection = sqlite3.connect(store.folder / "store.sqlite", isolation_level=None)
    connection.execute("BEGIN IMMEDIATE")
    try:
        began = time.monotonic()
        with pytest.raises(InputError, match="locked by another process for more than 0 s"):
            Store.open(store.folder, wait=0.2).add(study_of(spec("a")))
        assert time.monotonic() - began < 10
        # Reading goes on meanwhile.
        assert store.results() == []
    finally:
        connection.execute("ROLLBACK")
        connection.close()
    assert store.add(study_of(spec("a"))) == 1


def test_a_read_only_store(store, monkeypatch):
    connect = sqlite3.connect

    def read_only(*arguments, **options):
        connection = connect(*arguments, **options)
        connection.execute("PRAGMA query_only=1")
        return connection

    monkeypatch.setattr(sqlite3, "connect", read_only)
    with pytest.raises(InputError, match="the store is read-only"):
        store.add(study_of(spec("a")))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("unable to open database file", "cannot open the database"),
        ("database or disk is full", "no space left"),
        ("something new", "the database cannot be used: something new"),
    ],
)
def test_other_errors_of_sqlite(store, monkeypatch, text, expected):
    def broken(*arguments, **options):
        raise sqlite3.OperationalError(text)

    monkeypatch.setattr(sqlite3, "connect", broken)
    with pytest.raises(InputError, match=expected) as caught:
        store.results()
    assert isinstance(caught.value, DiskFullError) == ("full" in text)


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE runs SET spec='nonsense'",
        "UPDATE runs SET spec='[]'",
        """UPDATE runs SET spec=replace(spec, '"seed": 0', '"seed": "0"')""",
        """UPDATE runs SET spec=replace(spec, '"seed"', '"sead"')""",
        "UPDATE runs SET spec=x'ff00'",
        "UPDATE runs SET worker='{}', status='running'",
        "UPDATE runs SET worker='5', status='running'",
        "UPDATE runs SET worker=NULL, status='running'",
        "UPDATE runs SET metrics='5', status='done'",
        """UPDATE runs SET metrics='{"mean": {"psnr": "much"}}', status='done'""",
        """UPDATE runs SET metrics='{"mean": 3}', status='done'""",
        "UPDATE runs SET metrics=CAST(x'22ff22' AS TEXT)",
        "UPDATE runs SET seconds='soon'",
        "UPDATE studies SET modules='x'",
        "UPDATE studies SET modules='[1]'",
        "UPDATE members SET label=x'00'",
        "ALTER TABLE runs DROP COLUMN seconds",
    ],
)
def test_content_that_is_damaged(store, damage):
    """SQLite checks its pages, not what stands in them."""
    study = study_of(spec("a"))
    store.add(study)
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute(damage)
    connection.close()

    def use():
        again = Store.open(store.folder, create=False)
        again.studies()
        again.results(study)
        again.counts()
        again.export(store.folder / "table.csv")

    with pytest.raises(InputError, match=r"store\.sqlite: ") as caught:
        use()
    assert str(caught.value).isprintable()


def test_marks_of_the_file(store):
    connection = sqlite3.connect(store.folder / "store.sqlite")
    assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION_ID,)
    # A write-ahead log would not work on a network file system.
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("delete",)
    connection.close()


def test_a_store_with_a_write_ahead_log_goes_on(store):
    """As stores were made once."""
    store.add(study_of(spec("a"), spec("b")))
    connection = sqlite3.connect(store.folder / "store.sqlite")
    assert connection.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",)
    connection.close()
    again = Store.open(store.folder, create=False)
    finish(again, claimed(again))
    assert again.counts() == {"waiting": 1, "running": 0, "done": 1, "failed": 0}


def test_workers_are_told_apart(tmp_path, monkeypatch):
    assert HERE.is_alive() is True
    assert DEAD.is_alive() is False
    assert replace(HERE, started="1").is_alive() is False
    assert ELSEWHERE.is_alive() is None
    assert Worker.from_text(HERE.to_text()) == HERE
    # Where the system tells no more than numbers of processes.
    monkeypatch.setattr("gridreg.ablation.workers._place", lambda: "")
    assert replace(HERE, place="").is_alive() is True
    assert replace(DEAD, place="").is_alive() is False


def test_a_heartbeat_finds_out_that_its_claim_is_lost():
    beats, holds = [], {"kept": True, "lost": False}
    claims = {label: Claim(spec(label), None, label) for label in ("kept", "lost", "dropped")}

    def beat(claim):
        beats.append(claim.token)
        if claim.token == "kept" and beats.count("kept") == 1:
            raise InputError("locked for a moment")
        return holds[claim.token]

    with heartbeat(beat, claims.values(), every=0.01):
        del claims["dropped"]
        assert claims["lost"].lost.wait(10)
    assert "kept" in beats
    assert not claims["kept"].lost.is_set()
    claims["kept"].check()
    with pytest.raises(ClaimLostError, match="given to another worker"):
        claims["lost"].check()


class Writers(RuleBasedStateMachine):
    """Any order of claims, ends and deaths: a run has one worker, and what is done stays done."""

    @initialize(target=None)
    def begin(self):
        import tempfile

        self.folder = tempfile.TemporaryDirectory()
        self.store = Store.open(self.folder.name)
        self.store.add(study_of(*(spec("a", seed=seed) for seed in range(3))))
        self.held: list[tuple[Claim, bool]] = []
        self.done: set[str] = set()

    @rule(alive=st.booleans())
    def claim(self, alive):
        # The dead worker's runs are free again at once.
        self.held = [(c, living) for c, living in self.held if living]
        claim = self.store.claim(HERE if alive else DEAD)
        if claim is None:
            assert len(self.held) + len(self.done) + self.store.counts()["failed"] == 3
        else:
            assert claim.spec.hash not in self.done
            assert claim.spec.hash not in {c.spec.hash for c, _ in self.held}
            self.held.append((claim, alive))

    @rule(number=st.integers(0, 2), how=st.sampled_from(["finish", "fail", "release"]))
    def end(self, number, how):
        if number < len(self.held):
            claim, _ = self.held.pop(number)
            if how == "finish":
                finish(self.store, claim)
                self.done.add(claim.spec.hash)
            elif how == "fail":
                self.store.fail(claim, "x")
            else:
                self.store.release(claim)

    @rule()
    def retry(self):
        self.store.retry()

    @invariant()
    def what_is_done_stays_done(self):
        if hasattr(self, "store"):
            assert {r.spec.hash for r in self.store.results() if r.status == "done"} == self.done

    def teardown(self):
        if hasattr(self, "folder"):
            self.folder.cleanup()


TestWriters = Writers.TestCase
TestWriters.settings = settings(max_examples=10, stateful_step_count=15, deadline=None, derandomize=True)
