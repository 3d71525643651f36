"""Sums of tasks, and small gradients rounded at random."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gridreg.ops.cpu.reductions import reduce_sum, round_stochastically
from tests.kernel_grids import threads


def values(count: int, seed: int = 0) -> torch.Tensor:
    """Of both signs, over six orders of magnitude."""
    generator = torch.Generator().manual_seed(seed)
    sizes = 10.0 ** (6 * torch.rand(count, generator=generator) - 9)
    return sizes * torch.where(torch.rand(count, generator=generator) < 0.5, -1.0, 1.0)


@given(parts=st.integers(1, 17), rows=st.integers(0, 40), columns=st.integers(1, 40))
def test_fold_is_the_sum_over_the_first_axis(parts, rows, columns):
    x = torch.randn(parts, rows, columns, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(reduce_sum(x), x.sum(0), rtol=1e-5, atol=1e-5)


def test_fold_takes_vectors():
    assert reduce_sum(torch.ones(16, 5)).tolist() == [16.0] * 5


@pytest.mark.parametrize("share", [0.01, 0.1, 1.0])
def test_what_is_not_small_stays_and_the_rest_is_nothing_or_the_floor(share):
    x = values(100_000)
    floor = share * float(x.abs().double().mean())
    found = round_stochastically(x.clone(), share)
    large = x.abs() > floor * (1 + 1e-6)
    assert torch.equal(found[large], x[large])
    small = found[x.abs() < floor * (1 - 1e-6)]
    assert 0 < float((small == 0).float().mean()) < 1
    torch.testing.assert_close(small[small != 0].abs(), torch.full_like(small[small != 0], floor))
    # A sign never turns.
    assert bool((found * x >= 0).all())


def test_sums_of_any_part_stay_within_chance():
    x = values(400_000)
    found, floor = round_stochastically(x.clone(), 0.1).double(), 0.1 * float(x.abs().double().mean())
    exact = x.double()
    small = exact.abs() < floor
    for part in (slice(None), slice(0, None, 2), slice(0, 50_000), slice(150_000, 170_000)):
        # Variance of one draw: size (floor - size).
        spread = (exact[part].abs() * (floor - exact[part].abs()))[small[part]].sum().sqrt()
        assert abs(float(found[part].sum() - exact[part].sum())) < 5 * float(spread)


def test_equal_values_are_drawn_apart():
    x = torch.full((10_000,), 1e-3)
    x[0] = 1e3
    share = float((round_stochastically(x.clone(), 0.1)[1:] != 0).float().mean())
    # Mean size 0.101, floor 0.0101: kept with probability 0.099; standard error 0.003.
    assert share == pytest.approx(0.099, abs=0.015)


def test_the_same_for_any_number_of_threads_and_in_any_run():
    found = []
    for count in (1, 2, 2):
        with threads(count):
            found.append(round_stochastically(values(50_000), 0.1))
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_nothing_happens_without_a_share_or_without_values():
    x = values(1000)
    assert torch.equal(round_stochastically(x.clone(), 0.0), x)
    assert round_stochastically(torch.empty(0), 0.5).shape == (0,)
    assert round_stochastically(torch.zeros(5), 0.5).tolist() == [0.0] * 5


def test_not_a_number_is_seen():
    x = values(1000)
    x[3] = float("nan")
    assert bool(round_stochastically(x, 0.1).isnan().any())
