"""Five designs of other people: a few lines attach to each, nothing of them is touched, and masks do what they say."""

from __future__ import annotations

import inspect
import itertools
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach._hooks import slots_of
from gridreg.attach._notices import AttachWarning
from gridreg.attach._resolve import find, raw_tensor
from gridreg.testing._subjects import anatomy, points, same
from tests.fields import DESIGNS, made

GROWING = [name for name, design in DESIGNS.items() if design.grow is not None]


def outputs(field: nn.Module) -> list[Tensor]:
    return list(field(*points()))


@pytest.mark.parametrize("name", DESIGNS)
def test_at_most_ten_lines_of_the_users(name: str) -> None:
    lines = inspect.getsource(DESIGNS[name].attach).splitlines()[1:]
    assert 1 <= len([line for line in lines if line.strip()]) <= 10


@pytest.mark.parametrize("name", DESIGNS)
def test_the_design_does_not_know_gridreg(name: str) -> None:
    source = inspect.getsource(inspect.getmodule(DESIGNS[name].make))  # type: ignore[arg-type]
    assert "gridreg" not in source


@pytest.mark.parametrize("name", DESIGNS)
def test_attached_it_differs_and_removed_it_is_bit_identical(name: str) -> None:
    field = made(name)
    bare, before, keys = outputs(field), anatomy(field), list(field.state_dict())
    handle = DESIGNS[name].attach(field)
    assert not same(outputs(field), bare)
    assert list(field.state_dict()) == keys
    handle.step(50)
    outputs(field)[1].sum().backward()
    handle.remove()
    assert same(outputs(field), bare)
    assert anatomy(field) == before


@pytest.mark.parametrize("name", DESIGNS)
def test_training_leaves_the_parameters_of_closed_channels_alone(name: str) -> None:
    """Two steps of Adam on a masked field: what a mask closes gets a gradient of exactly zero and does not move."""
    field = made(name)
    site = DESIGNS[name].mask_sites[0]
    with gridreg.apply(field, gridreg.FixedMask(site, visible_ratio=0.5), total_steps=10):
        outputs(field)
        optimizer = torch.optim.Adam(field.parameters(), lr=0.1)
        before = {key: value.clone() for key, value in field.state_dict().items()}
        for _ in range(2):
            optimizer.zero_grad()
            density, colour = field(*points())
            (density.square().mean() + colour.square().mean()).backward()
            optimizer.step()
        for match in find(field, site, "mask"):
            if match.place.kind == "parameters":
                closed = torch.arange(match.place.size or 0) >= (match.place.size or 0) // 2
                raw = raw_tensor(match.module, match.attribute).detach().movedim(match.place.dim, 0)
                old = before[match.place.name].movedim(match.place.dim, 0)
                assert torch.equal(raw[closed], old[closed])
                assert not torch.equal(raw[~closed], old[~closed])


@pytest.mark.parametrize("name", DESIGNS)
def test_closed_channels_have_exactly_zero_effect(name: str) -> None:
    """Whatever is written into channels that a mask closes, NaN included, no output changes by a bit."""
    field = made(name)
    for site in DESIGNS[name].mask_sites:
        mask = gridreg.FixedMask(site, visible_ratio=0.5)
        with gridreg.apply(field, mask, total_steps=10):
            clean = outputs(field)
            spoiled = [
                spoil(match.module, match.attribute, match.place) for match in find(field, site, "mask")
            ]
            assert same(outputs(field), clean)
        for undo in spoiled:
            undo()


def spoil(module: nn.Module, attribute: str, place: Any) -> Any:
    """Put NaN into the upper half of the channels, before the mask; returns how to take it back."""
    if place.kind == "parameters":
        raw = raw_tensor(module, attribute).detach().movedim(place.dim, 0)
        kept = raw.clone()
        raw[len(raw) // 2 :] = float("nan")
        return lambda: raw.copy_(kept)
    octaves = place.octaves

    def spoiled(value: Tensor) -> Tensor:
        chosen = list(place.selected or range(value.shape[-1]))
        ranks = gridreg.regularizers.mask_functions.channel_ranks(octaves or tuple(range(len(chosen))))
        closed = [c for c, rank in zip(chosen, ranks, strict=True) if rank >= (max(ranks) + 1) // 2]
        value = value.clone()
        value[..., closed] = float("nan")
        return value

    if place.kind == "outputs":
        return module.register_forward_hook(lambda m, a, out: spoiled(out), prepend=True).remove
    return module.register_forward_pre_hook(lambda m, a: (spoiled(a[0]), *a[1:]), prepend=True).remove


@pytest.mark.parametrize("name", GROWING)
def test_a_growing_grid_keeps_its_masks(name: str) -> None:
    field, plain = made(name), made(name)
    design = DESIGNS[name]
    handle = design.attach(field)
    handle.step(30)
    masks = [slot.context.state["mask"].clone() for slot in slots(field)]
    with handle.suspended():
        design.grow(field)  # type: ignore[misc]
    design.grow(plain)  # type: ignore[misc]
    assert all(
        torch.equal(a, b)
        for a, b in zip(field.state_dict().values(), plain.state_dict().values(), strict=True)
    )
    fresh = design.attach(plain)
    fresh.step(30)
    assert same(outputs(field), outputs(plain))
    assert [slot.context.state["mask"].tolist() for slot in slots(field)] == [mask.tolist() for mask in masks]
    handle.remove()
    fresh.remove()
    assert same(outputs(field), outputs(plain))


def slots(field: nn.Module) -> list[Any]:
    return [slot for module in field.modules() for slot in slots_of(module)]


def test_growing_while_attached_is_noticed_at_the_next_step() -> None:
    field = made("tensorf")
    handle = DESIGNS["tensorf"].attach(field)
    lists = field.density_line
    field.upsample_volume_grid()  # without suspended(): the mask was burnt into the copy
    assert field.density_line is not lists
    assert gridreg.open_channels(field.density_line, "0") is None
    with pytest.warns(
        AttachWarning, match=r"density_line\.0 \(FrequencyMask.*replaced outside handle\.suspended"
    ):
        handle.step(0)
    assert gridreg.open_channels(field.density_line, "0") == 3
    handle.remove()


def test_optimizers_that_take_a_list_are_made_from_raw_parameters_while_suspended() -> None:
    field = made("tensorf")
    handle = DESIGNS["tensorf"].attach(field)
    with pytest.raises(ValueError, match="leaf"):
        torch.optim.Adam(field.get_optparam_groups())
    with handle.suspended():
        optimizer = torch.optim.Adam(field.get_optparam_groups())
    raw = {id(parameter) for parameter in field.parameters()}
    assert {id(p) for group in optimizer.param_groups for p in group["params"]} <= raw
    handle.remove()


def test_one_line_equals_a_fork_of_the_field() -> None:
    """The same FreeNeRF mask, written into a copy of the field's own code."""
    field = made("tensorf")
    x, d = points()

    class Fork(type(field)):  # type: ignore[misc]
        step = 0

        @staticmethod
        def products(planes: Any, lines: Any, x: Tensor) -> list[Tensor]:
            found = type(field).products(planes, lines, x)
            return [p * gridreg.frequency_mask(len(p), Fork.step, 90)[:, None] for p in found]

    fork = Fork()
    fork.load_state_dict(field.state_dict())
    mask = gridreg.FrequencyMask(gridreg.parameters("*_line.*", dim=1), until=0.9)
    with gridreg.apply(field, mask, total_steps=100) as handle:
        for step in (0, 25, 60, 90):
            handle.step(step)
            Fork.step = step
            for ours, theirs in zip(field(x, d), fork(x, d), strict=True):
                torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(("first", "second"), list(itertools.pairwise(DESIGNS)))
def test_two_fields_do_not_disturb_each_other(first: str, second: str) -> None:
    fields = made(first), made(second)
    bare = [outputs(field) for field in fields]
    handle = DESIGNS[first].attach(fields[0])
    assert same(outputs(fields[1]), bare[1])
    other = DESIGNS[second].attach(fields[1])
    handle.remove()
    assert same(outputs(fields[0]), bare[0])
    assert not same(outputs(fields[1]), bare[1])
    other.remove()
