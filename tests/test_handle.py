"""The handle in training: losses and their parts, saving, and the hooks of a renderer and a trainer."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach.sites import SiteLike
from gridreg.base import Context, Regularizer
from gridreg.testing._subjects import points, same, samples_of
from tests.fields import made

LINE = gridreg.parameters("app_line.*", dim=1)


def half(site: SiteLike = LINE) -> gridreg.FixedMask:
    return gridreg.FixedMask(site, visible_ratio=0.5)


def outputs(field: nn.Module) -> list[Tensor]:
    return list(field(*points()))


# --- losses ------------------------------------------------------------------------------------


def test_a_loss_to_which_nothing_contributes_is_a_scalar_0() -> None:
    with gridreg.apply(made("tensorf"), half(), total_steps=10) as handle:
        loss = handle.loss(None)
        assert loss.shape == ()
        assert loss == 0
        assert handle.terms == {}
        assert (loss + torch.ones((), requires_grad=True)).requires_grad


def test_terms_are_weighted_detached_and_sum_to_the_loss() -> None:
    field = made("tensorf")
    grids = gridreg.parameters("density_*.*", dim=1)
    with gridreg.apply(
        field,
        gridreg.OcclusionLoss(weight=0.5, samples=2),
        gridreg.TotalVariation(grids, weight=2.0),
        gridreg.TotalVariation(grids, weight=gridreg.Linear(0.0, 1.0)),
        gridreg.TotalVariation(LINE, weight=0.0),
        total_steps=10,
    ) as handle:
        handle.step(5)
        samples = samples_of(field)
        loss = handle.loss(samples)
        assert list(handle.terms) == [
            "OcclusionLoss",
            "TotalVariation(density_*.*)",
            "TotalVariation(density_*.*) #2",
            "TotalVariation(app_line.*)",
        ]
        first, second, third, off = handle.terms.values()
        assert torch.isclose(first, 0.5 * gridreg.occlusion_loss(samples, 2))
        assert torch.isclose(second, 4 * third)
        assert off == 0
        assert not any(term.requires_grad for term in handle.terms.values())
        assert torch.isclose(first + second + third, loss)
        loss.backward()
        assert field.density_plane[0].grad.abs().sum() > 0


def test_penalties_on_grids_read_the_raw_grids() -> None:
    field = made("tensorf")
    penalty = gridreg.TotalVariation(LINE, weight=1.0)
    with gridreg.apply(field, penalty, total_steps=10) as handle:
        bare = handle.loss()
    with gridreg.apply(field, gridreg.FixedMask(LINE, visible_ratio=0.0), penalty, total_steps=10) as handle:
        assert torch.equal(handle.loss(), bare)
        handle.loss().backward()
        assert all(line.grad.abs().sum() > 0 for line in field.app_line.parameters())


def test_grid_terms_can_move_to_the_optimizer() -> None:
    field = made("tensorf")
    with gridreg.apply(
        field,
        gridreg.TotalVariation(LINE, weight=3.0),
        gridreg.L1(LINE, weight=0.0),
        gridreg.OcclusionLoss(),
        total_steps=10,
    ) as handle:
        local = handle.grid_terms()
        assert {(term.name, term.kind) for term in local} == {
            ("TotalVariation(app_line.*)", "total_variation")
        }
        assert [term.parameter for term in local] == list(field.app_line.parameters())
        assert all(term.scale == 3.0 and term.spatial == (2,) for term in local)
        samples = samples_of(field)
        rest = handle.loss(samples, exclude={term.name for term in local})
        assert list(handle.terms) == ["L1(app_line.*)", "OcclusionLoss"]
        assert torch.isclose(rest, 0.01 * gridreg.occlusion_loss(samples))
        with pytest.raises(gridreg.InputError, match=r"exclude=\['TV'\].*which are \['TotalVariation"):
            handle.loss(samples, exclude=["TV"])


@dataclass(frozen=True)
class Sparsity(Regularizer):
    """A penalty on colours."""

    weight: float = 1.0

    def needs(self) -> tuple[str, ...]:
        return ("colours", "positions")

    def penalty(self, samples: Any, context: Context) -> Tensor:
        return samples.colours.mean()  # type: ignore[no-any-return]


def test_missing_samples_are_named() -> None:
    field = made("tensorf")
    with gridreg.apply(field, Sparsity(), total_steps=10) as handle:
        samples = samples_of(field)
        assert handle.loss(samples) == samples.colours.mean()  # type: ignore[union-attr]
        with pytest.raises(gridreg.InputError, match="Sparsity: needs samples"):
            handle.loss()
        with pytest.raises(gridreg.InputError, match=r"Sparsity: needs samples\.positions, found None"):
            handle.loss(samples.replace(positions=None))


# --- saving ------------------------------------------------------------------------------------


def test_state_holds_only_numbers_text_and_tensors() -> None:
    field = made("tensorf")
    with gridreg.apply(field, half(), gridreg.ComponentDropout(LINE, p=0.5), total_steps=10) as handle:
        handle.step(4)
        state = handle.state_dict()
    assert state["step"] == 4
    assert state["regularizers"] == ["FixedMask(app_line.*)", "ComponentDropout(app_line.*)"]
    assert state["generator"].dtype == torch.uint8
    assert all(isinstance(tensor, Tensor) and tensor.is_leaf for tensor in state["state"].values())


def test_a_state_loaded_before_the_first_call_is_kept() -> None:
    """The width of an output shows only at the first call; what was drawn for it must not be drawn anew."""
    dropout = gridreg.ComponentDropout(gridreg.outputs("encoder"), p=0.5)
    first, second = made("hash"), made("hash")
    with (
        gridreg.apply(first, dropout, total_steps=10, seed=1) as old,
        gridreg.apply(second, dropout, total_steps=10, seed=2) as new,
    ):
        outputs(first)
        old.step(3)
        new.load_state_dict(copy.deepcopy(old.state_dict()))
        assert new.current_step == 3
        assert same(outputs(first), outputs(second))


def test_the_state_follows_the_tensors_that_are_there() -> None:
    field, other = made("tensorf"), made("tensorf")
    mask = gridreg.FrequencyMask(LINE, until=10)
    with (
        gridreg.apply(field, mask, total_steps=10) as handle,
        gridreg.apply(other, mask, total_steps=10) as twin,
    ):
        for part, owner in ((field, handle), (other, twin)):
            with owner.suspended():
                part.app_line = nn.ParameterList(list(part.app_line)[:2])
        handle.step(4)
        assert [key.split("/")[2] for key in handle.state_dict()["state"]] == ["app_line.0", "app_line.1"]
        twin.load_state_dict(handle.state_dict())
        assert torch.equal(field.app_line[0], other.app_line[0])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"regularizers": ["CosineMask(app_line.*)"]}, r"regularizers is \['CosineMask"),
        ({"total_steps": 11}, "total_steps is 11, expected 10"),
        ({"state": {"FixedMask(app_line.*)/parameters/app_line.9/mask": torch.ones(12)}}, r"app_line\.9"),
        ({"state": {"FixedMask(app_line.*)/parameters/app_line.0/mask": torch.ones(5)}}, r"shape \(5,\)"),
    ],
)
def test_a_state_of_something_else_is_refused(change: dict[str, Any], text: str) -> None:
    field = made("tensorf")
    with gridreg.apply(field, half(), total_steps=10) as handle:
        state = handle.state_dict()
        values = outputs(field)
        with pytest.raises(gridreg.InputError, match=text):
            handle.load_state_dict({**state, **change})
        with pytest.raises(gridreg.InputError, match=r"lacks \['generator'\]"):
            handle.load_state_dict({key: value for key, value in state.items() if key != "generator"})
        handle.load_state_dict(state)
        assert same(outputs(field), values)


# --- hooks of a trainer ------------------------------------------------------------------------


def test_hooks_are_no_ops_when_no_regularizer_plays_the_part() -> None:
    field = made("tensorf")
    with gridreg.apply(field, half(), total_steps=10) as handle:
        samples, default = samples_of(field), torch.ones(3)
        near, far = torch.ones(2), torch.full((2,), 5.0)
        groups = [{"params": list(field.parameters())}]
        generator = torch.Generator().manual_seed(0)
        assert handle.on_samples(samples) is samples
        assert handle.background(4, generator, default) is default
        assert handle.background(4, generator) is None
        assert handle.near_far(near, far) == (near, far)
        assert handle.parameter_groups(groups) is groups
        handle.update_groups(groups)
        assert handle.grid_terms() == []
        assert torch.equal(generator.get_state(), torch.Generator().manual_seed(0).get_state())


def test_hooks_reach_the_regularizers_that_play_the_part() -> None:
    field = made("tensorf")
    with gridreg.apply(
        field,
        gridreg.RandomBackground(),
        gridreg.SampleSpaceAnnealing(until=10),
        gridreg.WeightDecay(LINE, decay=gridreg.Linear(0.1, 0.2)),
        total_steps=10,
    ) as handle:
        background = handle.background(4, torch.Generator().manual_seed(0), torch.ones(3))
        assert background is not None
        assert background.shape == (4, 3)
        near, far = handle.near_far(torch.full((2,), 2.0), torch.full((2,), 6.0))
        assert near.tolist() == [3.0, 3.0]
        assert far.tolist() == [5.0, 5.0]
        groups = handle.parameter_groups([{"params": list(field.parameters()), "lr": 1.0}])
        decays = [group.get("weight_decay") for group in groups]
        assert decays == [None, 0.1]
        assert {id(p) for p in groups[1]["params"]} == {id(p) for p in field.app_line.parameters()}
        handle.step(10)
        handle.update_groups(groups)
        assert groups[1]["weight_decay"] == 0.2
