"""A quick pass over damaged inputs of all formats; ``benchmarks/fuzz.py`` is the long one."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.formats import BLENDER, COLMAP, IMAGES, TRANSFORMS, Input, inputs, scene
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


def test_the_judge_sees_faults(tmp_path: Path) -> None:
    def endless(folder: Path) -> None:
        raise KeyError(folder)

    assert judge(Input("a", {}, endless), tmp_path).outcome == "failed"
