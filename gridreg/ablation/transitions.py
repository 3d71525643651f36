"""How runs change their state: every function is part of one transaction of the store."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gridreg.ablation.claims import LEASE_SECONDS, Claim
from gridreg.ablation.records import RunSpec, Status
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError

__all__ = [
    "MOST_LOSSES",
    "RESULT_NAME",
    "adopt",
    "check_claim",
    "check_fingerprint",
    "count_loss",
    "end_attempt",
    "members",
    "move_scene",
    "seen_status",
    "set_done",
    "set_failed",
    "set_waiting",
]

MOST_LOSSES = 3
"""Times that a run may take its process down before it counts as failed."""

RESULT_NAME = "result.json"
"""File in a run's folder that holds the result; whole or not there."""


def members(connection: sqlite3.Connection, study: str | None) -> Iterator[tuple[RunSpec, sqlite3.Row]]:
    """Runs of a study in its order, labelled as it says; without one, every run."""
    rows: Sequence[sqlite3.Row]
    if study is None:
        rows = connection.execute("SELECT *, NULL AS label FROM runs ORDER BY rowid").fetchall()
    else:
        query = "SELECT runs.*, label FROM members JOIN runs USING (hash) WHERE study=? ORDER BY position"
        rows = connection.execute(query, (study,)).fetchall()
    for row in rows:
        data = json.loads(row["spec"])
        yield RunSpec.from_json({**data, "label": row["label"] or data["label"]}), row


def seen_status(row: sqlite3.Row) -> Status:
    """The status, where a run whose worker has died waits."""
    status: Status = row["status"]
    if status != "running":
        return status
    alive = Worker.from_text(row["worker"]).is_alive()
    if alive is None:
        alive = time.time() - row["heartbeat"] < LEASE_SECONDS
    return "running" if alive else "waiting"


def end_attempt(connection: sqlite3.Connection, spec_hash: str, outcome: str) -> None:
    """Close the attempt under way, if there is one."""
    connection.execute(
        "UPDATE attempts SET outcome=?, ended=? WHERE hash=? AND outcome='running'",
        (outcome, time.time(), spec_hash),
    )


def set_waiting(connection: sqlite3.Connection, spec_hash: str, outcome: str) -> None:
    """Give the run to whoever asks next."""
    end_attempt(connection, spec_hash, outcome)
    connection.execute("UPDATE runs SET status='waiting', worker=NULL, token=NULL WHERE hash=?", (spec_hash,))


def set_failed(connection: sqlite3.Connection, spec_hash: str, reason: str) -> None:
    """Keep why the run failed."""
    end_attempt(connection, spec_hash, "failed")
    connection.execute(
        "UPDATE runs SET status='failed', reason=?, worker=NULL, token=NULL WHERE hash=?", (reason, spec_hash)
    )


def set_done(connection: sqlite3.Connection, spec_hash: str, record: Mapping[str, Any]) -> None:
    """Keep the result, as it stands in ``result.json``."""
    end_attempt(connection, spec_hash, "done")
    connection.execute(
        "UPDATE runs SET status='done', reason='', metrics=?, seconds=?, machine=?, fingerprint=?, worker=NULL, "
        "token=NULL WHERE hash=?",
        (
            json.dumps(record["metrics"]),
            record["seconds"],
            record["machine"],
            record["fingerprint"],
            spec_hash,
        ),
    )


def adopt(connection: sqlite3.Connection, spec_hash: str, folder: Path) -> bool:
    """Take over the result that stands in a run's folder, if there is one."""
    try:
        record = json.loads((folder / RESULT_NAME).read_bytes())
        # Not only the name of the folder: the result must be that of this very run, in today's numerics.
        known = RunSpec.from_json(record["spec"]).hash == spec_hash
        mended = {
            "seconds": 0.0,
            "machine": "",
            "fingerprint": "",
            **record,
            "metrics": dict(record["metrics"]),
        }
    except (OSError, ValueError, KeyError, TypeError):
        return False
    if known:
        set_done(connection, spec_hash, mended)
    return known


def move_scene(connection: sqlite3.Connection, spec: RunSpec) -> None:
    """Let a stored run that is not finished find its scene where it lies now; all else stays as it was stored."""
    row = connection.execute("SELECT spec, status FROM runs WHERE hash=?", (spec.hash,)).fetchone()
    stored = RunSpec.from_json(json.loads(row["spec"]))
    if row["status"] != "done" and stored.scene != spec.scene:
        moved = replace(stored, scene=spec.scene, config={**stored.config, "scene": spec.scene})
        connection.execute("UPDATE runs SET spec=? WHERE hash=?", (json.dumps(moved.to_json()), spec.hash))


def check_claim(connection: sqlite3.Connection, claim: Claim) -> None:
    """Refuse the word of somebody who has the run no longer.

    Raises:
        ClaimLostError: if so.
    """
    row = connection.execute("SELECT token, status FROM runs WHERE hash=?", (claim.spec.hash,)).fetchone()
    if row is None or row["token"] != claim.token or row["status"] != "running":
        claim.lost.set()
        claim.check()


def check_fingerprint(connection: sqlite3.Connection, spec: RunSpec, fingerprint: str) -> None:
    """Refuse a result of another scene under a name that is known already.

    Raises:
        InputError: if the training views of an earlier run were others.
    """
    query = (
        "SELECT spec, fingerprint FROM runs WHERE scene=? AND status='done' AND fingerprint NOT IN ('', ?)"
    )
    for row in connection.execute(query, (spec.scene_name, fingerprint)):
        other = RunSpec.from_json(json.loads(row["spec"]))
        if fingerprint and (other.protocol, other.size) == (spec.protocol, spec.size):
            raise InputError(
                f"scene {spec.scene_name}: training views differ from those of {other.describe()} "
                f"({fingerprint[:8]} and {row['fingerprint'][:8]}); expected one scene under one name in a store"
            )


def count_loss(connection: sqlite3.Connection, spec_hash: str, losses: int, reason: str) -> None:
    """Note that a run went down with its process: it waits, or has failed after `MOST_LOSSES` times."""
    connection.execute("UPDATE runs SET losses=? WHERE hash=?", (losses, spec_hash))
    if losses >= MOST_LOSSES:
        set_failed(connection, spec_hash, f"took its process down {losses} times (last: {reason})")
    else:
        set_waiting(connection, spec_hash, "lost")
