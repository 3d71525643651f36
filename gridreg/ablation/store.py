"""The store: a folder of runs and one SQLite database that says what is waiting, running, done and failed.

    STORE/store.sqlite          who has what, metrics of finished runs, studies
    STORE/runs/HASH/            what `gridreg.training.execute` leaves, and result.json when the run is finished

Several processes write at the same time; each may be killed at any moment. A run belongs to one worker at a time.
``result.json`` is complete or not there, and a run that has one is never repeated, whatever the database says.
"""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gridreg.ablation.claims import Claim
from gridreg.ablation.database import Database
from gridreg.ablation.export import export_results
from gridreg.ablation.records import STATUSES, RunResult, Status, Study
from gridreg.ablation.transitions import (
    RESULT_NAME,
    adopt,
    check_claim,
    check_fingerprint,
    count_loss,
    members,
    move_scene,
    seen_status,
    set_done,
    set_failed,
    set_waiting,
)
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.training.files import check_output_folder, write_json

__all__ = ["Attempt", "Store"]

Attempt = dict[str, Any]
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
        return Store(path, Database(path / _DATABASE, create=create, wait=wait))

    @property
    def note(self) -> str:
        """What there is to know about the file system; empty on an ordinary one."""
        return self._database.note

    def run_folder(self, spec_hash: str) -> Path:
        """The folder of a run."""
        return self.folder / "runs" / spec_hash

    def add(self, study: Study) -> int:
        """Take a study in: runs that are not known yet wait; a study of the same name is replaced, its runs stay.

        Returns:
            The number of runs that the store did not know.
        """
        new = 0
        with self._database.writing() as connection:
            connection.execute("DELETE FROM members WHERE study=?", (study.name,))
            connection.execute(
                "INSERT OR REPLACE INTO studies VALUES (?, ?, ?, ?, ?)",
                (study.name, study.title, study.baseline, study.source, json.dumps(study.modules)),
            )
            for position, spec in enumerate(study.runs):
                values = (spec.hash, json.dumps(spec.to_json()), spec.scene_name)
                inserted = connection.execute(
                    "INSERT OR IGNORE INTO runs (hash, spec, scene, status) VALUES (?, ?, ?, 'waiting')",
                    values,
                ).rowcount
                if inserted:
                    new += 1
                    adopt(connection, spec.hash, self.run_folder(spec.hash))
                else:
                    move_scene(connection, spec)
                connection.execute(
                    "INSERT INTO members VALUES (?, ?, ?, ?)", (study.name, position, spec.hash, spec.label)
                )
        return new

    def studies(self) -> list[Study]:
        """Every study, by name."""
        with self._database.reading() as connection:
            rows = connection.execute("SELECT * FROM studies ORDER BY name").fetchall()
            return [
                Study(
                    row["name"],
                    row["title"],
                    row["baseline"],
                    tuple(spec for spec, _ in members(connection, row["name"])),
                    row["source"],
                    tuple(json.loads(row["modules"])),
                )
                for row in rows
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
        """What is known of the runs of a study, in its order; of all runs without one.

        A run whose worker has died counts as waiting.
        """
        name = study.name if isinstance(study, Study) else study
        with self._database.reading() as connection:
            return [
                RunResult(
                    spec=spec,
                    status=seen_status(row),
                    metrics=None if row["metrics"] is None else json.loads(row["metrics"]),
                    reason=row["reason"],
                    folder=self.run_folder(row["hash"]),
                    seconds=row["seconds"],
                    machine=row["machine"],
                )
                for spec, row in members(connection, name)
            ]

    def counts(self, study: Study | str | None = None) -> dict[Status, int]:
        """Number of runs by status, each run once."""
        by_hash = {result.spec.hash: result.status for result in self.results(study)}
        return {status: list(by_hash.values()).count(status) for status in STATUSES}

    def claim(self, worker: Worker, study: Study | str | None = None) -> Claim | None:
        """Take the next run that waits, or whose worker has died; None if there is none now.

        Args:
            worker: who will work on it.
            study: only runs of this study.
        """
        name = study.name if isinstance(study, Study) else study
        with self._database.writing() as connection:
            for row in connection.execute("SELECT * FROM runs WHERE status='running'").fetchall():
                if seen_status(row) == "waiting":
                    set_waiting(connection, row["hash"], "lost")
            for spec, row in members(connection, name):
                if row["status"] != "waiting" or adopt(connection, row["hash"], self.run_folder(row["hash"])):
                    continue
                token, now = secrets.token_hex(8), time.time()
                connection.execute(
                    "UPDATE runs SET status='running', worker=?, token=?, heartbeat=?, reason='' WHERE hash=?",
                    (worker.to_text(), token, now, row["hash"]),
                )
                connection.execute(
                    "INSERT INTO attempts (hash, worker, began) VALUES (?, ?, ?)",
                    (row["hash"], worker.to_text(), now),
                )
                return Claim(spec, self.run_folder(spec.hash), token)
        return None

    def beat(self, claim: Claim) -> bool:
        """A sign of life; returns whether the claim still holds."""
        with self._database.writing() as connection:
            return bool(
                connection.execute(
                    "UPDATE runs SET heartbeat=? WHERE hash=? AND token=? AND status='running'",
                    (time.time(), claim.spec.hash, claim.token),
                ).rowcount
            )

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
        spec = claim.spec
        record = {
            "spec": spec.to_json(),
            "hash": spec.hash,
            "metrics": dict(metrics),
            "seconds": sum(metrics.get("seconds", {}).values()),
            "machine": machine,
            "fingerprint": fingerprint,
        }
        with self._database.writing() as connection:
            check_claim(connection, claim)
            check_fingerprint(connection, spec, fingerprint)
            write_json(claim.folder / RESULT_NAME, record)
            set_done(connection, spec.hash, record)

    def fail(self, claim: Claim, reason: str) -> None:
        """Keep the reason why a run failed; it is tried again on request only (`retry`).

        Raises:
            ClaimLostError: if somebody else has the run.
        """
        line = " ".join(reason.split()) or "no reason was given"
        with self._database.writing() as connection:
            check_claim(connection, claim)
            set_failed(connection, claim.spec.hash, line)

    def release(self, claim: Claim, outcome: str = "interrupted") -> None:
        """Give a run back unfinished; its checkpoint stays. Nothing happens if the claim is lost."""
        with self._database.writing() as connection:
            held = connection.execute("SELECT token FROM runs WHERE hash=?", (claim.spec.hash,)).fetchone()
            if held is not None and held["token"] == claim.token:
                set_waiting(connection, claim.spec.hash, outcome)

    def lose(self, worker: Worker, reason: str) -> None:
        """Note that a worker has died: its runs wait again, or count as failed after `MOST_LOSSES` such deaths.

        Args:
            worker: that died.
            reason: what is known of it, one line.
        """
        with self._database.writing() as connection:
            query = "SELECT hash, losses FROM runs WHERE worker=? AND status='running'"
            for row in connection.execute(query, (worker.to_text(),)).fetchall():
                count_loss(connection, row["hash"], row["losses"] + 1, reason)

    def lose_claim(self, claim: Claim, reason: str) -> None:
        """Note that whoever worked under this claim has died, as `lose`."""
        with self._database.writing() as connection:
            check_claim(connection, claim)
            query = "SELECT losses FROM runs WHERE hash=?"
            losses = connection.execute(query, (claim.spec.hash,)).fetchone()["losses"] + 1
            count_loss(connection, claim.spec.hash, losses, reason)

    def retry(self, study: Study | str | None = None) -> int:
        """Let failed runs wait again; returns how many."""
        name = study.name if isinstance(study, Study) else study
        with self._database.writing() as connection:
            failed = {row["hash"] for _, row in members(connection, name) if row["status"] == "failed"}
            for spec_hash in failed:
                connection.execute(
                    "UPDATE runs SET status='waiting', reason='', losses=0 WHERE hash=?", (spec_hash,)
                )
        return len(failed)

    def attempts(self, since: int = 0) -> list[Attempt]:
        """Every attempt at a run after a number: ``number, hash, worker, began, ended, outcome``."""
        with self._database.reading() as connection:
            query = "SELECT * FROM attempts WHERE number>? ORDER BY number"
            return [dict(row) for row in connection.execute(query, (since,))]

    def export(self, path: str | os.PathLike[str], study: Study | str | None = None) -> Path:
        """Write a table of the runs, one a line.

        Args:
            path: ends in ``.csv`` or ``.parquet`` (which needs pyarrow).
            study: only runs of this study.

        Raises:
            InputError: for another ending, an unwritable place, or Parquet without pyarrow.
        """
        return export_results(self.results(study), Path(path))
