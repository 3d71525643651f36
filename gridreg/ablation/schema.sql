-- Tables of a store, version 1: who has which run, results of finished runs, studies and attempts.
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
