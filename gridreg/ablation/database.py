"""The SQLite file of a store: opened with care, never overwritten, and its errors in one line."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gridreg.errors import InputError

__all__ = ["APPLICATION_ID", "SCHEMA_VERSION", "Database", "network_file_system"]

SCHEMA_VERSION = 1
"""Raised by one whenever an older gridreg could not read what is written."""

APPLICATION_ID = 0x67726567
"""Marks the SQLite file as a store of ours ("greg")."""

_WAIT = 20.0
_SCHEMA = """
CREATE TABLE runs (
    hash TEXT PRIMARY KEY,
    spec TEXT NOT NULL,
    scene TEXT NOT NULL,
    status TEXT NOT NULL CHECK (status IN ('waiting', 'running', 'done', 'failed')),
    reason TEXT NOT NULL DEFAULT '',
    metrics TEXT,
    seconds REAL NOT NULL DEFAULT 0,
    machine TEXT NOT NULL DEFAULT '',
    fingerprint TEXT NOT NULL DEFAULT '',
    worker TEXT,
    token TEXT,
    heartbeat REAL,
    losses INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE studies (
    name TEXT PRIMARY KEY,
    title TEXT NOT NULL,
    baseline TEXT NOT NULL,
    source TEXT NOT NULL,
    modules TEXT NOT NULL
);
CREATE TABLE members (
    study TEXT NOT NULL REFERENCES studies (name),
    position INTEGER NOT NULL,
    hash TEXT NOT NULL REFERENCES runs (hash),
    label TEXT NOT NULL,
    PRIMARY KEY (study, position)
);
CREATE TABLE attempts (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    hash TEXT NOT NULL REFERENCES runs (hash),
    worker TEXT NOT NULL,
    began REAL NOT NULL,
    ended REAL,
    outcome TEXT NOT NULL DEFAULT 'running'
);
CREATE INDEX members_by_hash ON members (hash);
CREATE INDEX attempts_by_hash ON attempts (hash);
"""
_NETWORK = {
    *("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "afs", "ceph", "lustre", "gpfs", "beegfs", "glusterfs"),
    *("fuse.sshfs", "fuse.glusterfs", "fuse.s3fs", "fuse.gcsfuse", "fuse.juicefs"),
}


class Database:
    """A file that holds the tables; every operation opens it, works in one transaction, and closes it.

    Args:
        path: of the file.
        create: make it if it is not there.
        wait: seconds to wait for other writers.

    Attributes:
        note: what the user should know about the file system, or nothing.

    Raises:
        InputError: if it is missing, corrupt, locked, read-only, written by a newer gridreg, or no store.
    """

    def __init__(self, path: Path, *, create: bool = True, wait: float = _WAIT) -> None:
        self.path = path
        self.wait = wait
        self.note = ""
        if not create and not path.is_file():
            raise InputError(f"{path}: no such file; expected the database of a store")
        # One moment for all questions: another process may be making the tables just now.
        with self.reading() as connection:
            self._is_ours(connection)
        with self._errors(), contextlib.closing(self._connect()) as connection:
            self.note = self._set_journal(connection)
            connection.execute("BEGIN IMMEDIATE")
            if not self._is_ours(connection):
                for statement in _SCHEMA.split(";"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            connection.execute("COMMIT")
            found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
            if found != "ok":
                raise sqlite3.DatabaseError(f"malformed: {found}")

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A connection for queries that see one moment."""
        with self._transaction("BEGIN") as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """A connection that no other writer interferes with; what an exception leaves behind is undone."""
        with self._transaction("BEGIN IMMEDIATE") as connection:
            yield connection

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[sqlite3.Connection]:
        with self._errors(), contextlib.closing(self._connect()) as connection:
            connection.execute(begin)
            try:
                yield connection
            except BaseException:
                connection.execute("ROLLBACK")
                raise
            connection.execute("COMMIT")

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, timeout=self.wait, isolation_level=None)
        connection.row_factory = sqlite3.Row
        # A finished run is on the disk, also after a power failure.
        connection.execute("PRAGMA synchronous=FULL")
        return connection

    def _is_ours(self, connection: sqlite3.Connection) -> bool:
        """Whether the tables are there; refuses what is not ours to write to."""
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        tables = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if application == 0 and version == 0 and tables == 0:
            return False
        if application != APPLICATION_ID:
            raise InputError(f"{self.path}: an SQLite database of another program; choose another folder")
        if version > SCHEMA_VERSION:
            raise InputError(
                f"{self.path}: a store of version {version}, written by a newer gridreg; expected at most "
                f"{SCHEMA_VERSION}; upgrade gridreg to use it"
            )
        return True

    def _set_journal(self, connection: sqlite3.Connection) -> str:
        kind = network_file_system(self.path.parent)
        wanted = "DELETE" if kind else "WAL"
        mode = connection.execute("PRAGMA journal_mode").fetchone()[0]
        if mode.upper() != wanted:
            mode = self._patiently(connection, f"PRAGMA journal_mode={wanted}")
        if kind:
            return (
                f"{self.path.parent}: a network file system ({kind}), where SQLite's write-ahead log does not work; "
                "using a rollback journal, which relies on the locks of that file system"
            )
        if mode.upper() != wanted:
            return f"{self.path.parent}: this file system has no write-ahead log for SQLite; using journal {mode}"
        return ""

    def _patiently(self, connection: sqlite3.Connection, statement: str) -> str:
        """One value from a statement for which SQLite itself does not wait while another process writes."""
        end = time.monotonic() + self.wait
        while True:
            try:
                return str(connection.execute(statement).fetchone()[0])
            except sqlite3.OperationalError as error:
                if "locked" not in str(error) or time.monotonic() > end:
                    raise
                time.sleep(0.02)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            text = str(error)
            raise InputError(f"{self.path}: {self._reason(text.lower(), text)}") from error

    def _reason(self, lower: str, text: str) -> str:
        if "locked" in lower or "busy" in lower:
            return f"locked by another process for more than {self.wait:.0f} s; wait for it, or end it"
        if "readonly" in lower or "read-only" in lower:
            return "the store is read-only; expected one that you may write to"
        if "not a database" in lower or "malformed" in lower or "corrupt" in lower:
            return (
                "the database is corrupt and was left as it is; move it away, and the same command takes the finished "
                "runs in runs/ over into a new one"
            )
        if "unable to open" in lower:
            return "cannot open the database; expected a folder that you may write to"
        if "full" in lower:
            return "no space left on the disk; free some"
        return f"the database cannot be used: {text}"


def network_file_system(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    """The kind of network file system that a folder is on, such as ``nfs4``; empty if it is local or not known."""
    try:
        lines = mounts.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    place, best, kind = folder.resolve(), -1, ""
    for line in lines:
        parts = line.split()
        if len(parts) < 3:
            continue
        mount = Path(parts[1].replace("\\040", " "))
        if (mount == place or mount in place.parents) and len(mount.parts) >= best:
            best, kind = len(mount.parts), parts[2]
    return kind if kind in _NETWORK else ""
