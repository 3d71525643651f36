"""What determines a run, and what does not."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridreg.ablation import records
from gridreg.ablation.records import RunResult, RunSpec
from gridreg.errors import InputError
from tests.ablation_runs import spec, study_of

CONFIG = {
    "preset": "quick",
    "scene": "here/lego",
    "seed": 0,
    "composition": [{"name": "L1", "weight": 1e-4}],
    "train": {"steps": 100, "checkpoint_minutes": 2.0},
}


def run(**changes):
    return spec(scene="here/lego", protocol="dietnerf8", config=CONFIG, **changes)


@pytest.mark.parametrize(
    "other",
    [
        run(label="another name"),
        replace(run(), scene="/elsewhere/lego", config={**CONFIG, "scene": "/elsewhere/lego"}),
        replace(run(), preset="mine", config={**CONFIG, "preset": "mine"}),
        replace(run(), config={**CONFIG, "train": {"steps": 100, "checkpoint_minutes": 9.0}}),
        replace(run(), config=dict(reversed(CONFIG.items()))),
        replace(run(), config={**CONFIG, "train": {**CONFIG["train"], "reshuffle": False, "patches": 1}}),
    ],
)
def test_what_changes_nothing_is_not_in_the_hash(other):
    assert other.hash == run().hash


@pytest.mark.parametrize(
    "other",
    [
        run(seed=1),
        replace(run(), scene="here/chair"),
        replace(run(), scene=None),
        replace(run(), protocol="gs8"),
        replace(run(), backbone="cp"),
        replace(run(), size=100),
        replace(run(), test=(0,)),
        replace(run(), test=()),
        replace(run(), config={**CONFIG, "composition": [{"name": "L1", "weight": 2e-4}]}),
        replace(run(), config={**CONFIG, "train": {"steps": 101, "checkpoint_minutes": 2.0}}),
        replace(run(), config={**CONFIG, "train": {**CONFIG["train"], "reshuffle": True}}),
        replace(run(), config={**CONFIG, "train": {**CONFIG["train"], "patches": 2}}),
    ],
)
def test_what_determines_the_result_is_in_the_hash(other):
    assert other.hash != run().hash


def test_a_fraction_and_a_step_are_two_things():
    """``until: 1`` is a step, ``until: 1.0`` the end of the run."""
    one = replace(run(), config={**CONFIG, "composition": [{"name": "FrequencyMask", "until": 1}]})
    two = replace(run(), config={**CONFIG, "composition": [{"name": "FrequencyMask", "until": 1.0}]})
    assert one.hash != two.hash


def test_other_numerics_make_other_hashes(monkeypatch):
    before = run().hash
    monkeypatch.setattr(records, "NUMERICS_VERSION", records.NUMERICS_VERSION + 1)
    assert run().hash != before


def test_the_hash_is_the_same_in_another_process():
    code = "from tests.ablation_runs import spec; print(spec('x', 3).hash)"
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
    )
    assert found.stdout.strip() == spec("x", 3).hash


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.dictionaries(st.text(max_size=8), plain, max_size=4),
    st.none() | st.lists(st.integers(0, 9), max_size=3),
)
def test_plain_data_and_back(config, test):
    one = spec(config=config, test=None if test is None else tuple(test))
    two = RunSpec.from_json(one.to_json())
    assert two == one
    assert two.hash == one.hash
    assert len(one.hash) == 16
    assert int(one.hash, 16) >= 0


def test_plain_data_of_something_else_are_refused():
    with pytest.raises(InputError, match="run: scene: missing, expected text or null"):
        RunSpec.from_json({"label": "x"})


def test_names():
    assert run().scene_name == "lego"
    assert spec().scene_name == "builtin"
    assert run(label="a").describe() == "a | lego | dietnerf8 | quick vm | seed 0"


def test_rows_that_share_a_run():
    study = study_of(spec("a"), replace(spec("a"), label="b"), spec("a", seed=1))
    assert study.labels == ("a", "b")
    assert len({run.hash for run in study.runs}) == 2


def test_history(tmp_path):
    result = RunResult(spec(), "done", None, "", tmp_path, 0.0, "")
    assert result.history() == []
    (tmp_path / "history.jsonl").write_text('{"step": 1, "psnr": 9.5}\n\n{"step": 2}\n')
    assert result.history() == [{"step": 1, "psnr": 9.5}, {"step": 2}]
    (tmp_path / "history.jsonl").write_text("{")
    with pytest.raises(InputError, match=r"history\.jsonl:1: not a row"):
        result.history()


def test_importing_ablation_imports_nothing_heavy():
    code = (
        "import sys, gridreg.ablation\n"
        "print([m for m in ('ray', 'pyarrow', 'matplotlib', 'tyro', 'gridreg.training') if m in sys.modules])\n"
        "from gridreg.ablation import Store, load_study, InProcess, Processes\n"
        "print([m for m in ('ray', 'pyarrow') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split("\n")[:2] == ["[]", "[]"]


def test_an_unknown_name_is_no_attribute():
    import gridreg.ablation

    with pytest.raises(AttributeError, match="no attribute 'Shop'"):
        _ = gridreg.ablation.Shop
    assert all(hasattr(gridreg.ablation, name) for name in gridreg.ablation.__all__)
