"""Attaching to parameters of any kind: where masks act, and who goes on seeing the raw tensors."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg import parameters
from tests.grids import HALF, SELECTORS, Grids, made


@pytest.mark.parametrize("name", SELECTORS)
def test_a_mask_on_any_kind_of_parameter_closes_its_channels_where_it_is_named(name: str) -> None:
    field = made()
    raw = {key: part.clone() for key, part in field.parts().items()}
    with gridreg.apply(field, gridreg.FixedMask(SELECTORS[name], **HALF), total_steps=10):
        for key, part in field.parts().items():
            masked = SELECTORS[key] == SELECTORS[name]
            assert torch.equal(part[:3], raw[key][:3])
            # A tied parameter is masked on the access path that was named, and on no other.
            assert torch.equal(part[3:], torch.zeros_like(part[3:]) if masked else raw[key][3:])
    assert all(torch.equal(part, raw[key]) for key, part in field.parts().items())


def test_names_values_and_optimizers_see_the_raw_parameters() -> None:
    field = made()
    names, tensors = list(field.state_dict()), dict(field.named_parameters())
    x = torch.ones(2, 6)
    masks = [gridreg.FixedMask(site, **HALF) for site in dict.fromkeys(SELECTORS.values())]
    with gridreg.apply(field, *masks, total_steps=10):
        assert list(field.state_dict()) == names
        assert all(parameter is tensors[name] for name, parameter in field.named_parameters())
        assert torch.equal(field.state_dict()["own"], tensors["own"])
        optimizer = torch.optim.Adam(field.parameters(), lr=0.1)
        before = copy.deepcopy(field.state_dict())
        field(x).square().sum().backward()
        optimizer.step()
        assert not torch.equal(field.state_dict()["own"][:, :3], before["own"][:, :3])
        assert torch.equal(field.state_dict()["own"][:, 3:], before["own"][:, 3:])
        assert (tensors["own"].grad[:, 3:] == 0).all()  # type: ignore[index]
        field.load_state_dict(before)
        assert torch.equal(field.state_dict()["own"], before["own"])
        field.load_state_dict(before, assign=True)
        assert (field.own[:, 3:] == 0).all()
    assert torch.equal(field.own, before["own"])


def test_assigned_parameters_and_lists_are_masked_again() -> None:
    field = made()
    sites = (SELECTORS["own"], SELECTORS["lines.0"])
    with gridreg.apply(field, *(gridreg.FixedMask(site, **HALF) for site in sites), total_steps=10) as handle:
        field.own = nn.Parameter(torch.ones(9, 6))
        assert (field.own[:, 3:] == 0).all()
        assert field.own.shape == (9, 6)
        del field.own
        with pytest.raises(AttributeError):
            _ = field.own
        field.own = nn.Parameter(torch.ones(2, 6))
        assert (field.own[:, 3:] == 0).all()
        field.lines[1] = nn.Parameter(torch.ones(1, 6, 8, 1))
        assert (field.lines[1][:, 3:] == 0).all()
        # A new list is not ours until the next step, or until suspended() ends.
        field.lines = nn.ParameterList(nn.Parameter(torch.ones(1, 6, n, 1)) for n in (4, 5, 6))
        assert (field.lines[0] == 1).all()
        handle.step(1)
        assert all((line[:, 3:] == 0).all() for line in field.lines)
        with handle.suspended():
            assert type(field) is Grids
            field.lines = nn.ParameterList([nn.Parameter(torch.ones(1, 8, 4, 1))])
        assert field.lines[0].sum() == 4 * 4


def test_a_changed_number_of_channels_is_followed_at_the_next_step_or_named() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FixedMask(SELECTORS["own"], **HALF), total_steps=10) as handle:
        field.own = nn.Parameter(torch.ones(4, 10))
        with pytest.raises(gridreg.InputError, match=r"own: mask of 6 for 10 channels.*handle\.suspended"):
            _ = field.own
        handle.step(1)
        assert field.own.sum() == 4 * 5


def test_a_site_that_is_gone_is_an_error_that_names_it() -> None:
    field = made()
    handle = gridreg.apply(field, gridreg.FixedMask(SELECTORS["lines.0"], **HALF), total_steps=10)
    del field.lines
    with pytest.raises(gridreg.InputError, match=r"lines\.\*.*matches no parameter"):
        handle.step(1)
    handle.remove()
    assert type(field) is Grids


def test_functional_call_and_autograd_transforms_see_the_mask() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FixedMask(SELECTORS["own"], **HALF), total_steps=10):
        own = {"own": torch.full((4, 6), 2.0)}

        def loss(own: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(field, own, (torch.zeros(1, 6),)).sum()

        gradient = torch.func.grad(loss)(own)["own"]
        assert (gradient[:, :3] == 1).all()
        assert (gradient[:, 3:] == 0).all()
        assert torch.equal(field.state_dict()["own"], made().state_dict()["own"])


def test_casting_and_moving_go_on_working() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FixedMask(SELECTORS["own"], **HALF), total_steps=10):
        for dtype in (torch.float64, torch.bfloat16, torch.float32):
            field.to(dtype)
            assert field.own.dtype == dtype
            assert (field.own[:, 3:] == 0).all()
    assert type(field) is Grids


def test_the_next_step_may_come_before_the_backward_pass() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FrequencyMask(SELECTORS["own"], until=8), total_steps=10) as handle:
        handle.step(2)
        expected = field.own.detach() != 0
        loss = field.own.sum()
        handle.step(7)
        loss.backward()
        assert torch.equal(field._parameters["own"].grad != 0, expected)  # type: ignore[union-attr]


@pytest.mark.filterwarnings("ignore::gridreg.attach._notices.AttachWarning")
def test_open_channels_tells_what_a_field_need_not_read() -> None:
    field = made()
    assert gridreg.open_channels(field, "own") is None
    mask = gridreg.FrequencyMask(SELECTORS["own"], until=10, block=2)
    fixed = gridreg.FixedMask(SELECTORS["own"], visible_ratio=0.9)
    with gridreg.apply(field, mask, fixed, total_steps=10) as handle:
        opened = {}
        for step in (0, 1, 5, 10):
            handle.step(step)
            opened[step] = gridreg.open_channels(field, "own")
        assert opened == {0: 2, 1: 4, 5: 5, 10: 5}
        assert gridreg.open_channels(field, "lines.0") is None
    detached = gridreg.FixedMask(SELECTORS["own"], visible_ratio=0.5, detach=True)
    middle = gridreg.FixedMask(parameters("own", dim=1, channels=[1, 2]), visible_ratio=0.5)
    lines = gridreg.FixedMask(SELECTORS["lines.0"], visible_ratio=0.0)
    with gridreg.apply(field, detached, middle, lines, total_steps=10):
        assert gridreg.open_channels(field, "own") is None
        assert gridreg.open_channels(field.lines, "1") == 0
        assert gridreg.open_channels(field, "lines.1") == 0


def test_a_fully_open_mask_hands_out_the_parameter_itself() -> None:
    field = made()
    masks = (gridreg.FrequencyMask(site, until=5) for site in dict.fromkeys(SELECTORS.values()))
    with gridreg.apply(field, *masks, total_steps=10) as handle:
        handle.step(1)
        assert field.own is not field._parameters["own"]
        handle.step(5)
        assert field.own is field._parameters["own"]
        assert all(a is b for a, b in zip(field.lines, field.lines.parameters(), strict=True))
        handle.step(1)
        assert (field.own[:, -1] != field._parameters["own"][:, -1]).all()  # type: ignore[index]
