"""Tensors that hold several grids, tables without neighbours, and grids without elements."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import gridreg
from tests import oracles

VALUES = torch.randn(3, 8, 16, 1, generator=torch.Generator().manual_seed(3))


class Stacked(nn.Module):
    """Three lines in one tensor, as in nerfstudio's encodings."""

    def __init__(self, value: Tensor = VALUES) -> None:
        super().__init__()
        self.lines = nn.Parameter(value.clone())

    def forward(self) -> Tensor:
        """The product of the three lines at their nodes: ``(C, M)``."""
        return self.lines.prod(dim=0)[..., 0]


class Listed(nn.Module):
    """The same lines in a list of tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.lines = nn.ParameterList([nn.Parameter(value[None].clone()) for value in VALUES])


def loss(field: nn.Module, regularizer: gridreg.Regularizer) -> float:
    with gridreg.apply(field, regularizer, total_steps=10) as handle:
        return handle.loss().item()


PENALTIES = [gridreg.Orthogonality, gridreg.L1, gridreg.TotalVariation]


@pytest.mark.parametrize("make", PENALTIES)
def test_a_stack_costs_what_its_grids_cost_in_a_list(make: Callable[..., gridreg.Regularizer]) -> None:
    listed = loss(Listed(), make(gridreg.parameters("lines.*", dim=1), weight=1.0))
    stacked = loss(Stacked(), make(gridreg.parameters("lines", dim=1, stack=0), weight=1.0))
    assert stacked == pytest.approx(listed)


@pytest.mark.parametrize("make", PENALTIES)
def test_one_grid_of_a_stack(make: Callable[..., gridreg.Regularizer]) -> None:
    one = loss(Stacked(), make(gridreg.parameters("lines", dim=1, stack=0, item=2), weight=1.0))
    alone = loss(Stacked(VALUES[2:]), make(gridreg.parameters("lines", dim=1), weight=1.0))
    assert one == pytest.approx(alone)


def test_orthogonality_compares_channels_within_a_grid_even_where_nobody_named_the_stack() -> None:
    found = loss(Stacked(), gridreg.Orthogonality(gridreg.parameters("lines", dim=1), weight=1.0))
    assert found == pytest.approx(sum(oracles.orthogonality(v[..., 0].numpy()) for v in VALUES))


def test_a_stack_whose_axis_is_the_last() -> None:
    field = Stacked(VALUES[..., 0].permute(1, 2, 0))
    penalty = gridreg.TotalVariation(gridreg.parameters("lines", dim=0, stack=-1), weight=1.0)
    assert loss(field, penalty) == pytest.approx(
        sum(oracles.total_variation(v[..., 0].numpy(), {1}) for v in VALUES)
    )


def test_a_stack_has_no_closed_form() -> None:
    site = gridreg.parameters("lines", dim=1, stack=0)
    with gridreg.apply(Stacked(), gridreg.L1(site), gridreg.TotalVariation(site), total_steps=10) as handle:
        assert handle.grid_terms() == []


def test_a_mask_on_one_factor_enters_a_product_once() -> None:
    field = Stacked()
    bare = field()
    site = gridreg.parameters("lines", dim=1, stack=0, item=1)
    with gridreg.apply(field, gridreg.FrequencyMask(site, until=10), total_steps=10) as handle:
        handle.step(3)
        mask = gridreg.frequency_mask(8, 3, 10)
        assert mask.max() > 0
        assert ((mask > 0) & (mask < 1)).any()
        torch.testing.assert_close(field(), bare * mask[:, None])
        assert gridreg.open_channels(field, "lines") is None
        field().sum().backward()
    assert (field.lines.grad[1, mask == 0] == 0).all()  # type: ignore[index]
    assert torch.equal(field(), bare)


def test_a_mask_on_a_stack_acts_on_all_its_grids() -> None:
    field = Stacked()
    site = gridreg.parameters("lines", dim=1, stack=0)
    with gridreg.apply(field, gridreg.FixedMask(site, visible_ratio=0.5), total_steps=10):
        assert torch.equal(field.lines, VALUES * gridreg.fixed_mask(8, 0.5)[:, None, None])


def test_a_low_pass_of_one_grid_of_a_stack() -> None:
    field = Stacked()
    site = gridreg.parameters("lines", dim=1, stack=0, item=0, channels=[1, 2])
    with gridreg.apply(field, gridreg.FourierLowPass(site, keep=0.3), total_steps=10):
        found = field.lines.detach()
    expected = VALUES.clone()
    expected[0, 1:3] = gridreg.fourier_low_pass(VALUES[0, 1:3], (1,), 0.3)
    torch.testing.assert_close(found, expected)
    assert torch.equal(found[1:], VALUES[1:])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stack": 4}, r"stack=4 of .*shape \(3, 8, 16, 1\); expected another axis"),
        ({"stack": 1}, "stack=1 of .*expected another axis"),
        ({"stack": 0, "spatial": (0, 2)}, "stack=0 of .*expected another axis"),
        ({"stack": 0, "item": 3}, "item=3 of .*lines holds 3 grids, from 0"),
        ({"item": 0}, r"item=0\): expected the axis of the grids as well, stack="),
        ({"stack": "0"}, "stack='0'"),
    ],
)
def test_what_is_no_stack_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(gridreg.InputError, match=message):
        loss(Stacked(), gridreg.L1(gridreg.parameters("lines", dim=1, **arguments)))  # type: ignore[arg-type]


def test_a_stack_goes_to_plain_data_and_back() -> None:
    penalty = gridreg.L1(gridreg.parameters("lines", dim=1, stack=0, item=2))
    (plain,) = gridreg.to_config([penalty])
    assert plain["site"] == {"parameters": "lines", "dim": 1, "stack": 0, "item": 2}
    assert gridreg.from_config([plain]) == [penalty]


class Tables(nn.Module):
    """A hash table of one level, and linked cells."""

    def __init__(self) -> None:
        super().__init__()
        self.level = nn.Embedding(64, 2)
        self.cells = nn.Parameter(torch.randn(50, 9))
        self.levels = nn.Parameter(torch.randn(2, 5000, 2))


@pytest.mark.parametrize("name", ["level.weight", "cells", "levels"])
@pytest.mark.parametrize(
    "make", [gridreg.TotalVariation, gridreg.FourierLowPass, gridreg.GridBlur], ids=lambda c: c.__name__
)
def test_neighbours_in_memory_are_not_taken_for_neighbours_in_space(
    make: Callable[..., gridreg.Regularizer], name: str
) -> None:
    with pytest.raises(gridreg.InputError, match=r"in a table, .*name its axes with spatial="):
        gridreg.apply(Tables(), make(gridreg.parameters(name, dim=-1)), total_steps=10).loss()
    axis = 1 if name == "levels" else 0
    site = gridreg.parameters(name, dim=-1, spatial=(axis,))
    with gridreg.apply(Tables(), make(site), total_steps=10) as handle:
        assert handle.loss().isfinite()


def test_a_table_still_has_values_and_channels() -> None:
    site = gridreg.parameters("cells", dim=-1)
    field = Tables()
    rows = field.cells.detach().T.numpy()
    assert loss(field, gridreg.L1(site, weight=1.0)) == pytest.approx(abs(rows).mean())
    assert loss(field, gridreg.Orthogonality(site, weight=1.0)) == pytest.approx(oracles.orthogonality(rows))


class Empty(nn.Module):
    """A grid without channels, as DVGO makes it, beside one with."""

    def __init__(self) -> None:
        super().__init__()
        self.k0 = nn.Parameter(torch.zeros(1, 0, 4, 4, 4))
        self.density = nn.Parameter(torch.randn(1, 1, 4, 4, 4))


@pytest.mark.parametrize("make", [*PENALTIES, gridreg.FourierLowPass, gridreg.GridBlur])
def test_no_elements_cost_nothing(make: Callable[..., gridreg.Regularizer]) -> None:
    field = Empty()
    with gridreg.apply(field, make(gridreg.parameters("k0", dim=1)), total_steps=10) as handle:
        total = handle.loss()
        assert total.item() == 0
        (total + field.k0.sum()).backward()
    assert field.k0.grad is not None
    both = loss(field, gridreg.L1(gridreg.parameters("*", dim=1), weight=1.0))
    assert both == pytest.approx(field.density.detach().abs().mean().item())


@pytest.mark.parametrize(
    "make",
    [
        gridreg.FrequencyMask,
        gridreg.FixedMask,
        gridreg.CosineMask,
        gridreg.LevelMask,
        gridreg.ViewDependenceMask,
        gridreg.ComponentDropout,
    ],
)
def test_a_mask_over_no_channels_leaves_the_grid_as_it_is(make: Callable[..., gridreg.Regularizer]) -> None:
    field = Empty()
    with gridreg.apply(field, make(gridreg.parameters("k0", dim=1)), total_steps=10) as handle:
        for step in (0, 4, 10):
            handle.step(step)
            assert field.k0.shape == (1, 0, 4, 4, 4)
            assert all(value == value for value in handle.values().values())
