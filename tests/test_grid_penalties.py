"""Total variation, L1 and orthogonality: against NumPy, against the closed forms, on any layout of a grid."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from gridreg.attach.selectors import parameters
from gridreg.attach.sites import Grid
from gridreg.base import Clock, Context, LocalTerm
from gridreg.errors import InputError
from gridreg.regularizers.grids import L1, Orthogonality, l1, orthogonality
from gridreg.regularizers.total_variation import TotalVariation, total_variation
from tests import oracles

CONTEXT = Context(Clock(100, seed=0))


def grid(*shape: int, dim: int, spatial: tuple[int, ...], seed: int = 0, **more: Any) -> Grid:
    values = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return Grid(f"grid{seed}", values, dim, spatial, **more)


def by_closed_form(term: LocalTerm) -> Tensor:
    """What the closed form says, one neighbour pair after another."""
    p = term.parameter
    if term.kind == "l1":
        return term.scale * p.abs().sum() / p.numel()
    parts = []
    for axis in term.spatial:
        slices = p.unbind(axis)
        parts.append(sum(((b - a) ** 2).sum() for a, b in pairwise(slices)) / (p.numel() / p.shape[axis]))
        parts[-1] = parts[-1] / (p.shape[axis] - 1)
    return term.scale * torch.stack(parts).sum()


class TestTotalVariation:
    @given(st.lists(st.integers(1, 5), min_size=1, max_size=4), st.integers(0, 99), st.data())
    def test_matches_numpy(self, shape: list[int], seed: int, data: st.DataObject) -> None:
        axes = data.draw(st.sets(st.sampled_from(range(len(shape)))))
        values = np.random.default_rng(seed).normal(size=shape)
        found = total_variation(torch.tensor(values), tuple(axes))
        np.testing.assert_allclose(found, oracles.total_variation(values, axes), rtol=1e-9, atol=1e-12)

    def test_twice_it_is_the_loss_of_the_tensorf_program(self) -> None:
        x = np.random.default_rng(0).normal(size=(1, 4, 5, 6))
        tall, wide = np.diff(x, axis=2) ** 2, np.diff(x, axis=3) ** 2
        program = 2 * (tall.sum() / tall[0].size + wide.sum() / wide[0].size) / 1
        assert 2 * total_variation(torch.tensor(x), (2, 3)).item() == pytest.approx(program)

    def test_adds_over_grids_of_any_layout(self) -> None:
        grids = [
            grid(1, 4, 5, 6, dim=1, spatial=(2, 3)),
            grid(5, 4, dim=1, spatial=(0,), seed=1),
            grid(3, 4, 5, 2, dim=3, spatial=(0, 1, 2), seed=2),
        ]
        expected = sum(oracles.total_variation(g.parameter.numpy(), set(g.spatial)) for g in grids)
        assert TotalVariation("density").grid_penalty(grids, CONTEXT).item() == pytest.approx(expected)

    def test_a_constant_grid_costs_nothing(self) -> None:
        assert total_variation(torch.full((3, 4, 5), 7.0), (0, 1)) == 0

    def test_gradcheck(self) -> None:
        values = torch.randn(2, 3, 4, dtype=torch.float64, requires_grad=True)
        assert gradcheck(lambda x: total_variation(x, (1, 2)), (values,))

    def test_every_third_iteration_three_times_as_strongly(self) -> None:
        grids = [grid(4, 5, 2, dim=2, spatial=(0, 1)), grid(5, 2, dim=1, spatial=(0,), seed=1)]
        always, rarely = TotalVariation("density"), TotalVariation("density", every=3)
        once = always.grid_penalty(grids, CONTEXT)
        for step, factor in enumerate([3, 0, 0, 3, 0, 0]):
            context = Context(Clock(100, seed=0))
            context.clock.step = step
            torch.testing.assert_close(rarely.grid_penalty(grids, context), factor * once)
            terms = rarely.local_terms(grids, context)
            assert [term.scale for term in terms] == ([3, 3] if factor else [])

    @pytest.mark.parametrize("every", [0, -1, 1.5, True])
    def test_iterations_are_counted_from_one(self, every: Any) -> None:
        with pytest.raises(
            InputError, match=r"TotalVariation: found every=.*, expected an integer of at lea"
        ):
            TotalVariation("density", every=every)

    def test_a_grid_without_neighbours_is_an_error(self) -> None:
        with pytest.raises(InputError, match=r"TotalVariation: grid0 of shape \(4, 1\) has no spatial axis"):
            TotalVariation("density").grid_penalty([grid(4, 1, dim=0, spatial=(1,))], CONTEXT)


class TestL1:
    def test_adds_means_over_grids(self) -> None:
        grids = [grid(2, 5, dim=0, spatial=(1,)), grid(3, 4, 2, dim=2, spatial=(0, 1), seed=1)]
        expected = sum(np.abs(g.parameter.numpy()).mean() for g in grids)
        assert L1("density").grid_penalty(grids, CONTEXT).item() == pytest.approx(expected)

    def test_gradcheck(self) -> None:
        values = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
        assert gradcheck(l1, (values,))


class TestOrthogonality:
    @given(st.integers(1, 6), st.integers(1, 7), st.integers(0, 99))
    def test_matches_numpy(self, channels: int, nodes: int, seed: int) -> None:
        lines = np.random.default_rng(seed).normal(size=(channels, nodes))
        found = orthogonality(torch.tensor(lines))
        np.testing.assert_allclose(found, oracles.orthogonality(lines), rtol=1e-9, atol=1e-12)

    def test_takes_lines_in_any_layout_and_leaves_planes_alone(self) -> None:
        first = grid(1, 4, 7, 1, dim=1, spatial=(2,))
        last = grid(7, 4, dim=1, spatial=(0,), seed=1)
        plane = grid(1, 4, 7, 5, dim=1, spatial=(2, 3), seed=2)
        found = Orthogonality("density").grid_penalty([first, plane, last], CONTEXT)
        expected = oracles.orthogonality(first.parameter[0, :, :, 0].numpy())
        expected += oracles.orthogonality(last.parameter.numpy().T)
        assert found.item() == pytest.approx(expected)

    def test_gradcheck_and_a_single_channel(self) -> None:
        values = torch.randn(3, 5, dtype=torch.float64, requires_grad=True)
        assert gradcheck(orthogonality, (values,))
        single = torch.randn(1, 5, requires_grad=True)
        (gradient,) = torch.autograd.grad(orthogonality(single), single)
        assert (gradient == 0).all()

    def test_a_site_without_lines_takes_its_planes(self) -> None:
        plane = grid(3, 4, 2, dim=2, spatial=(0, 1))
        found = Orthogonality("density").grid_penalty([plane], CONTEXT)
        rows = plane.parameter.numpy().reshape(12, 2).T
        assert found.item() == pytest.approx(oracles.orthogonality(rows))


@pytest.mark.parametrize("regularizer", [TotalVariation("density"), L1("density")])
def test_closed_forms_equal_the_penalty_in_value_and_gradient(regularizer: TotalVariation | L1) -> None:
    grids = [
        grid(1, 3, 6, 1, dim=1, spatial=(2, 3)),
        grid(4, 5, 3, dim=2, spatial=(0, 1), seed=1),
    ]
    for g in grids:
        g.parameter.requires_grad_()
    terms = regularizer.local_terms(grids, CONTEXT)
    assert [term.parameter for term in terms] == [g.parameter for g in grids]
    folded = torch.stack([by_closed_form(term) for term in terms]).sum()
    plain = regularizer.grid_penalty(grids, CONTEXT)
    torch.testing.assert_close(folded, plain)
    leaves = [g.parameter for g in grids]
    torch.testing.assert_close(torch.autograd.grad(folded, leaves), torch.autograd.grad(plain, leaves))


@pytest.mark.parametrize("regularizer", [TotalVariation("density"), L1("density")])
def test_only_channels_that_take_part_are_penalised(regularizer: TotalVariation | L1) -> None:
    some = grid(4, 5, dim=0, spatial=(1,), selected=(1, 3))
    alone = Grid("alone", some.parameter[[1, 3]], 0, (1,))
    assert regularizer.grid_penalty([some], CONTEXT) == regularizer.grid_penalty([alone], CONTEXT)
    assert regularizer.local_terms([some], CONTEXT) == []


@pytest.mark.parametrize("cls", [TotalVariation, L1, Orthogonality])
def test_bad_arguments(cls: Any) -> None:
    with pytest.raises(InputError, match=r"weight=-0\.1"):
        cls("density", weight=-0.1)
    with pytest.raises(InputError, match="site=3"):
        cls(3)
    assert cls(parameters("grid", dim=0)).sites() == (parameters("grid", dim=0),)
