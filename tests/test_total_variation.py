"""Forms of total variation, random pairs, mean squares, and smoothness in time: against NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from gridreg.attach.sites import Grid
from gridreg.base import Clock, Context
from gridreg.regularizers.grids import L2, l2
from gridreg.regularizers.total_variation import (
    TimeSmoothness,
    TotalVariation,
    time_smoothness,
    total_variation,
)
from tests import oracles

CONTEXT = Context(Clock(100, seed=0))
shapes = st.lists(st.integers(1, 5), min_size=1, max_size=3)
seeds = st.integers(0, 99)
PLANE = Grid("plane", torch.randn(6, 7, 3, generator=torch.Generator().manual_seed(0)), 2, (0, 1))


@given(shapes, seeds, st.floats(0.1, 2.0), st.data())
def test_forms_match_numpy(shape: list[int], seed: int, delta: float, data: st.DataObject) -> None:
    axes = data.draw(st.sets(st.sampled_from(range(len(shape)))))
    values = np.random.default_rng(seed).normal(size=shape)
    forms: dict[str, Callable[[float], float]] = {
        "squared": lambda x: x**2,
        "absolute": abs,
        "huber": lambda x: oracles.huber(x, delta),
    }
    for form, oracle in forms.items():
        found = total_variation(torch.tensor(values), tuple(axes), form, delta=delta)  # type: ignore[arg-type]
        np.testing.assert_allclose(
            found, oracles.total_variation(values, axes, oracle), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("form", ["squared", "absolute", "huber"])
@pytest.mark.parametrize("share", [0.01, 0.5])
def test_random_pairs_give_the_whole_in_the_mean(form: str, share: float) -> None:
    generator = torch.Generator().manual_seed(1)
    draws = [
        total_variation(PLANE.values, (0, 1), form, delta=0.5, share=share, generator=generator)  # type: ignore[arg-type]
        for _ in range(3000)
    ]
    whole = total_variation(PLANE.values, (0, 1), form, delta=0.5)  # type: ignore[arg-type]
    spread = torch.stack(draws).std() / 3000**0.5
    assert abs(torch.stack(draws).mean() - whole) < 4 * spread
    assert spread > 0


def test_pairs_are_drawn_anew_at_each_step_and_alike_within_one() -> None:
    penalty = TotalVariation("density", share=0.3)
    found = []
    for step in (0, 0, 1):
        clock = Clock(10, seed=2)
        clock.step = step
        found.append(penalty.grid_penalty([PLANE], Context(clock)).item())
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize(
    ("penalty", "terms"),
    [
        (TotalVariation("x"), 1),
        (TotalVariation("x", form="huber"), 0),
        (TotalVariation("x", share=0.5), 0),
        (L2("x"), 1),
    ],
)
def test_only_what_has_a_closed_form_gives_one(penalty: Any, terms: int) -> None:
    assert len(penalty.local_terms([PLANE], CONTEXT)) == terms


@given(shapes, seeds, st.integers(0, 2))
def test_time_smoothness_matches_numpy(shape: list[int], seed: int, axis: int) -> None:
    axis %= len(shape)
    values = np.random.default_rng(seed).normal(size=shape)
    found = time_smoothness(torch.tensor(values), axis).item()
    np.testing.assert_allclose(found, oracles.time_smoothness(values, axis), rtol=1e-9, atol=1e-12)


def test_steady_motion_costs_nothing() -> None:
    steady = torch.arange(5.0)[:, None, None] * torch.randn(1, 4, 2)
    assert time_smoothness(steady, 0).item() == pytest.approx(0, abs=1e-10)
    assert total_variation(steady, (0,)).item() > 0


def test_time_is_one_of_the_spatial_axes() -> None:
    values = torch.randn(1, 3, 5, 6, generator=torch.Generator().manual_seed(4))
    plane = Grid("plane", values, 1, (2, 3))
    for axis, expected in ((0, 2), (1, 3), (-1, 3)):
        found = TimeSmoothness("x", axis=axis).grid_penalty([plane, plane], CONTEXT)
        torch.testing.assert_close(found, 2 * time_smoothness(values, expected))
    with pytest.raises(
        gridreg.InputError, match="axis=2: plane has 2 spatial axes, from 0; which one is time"
    ):
        TimeSmoothness("x", axis=2).grid_penalty([plane], CONTEXT)


@given(shapes, seeds)
def test_l2_is_the_mean_square(shape: list[int], seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=shape)
    np.testing.assert_allclose(l2(torch.tensor(values)), np.mean(values**2), rtol=1e-12)
    grids = [Grid("grid", torch.tensor(values), 0, ())] * 2
    np.testing.assert_allclose(L2("x").grid_penalty(grids, CONTEXT), 2 * np.mean(values**2), rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"form": "cubed"}, "form='cubed': expected 'squared', 'absolute' or 'huber'"),
        ({"share": 0.0}, "share=0: expected a number above 0"),
        ({"share": 1.5}, "share=1.5"),
        ({"delta": 0.0}, "delta=0"),
        ({"delta": -1.0}, "delta=-1"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(gridreg.InputError, match=message):
        TotalVariation("density", **arguments)
