"""Rows of the store's database as records, and changes of state: every function is part of one transaction."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from gridreg.ablation.claims import LEASE_SECONDS, Claim
from gridreg.ablation.records import STATUSES, RunSpec, Status, Study
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.scenes.files import read_json

RESULT_NAME = "result.json"
"""File in a run's folder with a copy of the result; whole or not there."""

# Every run without a study.
OF_STUDY = "(:study IS NULL OR hash IN (SELECT hash FROM members WHERE study=:study))"
_COLUMNS = "runs.hash, spec, status, reason, metrics, seconds, machine, worker, heartbeat"


def name_of(study: Study | str | None) -> str | None:
    """The name of a study; None: every study."""
    return study.name if isinstance(study, Study) else study


def members(
    connection: sqlite3.Connection, study: str | None, status: str = "%"
) -> Iterator[tuple[RunSpec, sqlite3.Row]]:
    """Runs of a study in its order, labelled as it says; without one, every run."""
    if study is None:
        query = f"SELECT {_COLUMNS}, NULL AS label FROM runs WHERE status LIKE :status ORDER BY rowid"
    else:
        query = (
            f"SELECT {_COLUMNS}, label FROM members JOIN runs USING (hash) "
            "WHERE study=:study AND status LIKE :status ORDER BY position"
        )
    for row in connection.execute(query, {"study": study, "status": status}):
        data = json.loads(row["spec"])
        yield (
            RunSpec.from_json({**data, "label": data["label"] if row["label"] is None else row["label"]}),
            row,
        )


def status_of(row: sqlite3.Row) -> Status:
    """The status, where a run whose worker has died waits."""
    status = STATUSES[STATUSES.index(row["status"])]
    if status != "running":
        return status
    alive = Worker.from_text(row["worker"]).is_alive()
    if alive is None:
        alive = time.time() - row["heartbeat"] < LEASE_SECONDS
    return "running" if alive else "waiting"


def metrics_of(text: str | None) -> dict[str, Any] | None:
    """The metrics of a run, of which the means and seconds are numbers (or text of them, such as infinity)."""
    if text is None:
        return None
    found: dict[str, Any] = json.loads(text)
    for group in ("mean", "seconds"):
        for value in found.get(group, {}).values():
            float(value)
    dict(found.get("images", {})), dict(found.get("versions", {}))
    return found


def names_of(text: str) -> tuple[str, ...]:
    """Names from a JSON list."""
    found = json.loads(text)
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise ValueError(f"found {text!r}, expected a list of names")
    return tuple(found)


def holds(connection: sqlite3.Connection, claim: Claim) -> bool:
    """Whether the run is still that of whoever made this claim."""
    query = "SELECT 1 FROM runs WHERE hash=? AND token=? AND status='running'"
    return connection.execute(query, (claim.spec.hash, claim.token)).fetchone() is not None


def set_status(
    connection: sqlite3.Connection, spec_hash: str, status: Status, *, outcome: str = "", reason: str = ""
) -> None:
    """Let a run have a status, and nobody work on it; the attempt under way, if there is one, ends."""
    connection.execute(
        "UPDATE attempts SET outcome=?, ended=? WHERE hash=? AND outcome='running'",
        (outcome or status, time.time(), spec_hash),
    )
    connection.execute(
        "UPDATE runs SET status=?, reason=?, worker=NULL, token=NULL WHERE hash=?",
        (status, reason, spec_hash),
    )


def set_done(connection: sqlite3.Connection, spec_hash: str, record: Mapping[str, Any]) -> None:
    """Keep the result, as it stands in ``result.json``."""
    set_status(connection, spec_hash, "done")
    connection.execute(
        "UPDATE runs SET metrics=?, seconds=?, machine=?, fingerprint=? WHERE hash=?",
        (
            json.dumps(record["metrics"]),
            *(record[key] for key in ("seconds", "machine", "fingerprint")),
            spec_hash,
        ),
    )


def import_result(connection: sqlite3.Connection, spec: RunSpec, folder: Path) -> None:
    """Take over the result that stands in the folder of a run that the database did not know, if there is one."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        record = read_json(folder / RESULT_NAME)
        # Not only the name of the folder: the result must be that of this very run, in today's numerics.
        if RunSpec.from_json(record["spec"]).hash == spec.hash and metrics_of(json.dumps(record["metrics"])):
            known = {"seconds": 0.0, "machine": "", "fingerprint": "", **record}
            set_done(connection, spec.hash, known)


def move_scene(connection: sqlite3.Connection, spec: RunSpec) -> None:
    """Let a stored run that is not finished find its scene where it lies now; all else stays as it was stored."""
    query = "SELECT spec FROM runs WHERE hash=? AND status!='done'"
    for row in connection.execute(query, (spec.hash,)).fetchall():
        stored = RunSpec.from_json(json.loads(row["spec"]))
        if stored.scene != spec.scene:
            moved = replace(stored, scene=spec.scene, config={**stored.config, "scene": spec.scene})
            connection.execute(
                "UPDATE runs SET spec=? WHERE hash=?", (json.dumps(moved.to_json()), spec.hash)
            )


def check_fingerprint(connection: sqlite3.Connection, spec: RunSpec, fingerprint: str) -> None:
    """Refuse a result of another scene under a name that is known already.

    Raises:
        InputError: if the training views of an earlier run were others.
    """
    query = (
        "SELECT spec, fingerprint FROM runs WHERE scene=? AND status='done' AND fingerprint NOT IN ('', ?)"
    )
    for row in connection.execute(query, (spec.scene_name, fingerprint)) if fingerprint else ():
        other = RunSpec.from_json(json.loads(row["spec"]))
        if (other.protocol, other.size) == (spec.protocol, spec.size):
            raise InputError(
                f"scene {spec.scene_name}: training views differ from those of {other.describe()} "
                f"({fingerprint[:8]} and {row['fingerprint'][:8]}); expected one scene under one name in a store"
            )
