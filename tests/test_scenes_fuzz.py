"""Damaged files of every kind: readers either load them or refuse them in one line, never anything else."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene

SIZE = 16
quick = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
oddities = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.floats(), max_size=5),
    st.lists(st.lists(st.floats(), max_size=4), max_size=4),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy for these tests alone: they damage it and repair it."""
    source = builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)
    return Path(shutil.copytree(source, tmp_path_factory.mktemp("fuzz") / "scene"))


@pytest.fixture(scope="module")
def own(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a COLMAP model in text form."""
    folder = tmp_path_factory.mktemp("fuzz") / "own"
    shutil.copytree(scene / "train", folder / "images")
    (folder / "sparse").mkdir()
    (folder / "sparse/cameras.txt").write_text("1 SIMPLE_RADIAL 16 16 22 8 8 0.01\n")
    (folder / "sparse/images.txt").write_text(
        "".join(f"{k} 1 0.0{k} 0 0 0.{k} 0 4 1 r_{k}.png\n1.0 2.0 -1\n" for k in range(4))
    )
    (folder / "sparse/points3D.txt").write_text("".join(f"{k} 0.{k} 0 0.1 9 9 9 0.5 1 2\n" for k in range(9)))
    return folder


def loads_or_refuses(folder: Path, protocol: str, **options: Any) -> None:
    said = ""
    try:
        scene = load_scene(folder, protocol, **options)
    except InputError as error:
        said = str(error)
    if said:
        assert "\n" not in said
        assert len(said) > 10
        return
    assert bool(np.isfinite(scene.train.poses.numpy()).all())
    assert bool((scene.train.intrinsics[:, :2] > 0).all())
    assert scene.train.rgba.shape[0] == len(scene.train.names)


def places(value: Any) -> list[tuple[Any, ...]]:
    """The path of every node of a JSON value, to two of its frames at most."""
    found: list[tuple[Any, ...]] = [()]
    items = (
        value.items() if isinstance(value, dict) else enumerate(value[:4]) if isinstance(value, list) else ()
    )
    for key, inner in items:
        found += [(key, *rest) for rest in places(inner)]
    return found


@quick
@given(st.data(), oddities)
def test_any_value_of_the_frame_list(scene: Path, data: st.DataObject, oddity: Any) -> None:
    path = scene / "transforms_train.json"
    text = path.read_text()
    content = json.loads(text)
    place = data.draw(st.sampled_from(places(content)[1:]))
    changed = copy.deepcopy(content)
    node = changed
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = oddity
    path.write_text(json.dumps(changed))
    try:
        loads_or_refuses(scene, "first2", test=[])
    finally:
        path.write_text(text)


@quick
@given(
    st.dictionaries(
        st.sampled_from(["fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "camera_model"]), oddities
    )
)
def test_any_intrinsics(scene: Path, intrinsics: dict[str, Any]) -> None:
    path = scene / "transforms_train.json"
    text = path.read_text()
    path.write_text(json.dumps({**json.loads(text), **intrinsics}))
    try:
        loads_or_refuses(scene, "first2", test=[])
    finally:
        path.write_text(text)


@quick
@given(st.text(max_size=30))
def test_any_file_path(scene: Path, file_path: str) -> None:
    path = scene / "transforms_train.json"
    text = path.read_text()
    content = json.loads(text)
    content["frames"][0]["file_path"] = file_path
    path.write_text(json.dumps(content))
    try:
        with pytest.raises(InputError):
            load_scene(scene, "first2", test=[])
    finally:
        path.write_text(text)


@quick
@given(st.data())
def test_any_byte_of_an_image(scene: Path, data: st.DataObject) -> None:
    path = scene / "train/r_0.png"
    original = path.read_bytes()
    cut = data.draw(st.integers(0, len(original)))
    spoiled = bytearray(original[:cut] if data.draw(st.booleans()) else original)
    for place in data.draw(st.lists(st.integers(0, max(len(spoiled) - 1, 0)), max_size=4)):
        if place < len(spoiled):
            spoiled[place] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(spoiled))
    try:
        loads_or_refuses(scene, "first2", test=[])
    finally:
        path.write_bytes(original)


@quick
@given(st.sampled_from(["cameras", "images", "points3D"]), st.data())
def test_any_word_of_a_colmap_model(own: Path, name: str, data: st.DataObject) -> None:
    path = own / f"sparse/{name}.txt"
    text = path.read_text()
    words = text.split(" ")
    place = data.draw(st.integers(0, len(words) - 1))
    words[place] = data.draw(st.one_of(st.text(max_size=6), st.floats().map(str), st.integers().map(str)))
    path.write_text(" ".join(words), encoding="utf-8")
    try:
        loads_or_refuses(own, "holdout8")
    finally:
        path.write_text(text)


@quick
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_as_a_colmap_model(own: Path, content: bytes, front: bool) -> None:
    binary = own / "sparse/images.bin"
    binary.write_bytes((4).to_bytes(8, "little") + content if front else content)
    (own / "sparse/cameras.bin").write_bytes((0).to_bytes(8, "little"))
    (own / "sparse/points3D.bin").write_bytes((0).to_bytes(8, "little"))
    try:
        with pytest.raises(InputError):
            load_scene(own, "holdout8")
    finally:
        for name in ("images", "cameras", "points3D"):
            (own / f"sparse/{name}.bin").unlink()


@quick
@given(st.binary(max_size=300))
def test_any_bytes_as_poses_and_bounds(own: Path, content: bytes) -> None:
    path = own / "poses_bounds.npy"
    path.write_bytes(b"\x93NUMPY" + content)
    try:
        with pytest.raises(InputError):
            load_scene(own, "holdout8")
    finally:
        path.unlink()
