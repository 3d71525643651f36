"""`gridreg tune`: the race, what it takes and what it leaves, and the command on the built-in scene."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from gridreg.ablation.racing import ADDITIONS, START, Gain, candidates, chosen, race
from gridreg.cli.main import main
from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene
from gridreg.scenes.protocols import get_protocol

TV = {"name": "TotalVariation", "site": "density", "weight": 0.01}
L1 = {"name": "L1", "site": "density", "weight": 1e-4}


class Trials:
    """Trials with known effects by label, noise by view that all rows share, and a count."""

    def __init__(self, effects: dict[str, float], noise: float = 0.0) -> None:
        self.effects, self.noise = effects, noise
        self.done: list[tuple[str, int]] = []

    def __call__(self, rows, views):
        self.done += [(label, view) for label in rows for view in views]
        rng = np.random.default_rng(0)
        of_view = rng.normal(25, 3, size=64)
        own = {label: np.random.default_rng(len(label)).normal(0, self.noise, size=64) for label in rows}
        return {
            (label, view): of_view[view] + self.effects.get(label, 0.0) + own[label][view]
            for label in rows
            for view in views
        }


def everything(trials: int) -> int:
    return trials


def test_weights_are_varied_and_what_is_missing_is_added() -> None:
    found = candidates([TV, L1])
    assert found["L1 x 4"] == [TV, {**L1, "weight": 4e-4}]
    assert found["L1 left out"] == [TV]
    assert {label.split()[0] for label in found if label.endswith("added")} == {a["name"] for a in ADDITIONS}


def test_a_weight_with_a_schedule_is_only_left_out() -> None:
    scheduled = {**L1, "weight": {"schedule": "linear"}}
    assert [label for label in candidates([scheduled]) if label.startswith("L1")] == ["L1 left out"]


def test_what_gains_is_taken() -> None:
    outcome = race([TV, L1], 6, Trials({"L1 x 4": 0.5, "TotalVariation left out": -2.0}), everything)
    assert outcome.winner is not None
    assert outcome.winner.label == "L1 x 4"
    assert outcome.winner.mean == pytest.approx(0.5)
    assert outcome.composition == [TV, {**L1, "weight": 4e-4}]


def test_winners_of_two_classes_are_tried_together() -> None:
    both = "TotalVariation x 4 and L1 x 4"
    effects = {"L1 x 4": 0.5, "TotalVariation x 4": 0.4, both: 0.8}
    outcome = race([TV, L1], 5, Trials(effects), everything)
    assert outcome.winner is not None
    assert outcome.winner.label == both
    assert outcome.composition == [{**TV, "weight": 0.04}, {**L1, "weight": 4e-4}]


def test_two_that_do_not_add_up_leave_the_better_one() -> None:
    effects = {"L1 x 4": 0.5, "TotalVariation x 4": 0.4, "TotalVariation x 4 and L1 x 4": -1.0}
    outcome = race([TV, L1], 5, Trials(effects), everything)
    assert outcome.winner is not None
    assert outcome.winner.label == "L1 x 4"


def test_no_gain_leaves_the_composition() -> None:
    outcome = race([TV, L1], 8, Trials({}), everything)
    assert outcome.winner is None
    assert outcome.composition == [TV, L1]


def test_who_is_behind_is_dropped() -> None:
    trials = Trials({"L1 x 4": 0.5, "TotalVariation left out": -2.0})
    race([TV, L1], 8, trials, everything)
    assert [view for label, view in trials.done if label == "TotalVariation left out"] == [0, 1]
    assert [view for label, view in trials.done if label == START] == list(range(8))
    assert len(trials.done) < 8 * len(candidates([TV, L1])) / 2


def test_a_budget_that_ends_before_three_views_takes_nothing() -> None:
    outcome = race([TV, L1], 8, Trials({"L1 x 4": 5.0}), lambda trials: 0)
    assert outcome.winner is None
    assert outcome.composition == [TV, L1]


def test_a_small_budget_goes_to_those_ahead() -> None:
    trials = Trials({"L1 x 4": 0.5})
    outcome = race([TV, L1], 4, trials, lambda n: min(n, 7))
    assert outcome.winner is not None
    assert outcome.winner.label == "L1 x 4"


def test_the_standard_error_is_that_of_the_mean() -> None:
    gain = Gain("x", (1.0, 2.0, 3.0))
    assert (gain.mean, gain.error) == (2.0, pytest.approx(1 / math.sqrt(3)))
    assert chosen([gain, Gain("noisy", (9.0, -9.0, 1.0))]) is gain
    assert chosen([Gain("two", (1.0, 1.0))]) is None


def test_one_training_view_is_left_out_and_scored(tmp_path: Path) -> None:
    folder = builtin_scene(tmp_path, size=40)
    whole, left = load_scene(folder, "builtin8"), load_scene(folder, "builtin8-leave2")
    assert left.test.names == (whole.train.names[2],)
    assert left.train.names == whole.train.names[:2] + whole.train.names[3:]
    assert left.fingerprint != whole.fingerprint
    with pytest.raises(InputError, match="found 8 training views, expected at least 9"):
        load_scene(folder, "builtin8-leave8")


@pytest.mark.parametrize("name", ["dietnerf8-validation-leave1", "dietnerf8-leave1-validation", "x-leave1"])
def test_a_view_is_left_out_of_a_protocol_alone(name: str) -> None:
    with pytest.raises(InputError, match="expected one of"):
        get_protocol(name)


def test_the_command_races_and_writes_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scene, out = builtin_scene(tmp_path, size=40), tmp_path / "tuned"
    words = [
        "tune",
        "--scene",
        str(scene),
        "--out",
        str(out),
        "--steps",
        "2",
        "--runner",
        "local",
        "--minutes",
        "1e-3",
    ]
    words += ["--set", "composition=tensorf", "train.voxels_end=4096", "train.voxels_start=4096"]
    words += ["train.occupancy_resolution=16", "train.rays=64"]
    assert main(words) == 0
    shown = capsys.readouterr()
    assert "the preset stays: --minutes 0.001 did not reach 3 views" in shown.out
    tuned = yaml.safe_load((out / "tuned.yaml").read_text())
    assert tuned["train"]["steps"] == 1200
    assert tuned["protocol"] == "builtin8"
    assert [r["name"] for r in tuned["composition"]] == ["L1"]
    # The same command goes on from there: what is done is not done again.
    assert main(words) == 0
    assert "builtin8-leave0" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--minutes", "0"], "--minutes: found 0.0, expected a positive number"),
        (["--views", "2"], "--views: found 2, expected at least 3"),
        (["--protocol", "first2"], "has 2 training views, expected more than 3"),
        (["--preset", "qick"], "expected one of"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    scene = builtin_scene(tmp_path, size=40)
    assert main(["tune", "--scene", str(scene), "--out", str(tmp_path / "out"), *words]) == 2
    line = capsys.readouterr().err
    assert said in line
    assert len(line.splitlines()) == 1
