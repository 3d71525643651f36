"""The store: a folder of runs and one SQLite database that says what is waiting, running, done and failed.

    STORE/store.sqlite          who has what, results of finished runs, studies: the one truth about runs
    STORE/runs/HASH/            what `gridreg.training.execute` leaves, and a copy of the result, ``result.json``

Several processes write at the same time; each may be killed at any moment. A run belongs to one worker at a time. A
copy is read in one case only: where the database has never heard of the run, it is taken in as finished.
"""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gridreg.ablation import transitions
from gridreg.ablation.claims import Claim
from gridreg.ablation.database import Database
from gridreg.ablation.export import export_results
from gridreg.ablation.records import STATUSES, RunResult, Status, Study
from gridreg.ablation.transitions import OF_STUDY, RESULT_NAME, name_of, set_status, status_of
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.training.files import check_output_folder, write_json

Attempt = dict[str, Any]

MOST_LOSSES = 3
"""Times that a run may take its process down before it counts as failed."""

_DATABASE = "store.sqlite"


class Store:
    """Runs, by what determines them. Make one with `Store.open`."""

    def __init__(self, folder: Path, database: Database) -> None:
        self.folder = folder
        self._database = database

    @staticmethod
    def open(folder: str | os.PathLike[str], create: bool = True, *, wait: float = 20.0) -> Store:
        """Open the store in a folder.

        Args:
            folder: of the store.
            create: make it if it is not there.
            wait: seconds to wait for other writers before the database counts as locked.

        Raises:
            InputError: if it is not there, locked, read-only, corrupt, of a newer version, or not a store; nothing is
                overwritten in any of these cases.
        """
        path = Path(folder)
        if create:
            check_output_folder(path)
        elif not (path / _DATABASE).is_file():
            raise InputError(
                f"{path}: holds no store ({_DATABASE} is missing); expected the output folder of a study"
            )
        return Store(path, Database(path / _DATABASE, wait=wait))

    def run_folder(self, spec_hash: str) -> Path:
        """The folder of a run."""
        return self.folder / "runs" / spec_hash

    def add(self, study: Study) -> int:
        """Take a study in: runs that are not known yet wait; a study of the same name is replaced, its runs stay.

        Returns:
            The number of runs that the store did not know.
        """
        new = 0
        with self._database.writing() as connection, self._database.decoding():
            connection.execute("DELETE FROM members WHERE study=?", (study.name,))
            connection.execute(
                "INSERT OR REPLACE INTO studies (name, title, baseline, source, modules) VALUES (?, ?, ?, ?, ?)",
                (study.name, study.title, study.baseline, study.source, json.dumps(study.modules)),
            )
            for position, spec in enumerate(study.runs):
                inserted = connection.execute(
                    "INSERT OR IGNORE INTO runs (hash, spec, scene, status) VALUES (?, ?, ?, 'waiting')",
                    (spec.hash, json.dumps(spec.to_json()), spec.scene_name),
                ).rowcount
                if inserted:
                    new += 1
                    transitions.import_result(connection, spec, self.run_folder(spec.hash))
                else:
                    transitions.move_scene(connection, spec)
                connection.execute(
                    "INSERT INTO members (study, position, hash, label) VALUES (?, ?, ?, ?)",
                    (study.name, position, spec.hash, spec.label),
                )
        return new

    def studies(self) -> list[Study]:
        """Every study, by name.

        Raises:
            InputError: if what the database holds is damaged.
        """
        query = "SELECT name, title, baseline, source, modules FROM studies ORDER BY name"
        with self._database.reading() as connection, self._database.decoding():
            return [
                Study(
                    name=str(row["name"]),
                    title=str(row["title"]),
                    baseline=str(row["baseline"]),
                    runs=tuple(spec for spec, _ in transitions.members(connection, row["name"])),
                    source=str(row["source"]),
                    modules=transitions.names_of(row["modules"]),
                )
                for row in connection.execute(query).fetchall()
            ]

    def study(self, name: str) -> Study:
        """One study.

        Raises:
            InputError: if there is none of this name, with the names there are.
        """
        found = {study.name: study for study in self.studies()}
        if name not in found:
            known = ", ".join(found) or "none at all"
            raise InputError(f"study: found {name!r}, but {self.folder} holds {known}")
        return found[name]

    def results(self, study: Study | str | None = None) -> list[RunResult]:
        """Results of the runs of a study, finished or not, in its order; of all runs without one.

        A run whose worker has died counts as waiting.

        Raises:
            InputError: if what the database holds is damaged.
        """
        with self._database.reading() as connection, self._database.decoding():
            return [
                RunResult(
                    spec=spec,
                    status=status_of(row),
                    metrics=transitions.metrics_of(row["metrics"]),
                    reason=str(row["reason"]),
                    folder=self.run_folder(row["hash"]),
                    seconds=float(row["seconds"]),
                    machine=str(row["machine"]),
                )
                for spec, row in transitions.members(connection, name_of(study))
            ]

    def counts(self, study: Study | str | None = None) -> dict[Status, int]:
        """Number of runs by status, each run once."""
        query = f"SELECT status, worker, heartbeat FROM runs WHERE {OF_STUDY}"
        with self._database.reading() as connection, self._database.decoding():
            found = [status_of(row) for row in connection.execute(query, {"study": name_of(study)})]
        return {status: found.count(status) for status in STATUSES}

    def claim(self, worker: Worker, study: Study | str | None = None) -> Claim | None:
        """Take the next run that waits, or whose worker has died; None if there is none now.

        Args:
            worker: who will work on it.
            study: only runs of this study.
        """
        query = "SELECT hash, status, worker, heartbeat FROM runs WHERE status='running'"
        with self._database.writing() as connection, self._database.decoding():
            for row in connection.execute(query).fetchall():
                if status_of(row) == "waiting":
                    set_status(connection, row["hash"], "waiting", outcome="lost")
            spec, row = next(transitions.members(connection, name_of(study), "waiting"), (None, None))
            if spec is None or row is None:
                return None
            token, now = secrets.token_hex(8), time.time()
            connection.execute(
                "UPDATE runs SET status='running', worker=?, token=?, heartbeat=?, reason='' WHERE hash=?",
                (worker.to_text(), token, now, row["hash"]),
            )
            connection.execute(
                "INSERT INTO attempts (hash, worker, began) VALUES (?, ?, ?)",
                (row["hash"], worker.to_text(), now),
            )
            return Claim(spec, self.run_folder(row["hash"]), token)

    def beat(self, claim: Claim) -> bool:
        """A sign of life; returns whether the claim still holds."""
        query = "UPDATE runs SET heartbeat=? WHERE hash=? AND token=? AND status='running'"
        with self._database.writing() as connection:
            values = (time.time(), claim.spec.hash, claim.token)
            return bool(connection.execute(query, values).rowcount)

    def finish(
        self, claim: Claim, metrics: Mapping[str, Any], *, machine: str = "", fingerprint: str = ""
    ) -> None:
        """Keep the result of a run.

        Args:
            claim: on the run.
            metrics: as `gridreg.training.execute` returned them.
            machine: that computed it.
            fingerprint: of the scene as it was trained on.

        Raises:
            ClaimLostError: if somebody else has the run.
            InputError: if another run saw another scene under the same name and protocol.
        """
        record = {
            "spec": claim.spec.to_json(),
            "hash": claim.spec.hash,
            "metrics": dict(metrics),
            "seconds": sum(metrics.get("seconds", {}).values()),
            "machine": machine,
            "fingerprint": fingerprint,
        }
        with self._held(claim) as connection:
            transitions.check_fingerprint(connection, claim.spec, fingerprint)
            write_json(claim.folder / RESULT_NAME, record)
            transitions.set_done(connection, claim.spec.hash, record)

    def fail(self, claim: Claim, reason: str) -> None:
        """Keep the reason why a run failed; it is tried again on request only (`retry`).

        Raises:
            ClaimLostError: if somebody else has the run.
        """
        with self._held(claim) as connection:
            line = " ".join(reason.split()) or "no reason was given"
            set_status(connection, claim.spec.hash, "failed", reason=line)

    def release(self, claim: Claim, outcome: str = "interrupted") -> None:
        """Give a run back unfinished; its checkpoint stays. Nothing happens if the claim is lost."""
        with self._database.writing() as connection:
            if transitions.holds(connection, claim):
                set_status(connection, claim.spec.hash, "waiting", outcome=outcome)

    def mark_lost(self, holder: Worker | Claim, reason: str) -> None:
        """Note that a worker has died: its runs wait again, or count as failed after `MOST_LOSSES` such deaths.

        Args:
            holder: the worker that died, or the claim under which it worked.
            reason: what is known of it, one line.

        Raises:
            ClaimLostError: if somebody else has the run of this claim.
        """
        column, value = (
            ("worker", holder.to_text()) if isinstance(holder, Worker) else ("token", holder.token)
        )
        held = self._database.writing() if isinstance(holder, Worker) else self._held(holder)
        with held as connection:
            query = f"SELECT hash, losses FROM runs WHERE {column}=? AND status='running'"
            for row in connection.execute(query, (value,)).fetchall():
                losses = row["losses"] + 1
                connection.execute("UPDATE runs SET losses=? WHERE hash=?", (losses, row["hash"]))
                if losses < MOST_LOSSES:
                    set_status(connection, row["hash"], "waiting", outcome="lost")
                else:
                    told = f"took its process down {losses} times (last: {reason})"
                    set_status(connection, row["hash"], "failed", reason=told)

    def retry(self, study: Study | str | None = None) -> int:
        """Let failed runs wait again; returns how many."""
        update = f"UPDATE runs SET status='waiting', reason='', losses=0 WHERE status='failed' AND {OF_STUDY}"
        with self._database.writing() as connection:
            return connection.execute(update, {"study": name_of(study)}).rowcount

    def attempts(self, since: int = 0) -> list[Attempt]:
        """Every attempt at a run after a number: ``number, hash, worker, began, ended, outcome``."""
        columns = "number, hash, worker, began, ended, outcome"
        query = f"SELECT {columns} FROM attempts WHERE number>? ORDER BY number"
        with self._database.reading() as connection:
            return [dict(row) for row in connection.execute(query, (since,))]

    def export(self, path: str | os.PathLike[str], study: Study | str | None = None) -> Path:
        """Write a table of the runs, one a line, to a name that ends in ``.csv`` or ``.parquet`` (needs pyarrow).

        Raises:
            InputError: of `gridreg.ablation.export.export_results`.
        """
        return export_results(self.results(study), Path(path))

    @contextmanager
    def _held(self, claim: Claim) -> Iterator[sqlite3.Connection]:
        """A transaction of whoever has the run; the word of somebody who has it no longer is refused."""
        with self._database.writing() as connection:
            if not transitions.holds(connection, claim):
                claim.lost.set()
                claim.check()
            yield connection
