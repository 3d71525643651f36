"""Strategies of what runs and studies read: configurations, studies, tables, histories, checkpoints, stores."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import sqlite3
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from gridreg.ablation.claims import ClaimLostError
from gridreg.ablation.store import Store
from gridreg.ablation.study import load_study, study_from_text
from gridreg.ablation.table_report import read_table
from gridreg.ablation.workers import Worker
from gridreg.scenes import load_scene
from gridreg.training import RunConfig, load_run
from gridreg.training.config import from_yaml
from gridreg.training.curves import History
from gridreg.training.run import build_trainer, resume_trainer, save_run
from gridreg.training.typed_data import from_data, to_data
from tests.fuzz.formats import (
    IMAGES,
    NUMBERS,
    TRANSFORMS,
    Input,
    changed_bytes,
    changed_json,
    changed_words,
    images,
    scene_inputs,
)

__all__ = ["inputs", "small_run"]

CONFIGURATION = """preset: quick
protocol: dietnerf8
backbone: vm
seed: 1
size: 100
opaque: true
composition:
- {name: FrequencyMask, site: density, until: 0.9}
- {name: TotalVariation, site: density, weight: {name: Linear, start: 0.1, end: 0.0}}
field: {density_components: 4, density_shift: -10.0}
train:
  steps: 100
  rays: 64
  learning_rate_grid: 0.02
  resample_at: [10, 20]
  checkpoint_minutes: 5
  evaluate_at: [50]
  merge_weight: 0.1
"""
STUDY = """title: A study
name: small
scenes: [builtin]
seeds: [0, 1]
steps: 20
size: 40
test: [0, 9]
baseline: none
presets: [quick]
backbones: [vm]
protocols: [builtin8]
data: .
set: {train.rays: 64, train.resample_at: [5, 10]}
compositions:
- none
- {name: quick, remove: [FrequencyMask], label: b}
- {sweep: quick, key: train.rays, values: [32, 64]}
- {leave_one_out: quick, by: name}
- {label: own, regularizers: [{name: OcclusionLoss, weight: 0.01, samples: 20}]}
"""
TABLE = """label,scene,seed,psnr,ssim,seconds,status,image
none,lego,0,20.5,0.8,10,done,
none,lego,1,20.7,0.81,11,done,
quick,lego,0,21.5,0.85,12,done,
quick,lego,1,21.6,0.84,12,failed,
"""
HISTORY = (
    '{"step": 1, "loss": 0.5, "psnr": 12.0}\n{"step": 2, "loss": 0.4, "masks": {"density": [1.0, 0.5]}}\n'
)
STATE, TENSORS = "checkpoint/state.json", "checkpoint/tensors.safetensors"
SMALL = {
    "preset": "quick",
    "protocol": "holdout8",
    "field": {"density_components": 2, "appearance_components": 3},
    "train": {"steps": 10, "rays": 16, "voxels_start": 64, "voxels_end": 64},
}


def write(folder: Path, files: dict[str, bytes]) -> None:
    """Write files into a folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


@functools.cache
def small_run() -> tuple[RunConfig, Any, dict[str, bytes]]:
    """Return a configuration, its scene, and the files of a checkpoint of it."""
    config = from_data(RunConfig, SMALL, source="small")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, {**IMAGES, "transforms.json": json.dumps(TRANSFORMS).encode()})
        small = load_scene(folder, "holdout8")
        save_run(
            folder / "checkpoint",
            build_trainer(config, small),
            config,
            {"history": History().state_dict(), "seconds": {}},
        )
        files = {f"checkpoint/{path.name}": path.read_bytes() for path in (folder / "checkpoint").iterdir()}
    return config, small, files


def loaded(folder: Path) -> Any:
    """Load a checkpoint as `gridreg render` does."""
    return load_run(folder)


def resumed(folder: Path) -> Any:
    """Load a checkpoint as ``--resume`` does."""
    config, small, _ = small_run()
    return resume_trainer(folder / "checkpoint", config, small)[0]


def signed(content: dict[str, Any], tensors: bytes | None = None) -> bytes:
    """Return a ``state.json`` with right checksums, of these tensors if they are given."""
    if tensors is not None:
        digest = hashlib.sha256(tensors).hexdigest()
        content = {**content, "tensors": {"bytes": len(tensors), "sha256": digest}}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return json.dumps({**content, "sha256": hashlib.sha256(text.encode("ascii")).hexdigest()}).encode()


@st.composite
def checkpoints(draw: st.DrawFn) -> Input:
    """Draw a checkpoint: one with damaged bytes, or one of somebody's whose checksums are right."""
    files = dict(small_run()[2])
    read = draw(st.sampled_from([loaded, resumed]))
    how = draw(st.integers(0, 3))
    if how:
        content = json.loads(files[STATE])
        content.pop("sha256")
        if how == 1:
            start = draw(st.sampled_from([8, len(files[TENSORS]) - 4000]))
            files[TENSORS] = files[TENSORS][:start] + draw(changed_bytes(files[TENSORS][start:]))
        else:
            kept = {key: content[key] for key in ("config", "state", "tensors")}
            content |= json.loads(draw(changed_json(kept)))
        files[STATE] = signed(content, files[TENSORS] if how == 1 else None)
    else:
        name = draw(st.sampled_from([STATE, TENSORS]))
        files[name] = draw(changed_bytes(files[name]))
    return Input("checkpoint", files, read)


@functools.cache
def small_store() -> bytes:
    """Return the database of a store with two runs, one of them begun."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = study_from_text("compositions: [quick, none]", name="small")
        store = Store.open(folder)
        store.add(study)
        store.claim(Worker.current(), study)
        connection = sqlite3.connect(folder / "store.sqlite")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.close()
        return (folder / "store.sqlite").read_bytes()


def used_store(folder: Path) -> None:
    """Use a store as `gridreg ablate` does."""
    store = Store.open(folder, create=False, wait=0.2)
    store.studies(), store.results(), store.counts(), store.attempts()
    study = study_from_text("compositions: [quick, none]", name="small")
    store.add(study)
    claim = store.claim(Worker.current(), study)
    if claim is not None:
        store.beat(claim)
        store.mark_lost(claim, "it was killed")
    claim = store.claim(Worker.current(), study)
    if claim is not None:
        claim.folder.mkdir(parents=True)
        result = {"mean": {"psnr": 20.0}, "images": {}, "seconds": {"train": 1.0}}
        # What the worker is told where its run went to somebody else.
        with contextlib.suppress(ClaimLostError):
            store.finish(claim, result, fingerprint="a")
    store.retry()
    store.export(folder / "table.csv")


@st.composite
def stores(draw: st.DrawFn) -> Input:
    """Draw a store of which some bytes that are not 0 are others, or a row holds something else."""
    data = bytearray(small_store())
    used = [place for place, byte in enumerate(data) if byte]
    for _ in range(draw(st.integers(0, 3))):
        data[draw(st.sampled_from(used))] = draw(st.integers(0, 255))
    column = draw(
        st.sampled_from(
            [
                "runs.spec",
                "runs.metrics",
                "runs.worker",
                "runs.seconds",
                "runs.status",
                "runs.heartbeat",
                "studies.modules",
                "studies.source",
            ]
        )
    )
    text = draw(
        st.one_of(
            st.none(),
            NUMBERS.map(str),
            st.text("{}[]\"':,a0", max_size=9),
            st.just('{"mean": {"psnr": "x"}}'),
            st.just("done"),
        )
    )
    files = {"store.sqlite": bytes(data)}
    if draw(st.booleans()):
        files["change"] = json.dumps([column, text]).encode()
    return Input("store", files, changed_store)


def changed_store(folder: Path) -> None:
    """Put a value into a column, where one is to be changed, and use the store."""
    if (folder / "change").exists():
        column, text = json.loads((folder / "change").read_bytes())
        table, _, name = column.partition(".")
        connection = sqlite3.connect(folder / "store.sqlite")
        try:
            connection.execute(f"UPDATE {table} SET {name}=?", (text,))
            connection.commit()
        except (sqlite3.Error, UnicodeDecodeError):
            pass
        finally:
            connection.close()
    used_store(folder)


def _texts(kind: str, name: str, text: str, read: Any) -> st.SearchStrategy[Input]:
    changed = st.one_of(changed_words(text), changed_words(text), changed_bytes(text.encode()))
    return changed.map(lambda data: Input(kind, {name: data}, lambda folder: read(folder / name)))


def read_configuration(path: Path) -> dict[str, Any]:
    """Read a configuration as `gridreg train --config` does, and return it as plain data."""
    return {"config": to_data(from_yaml(path, RunConfig))}


def read_history(path: Path) -> Any:
    """Read the curves of a run."""
    return History.load(path).rows


def inputs() -> st.SearchStrategy[Input]:
    """Return a strategy over all formats."""
    formats = [
        *scene_inputs(),
        images(),
        checkpoints(),
        stores(),
        _texts("configuration", "a.yaml", CONFIGURATION, read_configuration),
        _texts("study", "a.yaml", STUDY, load_study),
        _texts("table", "a.csv", TABLE, read_table),
        _texts("history", "history.jsonl", HISTORY, read_history),
    ]
    # One format as often as another, whatever its strategy is made of.
    return st.integers(0, len(formats) - 1).flatmap(formats.__getitem__)
