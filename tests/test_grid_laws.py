"""Laws that every penalty and every low-pass on grids keeps, on lines, planes and voxels in any layout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

import gridreg
from gridreg.attach.sites import Grid, Place
from gridreg.base import REGISTRY, Clock, Context, Regularizer
from gridreg.regularizers.functions import GridFunction

CHANNELS = 3


@dataclass(frozen=True)
class Layout:
    """A kind of grid: its shape, channel axis and spatial axes."""

    name: str
    shape: tuple[int, ...]
    dim: int
    spatial: tuple[int, ...]

    def values(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(self.shape, generator=generator, dtype=torch.float64).to(dtype)

    def grid(self, values: Tensor) -> Grid:
        return Grid(self.name, values, self.dim, self.spatial)

    def context(self, regularizer: Regularizer, step: int) -> Context:
        clock = Clock(20, seed=0)
        clock.step = step
        site = gridreg.parameters(self.name, dim=self.dim, spatial=self.spatial)
        place = Place(self.name, site, self.dim, size=self.shape[self.dim], spatial=self.spatial)
        context = Context(clock, place)
        regularizer.prepare(context)
        return context


LAYOUTS = [
    Layout("line, channels last", (7, CHANNELS), 1, (0,)),
    Layout("line, channels first", (1, CHANNELS, 6, 1), 1, (2,)),
    Layout("plane, channels last", (5, 8, CHANNELS), 2, (0, 1)),
    Layout("plane, channels first", (1, CHANNELS, 4, 7), 1, (2, 3)),
    Layout("voxels", (1, CHANNELS, 4, 3, 5), 1, (2, 3, 4)),
    Layout("two nodes", (2, CHANNELS), 1, (0,)),
]


def examples(part: str, acts_on: str | None = None) -> list[Regularizer]:
    return [
        example
        for cls in REGISTRY.values()
        if gridreg.overrides(cls, part) and acts_on in (None, cls.acts_on)
        for example in cls.examples("density")
    ]


def penalty_of(penalty: Regularizer, *grids: Grid) -> Tensor:
    return penalty.grid_penalty(grids, Context(Clock(20, seed=0)))


def without_time(penalty: Regularizer, layout: Layout) -> bool:
    """Two moments have no second difference."""
    return isinstance(penalty, gridreg.TimeSmoothness) and layout.name == "two nodes"


each_penalty = pytest.mark.parametrize("penalty", examples("grid_penalty"), ids=repr)
each_filter = pytest.mark.parametrize("lowpass", examples("transform", "grids"), ids=repr)
each_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)


def test_all_of_the_catalogue_take_part() -> None:
    names = {type(e).__name__ for e in examples("grid_penalty")}
    assert names >= {"TotalVariation", "L1", "Orthogonality"}
    assert {type(e).__name__ for e in examples("transform", "grids")} >= {
        "FourierLowPass",
        "GridBlur",
    }


class TestPenalties:
    @each_penalty
    @each_layout
    def test_scalar_not_below_zero_and_zero_for_a_grid_of_zeros(
        self, penalty: Regularizer, layout: Layout
    ) -> None:
        for dtype in (torch.float32, torch.float64):
            value = penalty_of(penalty, layout.grid(layout.values(dtype=dtype)))
            assert value.shape == ()
            assert value.dtype == dtype
            assert value > 0 or without_time(penalty, layout)
        assert penalty_of(penalty, layout.grid(torch.zeros(layout.shape))) == 0

    @each_penalty
    @each_layout
    def test_the_order_and_the_axis_of_channels_do_not_matter(
        self, penalty: Regularizer, layout: Layout
    ) -> None:
        values = layout.values()
        expected = penalty_of(penalty, layout.grid(values))
        shuffled = values.index_select(layout.dim, torch.tensor([2, 0, 1]))
        torch.testing.assert_close(penalty_of(penalty, layout.grid(shuffled)), expected)
        first = values.movedim(layout.dim, 0).squeeze()
        moved = Grid("moved", first, 0, tuple(range(1, first.ndim)))
        torch.testing.assert_close(penalty_of(penalty, moved), expected)

    @each_penalty
    def test_it_adds_over_grids_of_one_kind(self, penalty: Regularizer) -> None:
        layout = LAYOUTS[0]
        grids = [layout.grid(layout.values(seed)) for seed in range(3)]
        parts = torch.stack([penalty_of(penalty, grid) for grid in grids])
        torch.testing.assert_close(penalty_of(penalty, *grids), parts.sum())

    @each_penalty
    @each_layout
    def test_descent_lowers_it_and_leaves_the_grid_alone_otherwise(
        self, penalty: Regularizer, layout: Layout
    ) -> None:
        values = layout.values().requires_grad_()
        before = values.detach().clone()
        value = penalty_of(penalty, layout.grid(values))
        (gradient,) = torch.autograd.grad(value, values)
        assert torch.equal(values, before)
        lower = penalty_of(penalty, layout.grid((values - 1e-3 * gradient).detach()))
        assert lower < value or without_time(penalty, layout)

    @each_penalty
    def test_the_handle_weighs_it_and_reads_the_raw_parameter(self, penalty: Regularizer) -> None:
        field = nn.Module()
        field.register_parameter("grid", nn.Parameter(LAYOUTS[2].values()))
        site = gridreg.parameters("grid", dim=2)
        kind: Any = partial(type(penalty), site=site)
        if isinstance(penalty, GridFunction):
            kind = partial(kind, function=penalty.function)
        composition = [kind(weight=gridreg.Linear(0, 2.0)), gridreg.FixedMask(site, visible_ratio=0.0)]
        with gridreg.apply(field, *composition, total_steps=10) as handle:
            handle.step(5)
            raw = next(iter(field.parameters()))
            expected = penalty_of(replace(kind(), weight=1.0), LAYOUTS[2].grid(raw))
            torch.testing.assert_close(handle.loss(), expected)
            (gradient,) = torch.autograd.grad(handle.loss(), raw)
            assert gradient.abs().sum() > 0


class TestLowPasses:
    @each_filter
    @each_layout
    @given(seed=st.integers(0, 100), step=st.integers(0, 25))
    def test_mean_energy_and_shape(self, lowpass: Regularizer, layout: Layout, seed: int, step: int) -> None:
        context, values = layout.context(lowpass, step), layout.values(seed)
        found = lowpass.transform(values, context)
        assert found.shape == values.shape
        assert found.dtype == values.dtype
        torch.testing.assert_close(found.mean(layout.spatial), values.mean(layout.spatial))
        assert found.square().sum() <= values.square().sum() + 1e-9
        constant = torch.full(layout.shape, 2.5, dtype=torch.float64)
        torch.testing.assert_close(lowpass.transform(constant, context), constant)
        if lowpass.is_identity(context):
            assert torch.equal(found, values)

    @each_filter
    @each_layout
    def test_linear_and_channel_by_channel(self, lowpass: Regularizer, layout: Layout) -> None:
        context, a, b = layout.context(lowpass, 1), layout.values(1), layout.values(2)
        together = lowpass.transform(2 * a - 3 * b, context)
        apart = 2 * lowpass.transform(a, context) - 3 * lowpass.transform(b, context)
        torch.testing.assert_close(together, apart)
        order = torch.tensor([1, 2, 0])
        shuffled = lowpass.transform(a.index_select(layout.dim, order), context)
        expected = lowpass.transform(a, context).index_select(layout.dim, order)
        torch.testing.assert_close(shuffled, expected)

    @each_filter
    def test_detail_returns_step_by_step(self, lowpass: Regularizer) -> None:
        layout = Layout("line", (40, CHANNELS), 1, (0,))
        values = layout.values()
        energies = []
        for step in range(26):
            context = layout.context(lowpass, step)
            energies.append(lowpass.transform(values, context).square().sum().item())
        assert all(later >= earlier - 1e-9 for earlier, later in pairwise(energies))

    @each_filter
    @each_layout
    def test_gradients_pass_through_the_same_filter(self, lowpass: Regularizer, layout: Layout) -> None:
        # A symmetric filter: the gradient of <y, F x> with respect to x is F y.
        context, values, other = layout.context(lowpass, 2), layout.values(3), layout.values(4)
        values.requires_grad_()
        (gradient,) = torch.autograd.grad((other * lowpass.transform(values, context)).sum(), values)
        torch.testing.assert_close(gradient, lowpass.transform(other, context))

    @each_filter
    def test_plain_data_and_back(self, lowpass: Regularizer) -> None:
        text = yaml.safe_dump(gridreg.to_config([lowpass]))
        assert gridreg.from_config(yaml.safe_load(text)) == [lowpass]
