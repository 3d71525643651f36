"""Schedules: their values, their ends, and what they refuse."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from gridreg.schedules import (
    SCHEDULES,
    Cosine,
    Geometric,
    Linear,
    Piecewise,
    Schedule,
    check_numeric,
    check_until,
    end_step,
    fixed_end,
    register_schedule,
    resolve,
)

RAMPS = st.sampled_from([Linear, Cosine, Geometric])
POSITIVE = st.floats(1e-6, 1e3)


@given(RAMPS, POSITIVE, POSITIVE, st.integers(1, 300), st.integers(1, 200), st.data())
def test_ramps_stay_between_their_ends_and_reach_them_exactly(
    cls: Any, start: float, end: float, total_steps: int, until: int, data: st.DataObject
) -> None:
    ramp = cls(start, end, until=until)
    assert ramp.at(0, total_steps) == pytest.approx(start)
    assert ramp.at(until, total_steps) == end
    assert ramp.at(until + 5, total_steps) == end
    first, second = sorted(data.draw(st.tuples(st.integers(0, until), st.integers(0, until))))
    low, high = sorted((start, end))
    values = [ramp.at(step, total_steps) for step in (first, second)]
    assert all(low * (1 - 1e-9) <= value <= high * (1 + 1e-9) for value in values)
    assert (values[1] - values[0]) * (end - start) >= -1e-9 * high * high


@pytest.mark.parametrize(
    ("schedule", "step", "expected"),
    [
        (Linear(0.0, 1.0, until=0.5), 25, 0.5),
        (Linear(2.0, 4.0, begin=0.2, until=0.4), 30, 3.0),
        (Linear(2.0, 4.0, begin=0.2, until=0.4), 10, 2.0),
        (Cosine(1.0, 0.0, until=100), 50, 0.5),
        (Cosine(0.0, 1.0), 25, (1 - math.cos(math.pi / 4)) / 2),
        (Geometric(400.0, 0.25, until=100), 50, 10.0),
        (Piecewise((3.0, 2.0, 1.0), (0.1, 60)), 9, 3.0),
        (Piecewise((3.0, 2.0, 1.0), (0.1, 60)), 10, 2.0),
        (Piecewise((3.0, 2.0, 1.0), (0.1, 60)), 60, 1.0),
    ],
)
def test_values_by_hand(schedule: Schedule, step: int, expected: float) -> None:
    assert schedule.at(step, 100) == pytest.approx(expected)


def test_a_begin_after_the_end_is_a_jump() -> None:
    late = Linear(1.0, 2.0, begin=50, until=50)
    assert [late.at(step, 100) for step in (49, 50)] == [1.0, 2.0]


@given(st.integers(1, 100_000), st.integers(1, 1000))
def test_a_fraction_ends_at_the_step_that_it_names(total_steps: int, thousandths: int) -> None:
    end = end_step(thousandths / 1000, 0, total_steps)
    assert end == max(1, -(-thousandths * total_steps // 1000))


def test_rounding_does_not_make_an_end_one_step_late() -> None:
    assert end_step(0.07, 0, 100) == 7  # 0.07 * 100 is 7.000000000000001
    assert end_step(Linear(0.5, 1.0), 50, 100) == 75
    assert fixed_end(0.5, 10) == 5
    assert fixed_end(Linear(0.5, 1.0), 10) is None
    assert fixed_end(lambda step: 0.5, 10) is None


@pytest.mark.parametrize("until", [0, -3, 0.0, -0.5, 1.5, 9000.0])
def test_ends_out_of_range_are_refused(until: float) -> None:
    with pytest.raises(gridreg.InputError, match="until="):
        end_step(until, 0, 100)
    with pytest.raises(gridreg.InputError, match="every="):
        check_until(until, "every")


def test_resolve_takes_numbers_schedules_and_callables() -> None:
    assert resolve(3, 5, 10) == 3.0
    assert resolve(Linear(0, 10), 5, 10) == 5.0
    assert resolve(lambda step: step**2, 5, 10) == 25.0


@pytest.mark.parametrize("value", [math.nan, math.inf, lambda step: math.nan, lambda step: "much", None])
def test_resolve_refuses_what_is_no_finite_number(value: Any) -> None:
    with pytest.raises(gridreg.InputError, match="weight="):
        resolve(value, 1, 10, "weight")


@pytest.mark.parametrize("value", [-1, math.nan, math.inf, "1", None, True, int])
def test_check_numeric_names_argument_value_and_range(value: Any) -> None:
    with pytest.raises(gridreg.InputError, match=r"weight=.*expected a number in \[0, inf\]"):
        check_numeric("weight", value, low=0)


def test_check_numeric_leaves_schedules_and_callables_for_later() -> None:
    check_numeric("weight", Linear(-1, 1), low=0)
    check_numeric("weight", lambda step: -1, low=0)
    check_numeric("weight", 0.5, 0, 1)


def test_bad_schedules_are_refused() -> None:
    with pytest.raises(gridreg.InputError, match="start=0"):
        Geometric(0.0, 1.0)
    with pytest.raises(gridreg.InputError, match="one value more"):
        Piecewise((1.0, 2.0), (1, 2))
    with pytest.raises(TypeError, match="does not define at"):
        Schedule().at(0, 1)


def test_lists_become_tuples_so_that_schedules_hash() -> None:
    assert hash(Piecewise([1.0, 2.0], [5])) == hash(Piecewise((1.0, 2.0), (5,)))  # type: ignore[arg-type]


def test_a_schedule_of_ones_own_can_be_registered() -> None:
    @register_schedule
    class Always(Schedule):
        def at(self, step: int, total_steps: int) -> float:
            return 7.0

    assert SCHEDULES.pop("Always") is Always
    assert resolve(Always(), 0, 1) == 7
