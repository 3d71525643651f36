"""Intervals and paired differences against independent formulas, and the laws they obey."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gridreg.ablation.statistics import Cell, Estimate, estimate, holm, paired_differences
from gridreg.errors import InputError

decibels = st.floats(5, 45).map(lambda value: round(value, 4))


def cell(seed: int, scene: str = "lego", views: int = 8) -> Cell:
    return Cell(scene, "dietnerf8", views, seed, "quick", "vm")


@st.composite
def studies(draw: st.DrawFn) -> dict[str, dict[Cell, float]]:
    """Figures of three compositions, some runs missing."""
    cells = [cell(seed, scene) for scene in ("lego", "chair") for seed in range(4)]
    return {
        label: {c: draw(decibels) for c in cells if draw(st.integers(0, 9)) > 1}
        for label in ("none", "tv", "masks")
    }


def test_estimate_is_scipys_interval() -> None:
    sample = np.random.default_rng(0).normal(25, 2, size=7)
    low, high = stats.t.interval(0.95, len(sample) - 1, loc=sample.mean(), scale=stats.sem(sample))
    found = estimate(sample)
    assert found.count == 7
    assert (found.mean, found.low, found.high) == pytest.approx((sample.mean(), low, high), rel=1e-12)


@pytest.mark.parametrize(("count", "t"), [(2, 12.706), (3, 4.303), (5, 2.776), (10, 2.262), (31, 2.042)])
def test_width_follows_the_printed_table_of_t(count: int, t: float) -> None:
    sample = np.arange(count, dtype=float)
    expected = t * sample.std(ddof=1) / math.sqrt(count)
    assert estimate(sample).half_width == pytest.approx(expected, rel=1e-3)


def test_intervals_cover_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    samples = rng.normal(3.0, 1.5, size=(2000, 4))
    covered = np.mean([(e := estimate(sample, 0.8)).low <= 3.0 <= e.high for sample in samples])
    assert covered == pytest.approx(0.8, abs=0.03)


def test_one_value_has_no_interval() -> None:
    found = estimate([25.0])
    assert found == Estimate(25.0, None, 1)
    assert math.isnan(found.low)
    assert math.isnan(found.high)


@pytest.mark.parametrize("values", [[], [math.nan], [1.0, math.inf]])
def test_no_estimate_of_nothing_and_of_what_is_not_a_number(values: list[float]) -> None:
    with pytest.raises(InputError, match="expected at least one number, all finite"):
        estimate(values)


@pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0])
def test_confidence_is_a_probability(confidence: float) -> None:
    with pytest.raises(InputError, match=r"confidence=.*between 0 and 1"):
        estimate([1.0, 2.0], confidence)


@given(st.lists(decibels, min_size=2, max_size=12), st.floats(-20, 20))
def test_a_shift_moves_the_mean_and_leaves_the_width(values: list[float], shift: float) -> None:
    before, after = estimate(values), estimate([value + shift for value in values])
    assert after.mean == pytest.approx(before.mean + shift, abs=1e-9)
    assert after.half_width == pytest.approx(before.half_width, abs=1e-9)


@given(st.lists(decibels, min_size=1, max_size=12), st.randoms())
def test_the_order_of_values_does_not_matter(values: list[float], random) -> None:
    mixed = list(values)
    random.shuffle(mixed)
    assert estimate(mixed) == estimate(values)


@given(st.lists(decibels, min_size=2, max_size=12))
def test_more_confidence_is_wider(values: list[float]) -> None:
    narrow, wide = estimate(values, 0.8).half_width, estimate(values, 0.99).half_width
    assert narrow is not None
    assert wide is not None
    assert narrow <= wide


def test_differences_are_scipys_paired_test() -> None:
    rng = np.random.default_rng(2)
    scenes = [cell(seed, scene) for scene in ("lego", "chair", "ship") for seed in range(3)]
    level = {"lego": 25.0, "chair": 28.0, "ship": 20.0}
    base = np.array([level[c.scene] for c in scenes]) + rng.normal(0, 0.1, 9)
    other = base + rng.normal(0.3, 0.2, 9)
    values = {"b": dict(zip(scenes, base, strict=True)), "a": dict(zip(scenes, other, strict=True))}
    found = paired_differences(values, "b")["a"]
    reference = stats.ttest_rel(other, base)
    interval = reference.confidence_interval(0.95)
    assert found.estimate is not None
    assert (found.estimate.low, found.estimate.high) == pytest.approx((interval.low, interval.high), rel=1e-9)
    assert found.p_value == pytest.approx(reference.pvalue, rel=1e-9)
    # Unpaired, the scenes' levels would hide what the pairs show.
    assert found.verdict == "higher"
    assert stats.ttest_ind(other, base).pvalue > 0.5


def test_only_runs_that_share_everything_are_pairs() -> None:
    base = {cell(0): 25.0, cell(1): 25.5, cell(0, "chair"): 28.0}
    other = {cell(0): 26.0, cell(2): 30.0, cell(0, "chair", views=3): 22.0}
    found = paired_differences({"base": base, "other": other}, "base")["other"]
    assert dict(found.pairs) == {cell(0): 1.0}
    assert found.verdict == "one pair"
    assert found.p_value is None
    nothing = paired_differences({"base": base, "other": {cell(7): 1.0}}, "base")["other"]
    assert nothing.verdict == "no pair"
    assert nothing.estimate is None


@pytest.mark.parametrize(
    ("differences", "verdict"),
    [
        ([0.4, 0.5, 0.6], "higher"),
        ([-0.4, -0.5, -0.6], "lower"),
        ([-0.4, 0.5, 0.1], "within noise"),
        ([0.0, 0.0], "within noise"),
        ([5.0], "one pair"),
    ],
)
def test_verdict(differences: list[float], verdict: str) -> None:
    base = {cell(seed): 25.0 for seed in range(len(differences))}
    other = {cell(seed): 25.0 + value for seed, value in enumerate(differences)}
    assert paired_differences({"base": base, "other": other}, "base")["other"].verdict == verdict


def test_equal_numbers_are_no_difference_for_sure() -> None:
    values = {"base": {cell(0): 25.0, cell(1): 26.0}, "same": {cell(0): 25.0, cell(1): 26.0}}
    assert paired_differences(values, "base")["same"].p_value == 1.0
    values["up"] = {cell(0): 26.0, cell(1): 27.0}
    assert paired_differences(values, "base")["up"].p_value == 0.0


def test_baseline_must_be_there() -> None:
    with pytest.raises(InputError, match="baseline='x': expected one of 'a', 'b'"):
        paired_differences({"a": {}, "b": {}}, "x")


@given(studies())
def test_swapping_the_baseline_changes_the_sign(study: dict[str, dict[Cell, float]]) -> None:
    forward = paired_differences(study, "none")["tv"]
    back = paired_differences(study, "tv")["none"]
    assert dict(back.pairs) == {c: -value for c, value in forward.pairs.items()}
    assert back.p_value == forward.p_value
    opposite = {"higher": "lower", "lower": "higher"}
    assert back.verdict == opposite.get(forward.verdict, forward.verdict)
    if forward.estimate is not None and back.estimate is not None:
        assert back.estimate.mean == -forward.estimate.mean
        assert back.estimate.half_width == forward.estimate.half_width


@given(studies(), st.randoms())
def test_the_order_of_runs_does_not_matter(study: dict[str, dict[Cell, float]], random) -> None:
    mixed = {}
    for label, cells in study.items():
        items = list(cells.items())
        random.shuffle(items)
        mixed[label] = dict(items)
    assert paired_differences(mixed, "none") == paired_differences(study, "none")


@given(studies(), st.integers(-8, 8))
def test_a_harder_scene_does_not_matter(study: dict[str, dict[Cell, float]], shift: int) -> None:
    """Whatever a scene adds to all of its runs is gone in the pairs."""
    moved = {
        label: {c: value + shift * (c.scene == "chair") for c, value in cells.items()}
        for label, cells in study.items()
    }
    for label, before in paired_differences(study, "none").items():
        after = paired_differences(moved, "none")[label]
        assert list(after.pairs.values()) == pytest.approx(list(before.pairs.values()), abs=1e-9)


def test_holm_by_hand() -> None:
    # Holm 1979: 0.01 * 4, 0.02 * 3, 0.03 * 2 and 0.04 * 1, none below the one before.
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([]) == []
    assert holm([0.9, 0.8]) == [1.0, 1.0]


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_lies_between_the_plain_values_and_bonferroni(p_values: list[float]) -> None:
    for p, adjusted in zip(p_values, holm(p_values), strict=True):
        assert p <= adjusted <= min(1.0, len(p_values) * p) + 1e-15


@pytest.mark.parametrize("p", [-0.1, 1.1, math.nan])
def test_holm_refuses_what_is_no_probability(p: float) -> None:
    with pytest.raises(InputError, match="expected numbers from 0 to 1"):
        holm([0.5, p])
