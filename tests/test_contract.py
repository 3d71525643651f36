"""The contract suite: every registered regularizer keeps every law on every foreign field."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import gridreg
from gridreg.attach.sites import Place, SiteLike
from gridreg.base import REGISTRY, Context, Regularizer
from gridreg.schedules import Numeric
from gridreg.testing import accepted, check_mask, check_regularizer, examples_on
from gridreg.testing._subjects import contexts, points
from tests.fields import DESIGNS, made

PLACES = st.integers(1, 24).flatmap(
    lambda channels: st.one_of(
        st.just(None), st.lists(st.integers(-1, 6), min_size=channels, max_size=channels)
    ).map(lambda octaves: place_of(channels, octaves))
)


def place_of(channels: int, octaves: list[int] | None) -> Place:
    place = Place("grid", gridreg.outputs("grid", octaves=octaves), -1, octaves=octaves and tuple(octaves))
    place.complete(channels)
    return place


def mask_classes() -> list[type[gridreg.Mask]]:
    return [cls for cls in REGISTRY.values() if issubclass(cls, gridreg.Mask)]


@given(PLACES, st.integers(0, 150), st.integers(1, 120), st.data())
def test_masks(place: Place, step: int, total_steps: int, data: st.DataObject) -> None:
    cls = data.draw(st.sampled_from(mask_classes()))
    for example in cls.examples("grid"):
        check_mask(example, place, step, total_steps)


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("cls", REGISTRY.values(), ids=REGISTRY.keys())
def test_every_regularizer_on_every_design(cls: type[Regularizer], name: str) -> None:
    checked = check_regularizer(cls, DESIGNS[name])
    # A penalty on lines has nothing to do on a field without lines; any other class fits every design.
    assert checked > 0 or "grid_penalty" in vars(cls)


@pytest.mark.parametrize("cls", REGISTRY.values(), ids=REGISTRY.keys())
def test_every_regularizer_fits_several_designs(cls: type[Regularizer]) -> None:
    first = {name: examples_on(cls, design)[0] for name, design in DESIGNS.items()}
    assert sum(accepted(example, DESIGNS[name]) for name, example in first.items()) >= 2


def test_all_parts_of_the_registry_are_met() -> None:
    parts = {part for cls in REGISTRY.values() for part in dir(Regularizer) if gridreg.overrides(cls, part)}
    assert {"transform", "penalty", "grid_penalty", "local_terms", "on_samples"} <= parts
    assert {"background", "near_far", "parameter_groups", "update_groups"} <= parts


@pytest.fixture
def registered() -> Any:
    """Register classes for one test."""
    known = dict(REGISTRY)
    yield gridreg.register
    REGISTRY.clear()
    REGISTRY.update(known)


@dataclass(frozen=True)
class Halving(gridreg.Mask):
    """Opens the upper half of the ranks half-way."""

    level: Numeric = 0.5

    def rank_values(self, count: int, context: Context) -> Tensor:
        low = 1.0 if context.step >= context.total_steps // 2 else context.at(self.level, "level", 0, 1)
        return torch.where(torch.arange(count) < (count + 1) // 2, 1.0, low)

    def end(self, count: int, total_steps: int) -> int:
        return total_steps // 2

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        return [cls(site), cls(site, detach=True)]


@dataclass(frozen=True)
class Reversed(Halving):
    """Opens high channels first, which no mask may do."""

    def rank_values(self, count: int, context: Context) -> Tensor:
        return super().rank_values(count, context).flip(0)


@dataclass(frozen=True)
class Forgetful(gridreg.Regularizer):
    """Adds a random number that it does not keep in its state."""

    site: SiteLike

    def transform(self, value: Tensor, context: Context) -> Tensor:
        return value + torch.rand((), generator=context.generator)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        return [cls(site)]


def test_a_new_regularizer_is_covered_by_being_registered(registered: Any) -> None:
    registered(Halving)
    assert Halving in mask_classes()
    assert all(check_regularizer(REGISTRY["Halving"], DESIGNS[name]) > 0 for name in ("tensorf", "mlp"))
    for place in (place_of(7, None), place_of(4, [-1, 0, 0, 1])):
        check_mask(Halving("grid"), place, 3, 20)


def test_the_suite_catches_what_breaks_a_law(registered: Any) -> None:
    registered(Reversed)
    with pytest.raises(AssertionError):
        check_mask(Reversed("grid"), place_of(8, None), 0, 20)
    with pytest.raises(AssertionError, match=r"Reversed.* breaks 'masks': a mask increases with the rank"):
        check_regularizer(Reversed)
    registered(Forgetful)
    with pytest.raises(AssertionError, match="breaks"):
        check_regularizer(Forgetful, DESIGNS["tensorf"])
    with pytest.raises(AssertionError, match="breaks"):
        check_regularizer(Forgetful)


@dataclass(frozen=True)
class Unproven(gridreg.Regularizer):
    """Gives no examples."""

    site: SiteLike
    weight: Numeric = 1.0

    def grid_penalty(self, grids: Any, context: Context) -> Tensor:
        return torch.stack([grid.values.square().mean() for grid in grids]).sum()


def test_without_examples_it_can_be_used_and_registered_but_not_checked(registered: Any) -> None:
    registered(Unproven)
    with gridreg.apply(
        made("tensorf"), Unproven(gridreg.parameters("app_line.*", dim=1)), total_steps=9
    ) as handle:
        assert handle.loss() > 0
        assert gridreg.from_config(gridreg.to_config(handle)) == list(handle.regularizers)
    with pytest.raises(gridreg.InputError, match=r"Unproven: needs a classmethod examples\(site\)"):
        check_regularizer(Unproven)


@pytest.mark.parametrize("cls", REGISTRY.values(), ids=REGISTRY.keys())
def test_the_built_in_field_fits_every_regularizer(cls: type[Regularizer]) -> None:
    assert check_regularizer(cls) > 0


def test_an_unregistered_class_is_checked_too() -> None:
    assert Halving not in REGISTRY.values()
    assert check_regularizer(Halving) > 0


@pytest.mark.parametrize("name", DESIGNS)
@settings(max_examples=15)
@given(data=st.data())
def test_two_masks_on_one_site_multiply(name: str, data: st.DataObject) -> None:
    site = data.draw(st.sampled_from(DESIGNS[name].mask_sites))
    masks = [example for cls in mask_classes() for example in cls.examples(site) if not example.detach]
    pair = [data.draw(st.sampled_from(masks)) for _ in range(2)]
    step = data.draw(st.integers(0, 25))
    field = made(name)
    with gridreg.apply(field, *pair, total_steps=20) as handle:
        field(*points(2))
        handle.step(step)
        stacked = field(*points())
    prepared = [next(contexts(mask, DESIGNS[name], step)) for mask in pair]
    first, second = (mask.mask(context) for mask, context in zip(pair, prepared, strict=True))
    with gridreg.apply(field, Product(site, tuple((first * second).tolist())), total_steps=20):
        expected = field(*points())
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(stacked, expected, strict=True))


@dataclass(frozen=True)
class Product(gridreg.Mask):
    """Given factors, channel by channel."""

    factors: tuple[float, ...] = ()

    def ranks(self, place: Place) -> tuple[int, ...]:
        return tuple(range(place.channels or 0))

    def rank_values(self, count: int, context: Context) -> Tensor:
        return torch.tensor(self.factors)


def test_the_guide_for_contributors_adds_a_regularizer(registered: Any) -> None:
    text = (Path(__file__).parent.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(code, "CONTRIBUTING.md", "exec"), {"__name__": __name__})
    assert check_regularizer(REGISTRY["MeanSquare"]) == 2


def test_counts_are_ints_above_zero() -> None:
    for arguments in ({"block": 0}, {"block": True}, {"block": 1.5}):
        with pytest.raises(
            gridreg.InputError, match=r"block=.*: expected a number of channels, an int above 0"
        ):
            gridreg.FrequencyMask("density", **arguments)
    assert gridreg.FrequencyMask("density", block=None).block is None
    with pytest.raises(gridreg.InputError, match="features=None: expected channels per level"):
        gridreg.LevelMask("levels", features=None)
