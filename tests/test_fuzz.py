"""A quick pass over damaged inputs of all formats; ``benchmarks/fuzz.py`` is the long one."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from gridreg.errors import InputError
from tests.fuzz import formats_of_runs as runs
from tests.fuzz.corpus import CORPUS, load
from tests.fuzz.formats import BLENDER, COLMAP, IMAGES, TRANSFORMS, Input, scene
from tests.fuzz.formats_of_runs import inputs
from tests.fuzz.judge import judge


@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(inputs())
def test_every_input_is_refused_in_one_line_or_sound(item: Input) -> None:
    with tempfile.TemporaryDirectory() as folder:
        # Other programs may hold the processor: the campaign measures seconds, this pass looks for hangs.
        verdict = judge(item, Path(folder), seconds=20.0)
    assert verdict.outcome != "failed", f"{item.kind}: {verdict.said}"


@pytest.mark.parametrize("kind", ["transforms", "blender", "colmap"])
def test_the_inputs_are_sound_before_they_are_damaged(kind: str, tmp_path: Path) -> None:
    import json

    files = {
        "transforms": {"transforms.json": json.dumps(TRANSFORMS).encode()},
        "blender": {f"transforms_{split}.json": json.dumps(BLENDER).encode() for split in ("train", "test")},
        "colmap": {f"sparse/0/{name}.txt": text.encode() for name, text in COLMAP.items()},
    }[kind]
    assert judge(Input(kind, {**IMAGES, **files}, scene), tmp_path, seconds=20.0).outcome == "accepted"


@pytest.mark.parametrize("path", sorted(CORPUS.iterdir()), ids=lambda path: path.stem)
def test_what_failed_once_is_refused_or_sound(path: Path, tmp_path: Path) -> None:
    verdict = judge(load(path), tmp_path, seconds=20.0)
    assert verdict.outcome != "failed", verdict.said


def test_files_of_runs_are_sound_before_they_are_damaged(tmp_path: Path) -> None:
    texts = {
        "configuration.yaml": (runs.CONFIGURATION, runs.read_configuration),
        "study.yaml": (runs.STUDY, runs.load_study),
        "table.csv": (runs.TABLE, runs.read_table),
        "history.jsonl": (runs.HISTORY, runs.read_history),
    }
    for name, (text, read) in texts.items():
        item = Input(name, {name: text.encode()}, lambda folder, read=read, name=name: read(folder / name))
        assert judge(item, tmp_path, seconds=20.0).outcome == "accepted", name
    for read in (runs.loaded, runs.resumed):
        assert judge(Input("run", runs.small_run()[2], read), tmp_path, seconds=20.0).outcome == "accepted"
    store = Input("store", {"store.sqlite": runs.small_store()}, runs.changed_store)
    assert judge(store, tmp_path / "store", seconds=20.0).outcome == "accepted"


def test_the_judge_sees_faults(tmp_path: Path) -> None:
    def endless(folder: Path) -> None:
        raise KeyError(folder)

    def loud(folder: Path) -> None:
        warnings.warn("look at this", stacklevel=1)

    def two_lines(folder: Path) -> None:
        error = InputError("it is wrong here")
        error.args = ("one line\nand another",)
        raise error

    def large(folder: Path) -> None:
        bytearray(400_000_000)[::4096] = b"x" * len(range(0, 400_000_000, 4096))

    for read in (endless, loud, two_lines, large):
        assert judge(Input("a", {}, read), tmp_path, seconds=20.0).outcome == "failed", read
