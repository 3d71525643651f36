"""Checkpoints: exact, whole after a death at any moment, and honest about what is wrong with them."""

from __future__ import annotations

import json
import math
import os
import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import SafetensorError
from torch import Tensor

from gridreg.errors import InputError
from gridreg.training import checkpoint
from gridreg.training.checkpoint import FORMAT_VERSION, has_checkpoint, load_checkpoint, save_checkpoint
from gridreg.training.state_tree import flatten_state, unflatten_state

DTYPES = [
    torch.float64,
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.int16,
    torch.int8,
    torch.uint8,
    torch.bool,
]


def same(a: Any, b: Any) -> bool:
    """Equal bit for bit, types included (NaN equals itself, 0.0 differs from -0.0)."""
    if type(a) is not type(b):
        return False
    if isinstance(a, Tensor):
        if a.dtype != b.dtype or a.shape != b.shape:
            return False
        return (
            a.contiguous().reshape(-1).view(torch.uint8).equal(b.contiguous().reshape(-1).view(torch.uint8))
        )
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b) or (math.isnan(a) and math.isnan(b))
    return bool(a == b)


@st.composite
def tensors(draw: st.DrawFn) -> Tensor:
    """A tensor of any type and small shape, with random bits, sometimes transposed or empty."""
    dtype = draw(st.sampled_from(DTYPES))
    shape = draw(st.lists(st.integers(0, 3), max_size=3))
    count = math.prod(shape)
    raw = draw(st.binary(min_size=count * dtype.itemsize, max_size=count * dtype.itemsize))
    if dtype == torch.bool:
        raw = bytes(byte & 1 for byte in raw)
    if count == 0:
        return torch.zeros(shape, dtype=dtype)
    tensor = torch.frombuffer(bytearray(raw), dtype=dtype).reshape(shape)
    return tensor.transpose(0, -1) if shape and draw(st.booleans()) else tensor


leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["$tensor", "\udcff"])
    | tensors()
)
keys = st.text(max_size=6) | st.sampled_from(["$tensor", "$", "a.b", "a"]) | st.integers(-5, 5)
states = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(keys, inner, max_size=4)
    ),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(state=states)
def test_state_survives_flattening_json_and_safetensors(state):
    flat, tree = flatten_state(state)
    flat = safetensors.torch.load(safetensors.torch.save(flat))
    tree = json.loads(json.dumps(tree, allow_nan=False))
    assert same(unflatten_state(flat, tree), state)


@settings(max_examples=25, deadline=None)
@given(state=states)
def test_state_survives_a_checkpoint(tmp_path_factory, state):
    folder = tmp_path_factory.getbasetemp() / "property_checkpoint"
    save_checkpoint(folder, state, config={"lr": 8e-5, "until": math.inf}, fingerprint="abc")
    loaded = load_checkpoint(folder, fingerprint="abc")
    assert same(loaded.state, state)
    assert loaded.config == {"lr": 8e-5, "until": math.inf}
    assert loaded.fingerprint == "abc"
    assert sorted(p.name for p in folder.iterdir()) == ["state.json", "tensors.safetensors"]
    assert not any(p.name.startswith(".property") for p in folder.parent.iterdir())


def test_names_are_readable_and_do_not_collide():
    flat, _ = flatten_state(
        {"field": {"lines": [torch.zeros(1), torch.ones(1)]}, "field.lines": {0: torch.ones(2)}}
    )
    assert list(flat) == ["field.lines.0", "field.lines.1", "field.lines.0~2"]


def test_tensors_are_not_copied_and_shared_memory_is_written_out():
    base = torch.arange(6.0)
    flat, _ = flatten_state({"a": base, "b": base[1:3], "c": base.view(2, 3).T, "d": base.view(6)})
    assert flat["a"].data_ptr() == base.data_ptr()
    assert len({x.data_ptr() for x in flat.values()}) == 4
    assert flat["a"].tolist() == [0, 1, 2, 3, 4, 5]
    assert flat["b"].tolist() == [1, 2]
    assert flat["c"].is_contiguous()
    assert len(safetensors.torch.load(safetensors.torch.save(flat))) == 4


def test_numpy_arrays_and_numbers():
    array = np.arange(6, dtype=np.int16).reshape(2, 3)[:, ::-1]
    flat, tree = flatten_state({"array": array, "number": np.float32(0.1), "count": np.int64(3)})
    back = unflatten_state(flat, json.loads(json.dumps(tree)))
    assert same(back["array"], np.ascontiguousarray(array))
    assert same(back["number"], float(np.float32(0.1)))
    assert same(back["count"], 3)


@pytest.mark.parametrize(
    ("state", "named"),
    [
        ({"a": [1, {2, 3}]}, "a.1 is set"),
        ({"g": torch.Generator()}, "g is Generator"),
        ({(1, 2): 3}, "it is dict"),
        ({"a": {True: 1}}, "a is dict"),
        ({"a": np.array([object()])}, "a is ndarray"),
        ({"f": len}, "f is builtin_function"),
    ],
)
def test_what_cannot_be_saved_is_the_programmers_error(tmp_path, state, named):
    save_checkpoint(tmp_path / "checkpoint", {"old": 1})
    with pytest.raises(TypeError, match=named):
        save_checkpoint(tmp_path / "checkpoint", state)
    assert load_checkpoint(tmp_path / "checkpoint").state == {"old": 1}


def test_training_goes_on_bit_for_bit(tmp_path):
    """Adam, its parameters and the random state, saved half-way and continued in fresh objects."""

    def make() -> tuple[torch.nn.Module, torch.optim.Optimizer, torch.Generator]:
        torch.manual_seed(0)
        model = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1))
        optimizer = torch.optim.Adam(model.parameters(), lr=0.02, betas=(0.9, 0.99))
        return model, optimizer, torch.Generator().manual_seed(7)

    def train(model: Any, optimizer: Any, generator: Any, steps: int) -> None:
        for _ in range(steps):
            loss = model(torch.rand(16, 4, generator=generator)).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    straight = make()
    train(*straight, 10)
    model, optimizer, generator = make()
    train(model, optimizer, generator, 5)
    state = {"model": model.state_dict(), "adam": optimizer.state_dict(), "generator": generator.get_state()}
    save_checkpoint(tmp_path / "checkpoint", state)
    loaded = load_checkpoint(tmp_path / "checkpoint").state
    assert same(loaded["adam"], optimizer.state_dict())
    torch.manual_seed(99)
    model, optimizer, generator = make()
    model.load_state_dict(loaded["model"])
    optimizer.load_state_dict(loaded["adam"])
    generator.set_state(loaded["generator"])
    train(model, optimizer, generator, 5)
    assert same(dict(model.state_dict()), dict(straight[0].state_dict()))
    assert same(optimizer.state_dict(), straight[1].state_dict())


# ---- dying


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_death_at_every_operation_and_kills_at_random_moments(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(Path(__file__).with_name("die_while_saving.py")), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    operations, found_new, kills = map(int, re.findall(r"\d+", done.stdout))
    assert operations >= 10
    assert found_new >= 2
    assert kills == 12


def test_a_death_during_the_very_first_save_leaves_no_checkpoint(tmp_path):
    folder = tmp_path / "checkpoint"
    (tmp_path / ".checkpoint.new").mkdir()
    (tmp_path / ".checkpoint.new" / "tensors.safetensors").write_bytes(b"half")
    assert not has_checkpoint(folder)
    with pytest.raises(InputError, match="no checkpoint here"):
        load_checkpoint(folder)
    save_checkpoint(folder, {"step": 1})
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint"]


def test_a_half_written_new_one_does_not_hide_the_old_one(tmp_path):
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, {"step": 1})
    folder.rename(tmp_path / ".checkpoint.old")
    (tmp_path / ".checkpoint.new").mkdir()
    assert has_checkpoint(folder)
    assert load_checkpoint(folder).state == {"step": 1}
    save_checkpoint(folder, {"step": 2})
    assert load_checkpoint(folder).state == {"step": 2}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint"]


# ---- a disk that refuses


FULL = OSError(28, "No space left on device")
# As the library says it, which writes past Python.
FULL_FOR_TENSORS = SafetensorError(
    "Error while serializing: I/O error: No space left on device (os error 28)"
)


@pytest.mark.parametrize(
    ("owner", "operation", "error"),
    [(safetensors.torch, "save_file", FULL_FOR_TENSORS), (checkpoint, "write_json", FULL)],
)
def test_a_full_disk_keeps_the_old_checkpoint(tmp_path, monkeypatch, owner, operation, error):
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, {"step": 1})

    def full(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(owner, operation, full)
    with pytest.raises(InputError, match="checkpoint: cannot write here: no space left") as caught:
        save_checkpoint(folder, {"step": 2})
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    assert load_checkpoint(folder).state == {"step": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint"]


def test_both_files_have_the_usual_permissions(tmp_path):
    save_checkpoint(tmp_path / "checkpoint", {"x": torch.ones(2)})
    (tmp_path / "other").touch()
    expected = (tmp_path / "other").stat().st_mode
    assert {path.stat().st_mode for path in (tmp_path / "checkpoint").iterdir()} == {expected}


def test_a_missing_parent_folder(tmp_path):
    with pytest.raises(InputError, match="cannot write here: No such file"):
        save_checkpoint(tmp_path / "none" / "checkpoint", {})


def test_what_is_no_checkpoint_is_not_replaced(tmp_path):
    theirs = tmp_path / "checkpoint"
    theirs.mkdir()
    save_checkpoint(theirs, {"an empty folder": "may be used"})
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="stands already and is no checkpoint"):
        save_checkpoint(tmp_path / "photos", {})
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="a file stands where a folder is expected"):
        save_checkpoint(tmp_path / "file", {})
    assert (tmp_path / "photos" / "me.jpg").read_bytes() == b"x"
    assert (tmp_path / "file").read_text() == "x"


def test_the_present_folder_can_be_named_by_a_dot(tmp_path, monkeypatch):
    save_checkpoint(tmp_path / "checkpoint", {"step": 3})
    monkeypatch.chdir(tmp_path / "checkpoint")
    assert load_checkpoint(".").state == {"step": 3}


# ---- damage


def cut(name: str, keep: float) -> Any:
    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * keep)])

    return change


def flip(name: str, place: float) -> Any:
    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[int(len(data) * place)] ^= 1
        (folder / name).write_bytes(bytes(data))

    return change


def replaced(text: bytes) -> Any:
    return lambda folder: (folder / "state.json").write_bytes(text)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (cut("tensors.safetensors", 0.5), "damaged checkpoint: tensors.safetensors has"),
        (cut("tensors.safetensors", 0), "damaged checkpoint: tensors.safetensors has 0 bytes, expected"),
        (flip("tensors.safetensors", 0.9), "damaged checkpoint: the checksum of tensors.safetensors"),
        (cut("state.json", 0.5), "damaged checkpoint: state.json is cut off or not JSON"),
        (cut("state.json", 0), "damaged checkpoint: state.json is cut off or not JSON"),
        (lambda f: (f / "state.json").unlink(), "damaged checkpoint: state.json is missing"),
        (
            lambda f: (f / "tensors.safetensors").unlink(),
            "damaged checkpoint: tensors.safetensors is missing",
        ),
        (replaced(b'{"a": 1}'), "state.json is not that of a gridreg checkpoint"),
        (replaced(b"[1]"), "state.json is not that of a gridreg checkpoint"),
        (replaced(b"\xff\xfe"), "state.json is cut off or not JSON"),
        (replaced(b"[" * 100_000), "state.json is cut off or not JSON"),
    ],
)
def test_damage_is_one_clear_line(tmp_path, damage, expected):
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, {"x": torch.ones(1000), "step": 3}, fingerprint="f")
    damage(folder)
    with pytest.raises(InputError) as caught:
        load_checkpoint(folder)
    text = str(caught.value)
    assert str(folder) in text
    assert expected in text
    assert "\n" not in text


def test_a_changed_figure_in_the_json_is_noticed(tmp_path):
    save_checkpoint(tmp_path / "c", {"step": 300})
    path = tmp_path / "c" / "state.json"
    path.write_text(path.read_text().replace('"step": 300', '"step": 301'))
    with pytest.raises(InputError, match=r"the checksum of state\.json does not fit"):
        load_checkpoint(tmp_path / "c")


def test_every_flipped_byte_is_noticed(tmp_path):
    """Anywhere in either file; white space between the JSON's parts alone may change unseen."""
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, {"x": torch.ones(3)})
    for name in ("state.json", "tensors.safetensors"):
        original = (folder / name).read_bytes()
        for place in range(0, len(original), 7):
            if chr(original[place]).isspace():
                continue
            flip(name, (place + 0.5) / len(original))(folder)
            with pytest.raises(InputError):
                load_checkpoint(folder)
            (folder / name).write_bytes(original)
    assert load_checkpoint(folder).state["x"].tolist() == [1, 1, 1]


def test_a_newer_format_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT_VERSION", FORMAT_VERSION + 1)
    save_checkpoint(tmp_path / "c", {})
    monkeypatch.undo()
    with pytest.raises(
        InputError, match=f"checkpoint format {FORMAT_VERSION + 1}, written by a newer gridreg"
    ):
        load_checkpoint(tmp_path / "c")


def test_another_scene_is_refused_by_its_fingerprint(tmp_path):
    save_checkpoint(tmp_path / "c", {"step": 1}, fingerprint="lego" * 10)
    assert load_checkpoint(tmp_path / "c", fingerprint="lego" * 10).state == {"step": 1}
    assert load_checkpoint(tmp_path / "c").state == {"step": 1}
    with pytest.raises(
        InputError, match=r"of another scene \(fingerprint 'legolegolego', expected 'chairchair"
    ):
        load_checkpoint(tmp_path / "c", fingerprint="chair" * 10)


def test_a_tree_that_does_not_fit_its_tensors():
    with pytest.raises(ValueError, match="tensor 'x' is missing"):
        unflatten_state({}, {"$tensor": "x"})
    with pytest.raises(ValueError, match="unknown mark"):
        unflatten_state({}, {"$code": "x"})


def test_nothing_is_pickled(tmp_path):
    save_checkpoint(tmp_path / "c", {"x": torch.ones(3), "t": (1, 2)})
    for path in (tmp_path / "c").iterdir():
        data = path.read_bytes()
        assert b"\x80\x04" not in data
        assert not data.startswith(b"PK")
    header = (tmp_path / "c" / "tensors.safetensors").read_bytes()
    assert json.loads(header[8 : 8 + int.from_bytes(header[:8], "little")])["x"]["dtype"] == "F32"


def test_a_checkpoint_behind_a_link(tmp_path):
    """The link to a larger disk stays, and the checkpoint lies behind it."""
    (tmp_path / "large" / "run").mkdir(parents=True)
    link = tmp_path / "checkpoint"
    link.symlink_to(tmp_path / "large" / "run", target_is_directory=True)
    for step in range(3):
        save_checkpoint(link, {"step": step, "x": torch.ones(3)})
        assert load_checkpoint(link).state["step"] == step
    assert link.is_symlink()
    assert has_checkpoint(tmp_path / "large" / "run")
    assert [p.name for p in (tmp_path / "large").iterdir()] == ["run"]
