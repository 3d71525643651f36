"""The handle: steps, losses, suspending, stacking, saving, hooks, and what it refuses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

import gridreg
from gridreg.attach.sites import SiteLike
from gridreg.base import Context, Regularizer, overrides, register
from gridreg.testing._subjects import anatomy, points, same, samples_of
from tests.fields import made

LINE = gridreg.parameters("app_line.*", dim=1)


def half(site: SiteLike = LINE) -> gridreg.FixedMask:
    return gridreg.FixedMask(site, visible_ratio=0.5)


def outputs(field: nn.Module) -> list[Tensor]:
    return list(field(*points()))


# --- the step ----------------------------------------------------------------------------------


def test_before_the_first_call_the_step_is_0() -> None:
    field = made("tensorf")
    with gridreg.apply(field, gridreg.FrequencyMask(LINE), total_steps=100) as handle:
        assert handle.current_step == 0
        assert handle.total_steps == 100
        assert (field.app_line[0][:, 3:] == 0).all()
        assert (field.app_line[0][:, :3] != 0).any()


@pytest.mark.filterwarnings("ignore::gridreg.attach._notices.AttachWarning")
@given(st.lists(st.integers(0, 120), min_size=1, max_size=6))
def test_only_the_last_step_counts(steps: list[int]) -> None:
    field, other = made("tensorf"), made("tensorf")
    mask = gridreg.FrequencyMask(LINE, until=0.9)
    with (
        gridreg.apply(field, mask, total_steps=100) as first,
        gridreg.apply(other, mask, total_steps=100) as second,
    ):
        for step in steps:
            first.step(step)
        second.step(steps[-1])
        assert same(outputs(field), outputs(other))


@pytest.mark.parametrize("step", [-1, 1.5, None, "3", True])
def test_bad_steps_are_refused(step: Any) -> None:
    with (
        gridreg.apply(made("tensorf"), half(), total_steps=10) as handle,
        pytest.raises(gridreg.InputError, match="step="),
    ):
        handle.step(step)


def test_a_schedule_out_of_range_is_named_when_it_is_read() -> None:
    field = made("tensorf")
    with gridreg.apply(
        field,
        gridreg.FixedMask(LINE, visible_ratio=lambda step: 1 + step),
        gridreg.TotalVariation(LINE, weight=lambda step: 1 - step),
        total_steps=10,
    ) as handle:
        with pytest.raises(gridreg.InputError, match=r"FixedMask\(app_line\.\*\): visible_ratio=2 at step 1"):
            handle.step(1)
        handle._attachment.clock.step = 2
        with pytest.raises(gridreg.InputError, match=r"TotalVariation\(app_line\.\*\): weight=-1 at step 2"):
            handle.loss()


# --- suspending and stacking -------------------------------------------------------------------


def test_suspended_is_the_bare_field_and_comes_back_even_after_an_error() -> None:
    field = made("tensorf")
    bare, before = outputs(field), anatomy(field)
    with gridreg.apply(field, half(), total_steps=10) as handle:
        masked = outputs(field)
        assert not same(masked, bare)
        with pytest.raises(RuntimeError, match="surgery"), handle.suspended() as inside:  # noqa: PT012
            assert inside is handle
            assert same(outputs(field), bare)
            assert anatomy(field) == before
            with handle.suspended():
                assert same(outputs(field), bare)
            assert same(outputs(field), bare)
            handle.step(3)
            raise RuntimeError("surgery failed")
        assert same(outputs(field), masked)


def test_a_step_while_suspended_counts_when_attached_again() -> None:
    field, other = made("tensorf"), made("tensorf")
    mask = gridreg.FrequencyMask(LINE, until=10)
    with (
        gridreg.apply(field, mask, total_steps=10) as handle,
        gridreg.apply(other, mask, total_steps=10) as twin,
    ):
        with handle.suspended():
            handle.step(4)
        twin.step(4)
        assert same(outputs(field), outputs(other))


def test_suspending_draws_no_random_numbers() -> None:
    field, other = made("tensorf"), made("tensorf")
    dropout = gridreg.ComponentDropout(LINE, p=0.5)
    with (
        gridreg.apply(field, dropout, total_steps=10) as handle,
        gridreg.apply(other, dropout, total_steps=10) as twin,
    ):
        for step in range(3):
            handle.step(step)
            twin.step(step)
            with handle.suspended():
                pass
            assert same(outputs(field), outputs(other))


@pytest.mark.filterwarnings("ignore::gridreg.attach._notices.AttachWarning")
@pytest.mark.parametrize("last", [0, 1])
def test_two_handles_stack_and_come_off_in_any_order(last: int) -> None:
    field = made("tensorf")
    bare, before = outputs(field), anatomy(field)
    masks = (Plus(LINE), half())
    both = gridreg.FixedMask(gridreg.inputs("mlp.0"), visible_ratio=0.7)
    alone = []
    for mask in masks:
        with gridreg.apply(field, mask, both, total_steps=10):
            alone.append(outputs(field))
    handles = [gridreg.apply(field, mask, both, total_steps=10) for mask in masks]
    stacked = outputs(field)
    assert not any(same(stacked, one) for one in alone)
    with handles[0].suspended():
        assert same(outputs(field), bare)
        assert anatomy(field) == before
    assert same(outputs(field), stacked)
    handles[1 - last].remove()
    assert same(outputs(field), alone[last])
    handles[last].remove()
    assert same(outputs(field), bare)
    assert anatomy(field) == before


def test_transforms_run_in_the_order_of_apply() -> None:
    field = nn.ParameterDict({"grid": nn.Parameter(torch.rand(1, 4, 9))})
    site = gridreg.parameters("grid", dim=1)
    mask, add = half(site), Plus(site)
    with gridreg.apply(field, mask, add, total_steps=10):
        assert (field["grid"][:, 2:] == 1).all()
    with gridreg.apply(field, add, mask, total_steps=10):
        assert (field["grid"][:, 2:] == 0).all()
    with gridreg.apply(field, add, total_steps=10) as first, gridreg.apply(field, mask, total_steps=10):
        with first.suspended():
            pass
        assert (field["grid"][:, 2:] == 0).all()


@dataclass(frozen=True)
class Plus(Regularizer):
    """Adds one."""

    site: SiteLike

    def transform(self, value: Tensor, context: Context) -> Tensor:
        return value + 1


def test_the_same_regularizers_may_be_applied_twice() -> None:
    field = made("tensorf")
    mask = gridreg.FrequencyMask(LINE, until=10)
    with gridreg.apply(field, mask, mask, total_steps=10) as handle:
        handle.step(3)
        assert list(handle.values()) == ["FrequencyMask(app_line.*)", "FrequencyMask(app_line.*) #2"]
        expected = gridreg.frequency_mask(12, 3, 10) ** 2
        raw = field.app_line._parameters["0"]
        assert torch.allclose(field.app_line[0], raw * expected.view(1, -1, 1, 1))


# --- telling -----------------------------------------------------------------------------------


def test_the_table_shows_regularizer_site_channels_and_value() -> None:
    field = made("tensorf")
    handle = gridreg.apply(
        field,
        gridreg.FrequencyMask(LINE, until=10),
        gridreg.FixedMask(gridreg.inputs("mlp.0", channels=slice(9, 45)), visible_ratio=0.5),
        gridreg.OcclusionLoss(weight=0.25),
        total_steps=10,
    )
    handle.step(5)
    _ = field.app_line[0], field.app_line[2]
    assert str(handle).splitlines() == [
        "gridreg on TensorField, step 5 of 10",
        "regularizer    site        channels  value now  acted",
        "-------------  ----------  --------  ---------  ------------------------",
        "FrequencyMask  app_line.*  3 x 12    0.75       not read yet: app_line.1",
        "FixedMask      mlp.0       36        0.5        not read yet",
        "OcclusionLoss  samples     -         0.25       not asked yet",
    ]
    assert repr(handle) == "Handle(3 regularizers on TensorField, step 5 of 10)"
    handle.loss(samples_of(field))
    assert [line.split()[-1] for line in str(handle).splitlines()[3:]] == ["yes", "yes", "yes"]
    html = handle._repr_html_()
    assert html.startswith("<table><caption>gridreg on TensorField, step 5 of 10</caption>")
    assert "<td>FixedMask</td><td>mlp.0</td><td>36</td><td>0.5</td><td>yes</td>" in html
    assert handle.values() == {
        "FrequencyMask(app_line.*)": 0.75,
        "FixedMask(mlp.0)": 0.5,
        "OcclusionLoss": 0.25,
    }
    handle.remove()
    assert str(handle) == repr(handle) == "Handle(removed)"
    assert "removed" in handle._repr_html_()


# --- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize("total_steps", [0, -3, 1.5, None, True, float("nan")])
def test_total_steps_must_be_positive(total_steps: Any) -> None:
    with pytest.raises(gridreg.InputError, match=r"total_steps=.*above 0"):
        gridreg.apply(made("tensorf"), half(), total_steps=total_steps)


@pytest.mark.parametrize("weight", [-0.1, float("nan"), float("inf"), "1"])
@pytest.mark.parametrize("make", [gridreg.OcclusionLoss, lambda weight: gridreg.L1(LINE, weight=weight)])
def test_weights_must_be_numbers_from_0(make: Any, weight: Any) -> None:
    with pytest.raises(gridreg.InputError, match="weight="):
        make(weight=weight)


def test_what_is_no_regularizer_is_refused_with_a_hint() -> None:
    field = made("tensorf")
    cases: list[tuple[Any, str]] = [
        (gridreg.FrequencyMask, "call it"),
        ([half()], "unpack a list"),
        ("FrequencyMask", "expected instances"),
    ]
    for value, text in cases:
        with pytest.raises(gridreg.InputError, match=text):
            gridreg.apply(field, value, total_steps=10)
    with pytest.raises(gridreg.InputError, match="field=str"):
        gridreg.apply("field", half(), total_steps=10)  # type: ignore[arg-type]


def test_a_handle_cannot_be_applied_removed_twice_or_used_after_removal() -> None:
    field = made("tensorf")
    handle = gridreg.apply(field, half(), total_steps=10)
    with pytest.raises(gridreg.InputError, match="applied already"):
        gridreg.apply(field, handle, total_steps=10)  # type: ignore[arg-type]
    state = handle.state_dict()
    handle.remove()
    uses = (
        handle.remove,
        handle.loss,
        handle.state_dict,
        handle.grid_terms,
        handle.values,
        lambda: handle.step(1),
        lambda: handle.load_state_dict(state),
        lambda: handle.suspended().__enter__(),
        lambda: handle.__enter__(),
        lambda: handle.parameter_groups([]),
    )
    for use in uses:
        with pytest.raises(gridreg.InputError, match="removed"):
            use()


def test_the_context_manager_removes_also_after_an_error_and_only_once() -> None:
    field = made("tensorf")
    before = anatomy(field)
    with pytest.raises(RuntimeError, match="inside"), gridreg.apply(field, half(), total_steps=10):
        raise RuntimeError("inside")
    assert anatomy(field) == before
    with gridreg.apply(field, half(), total_steps=10) as handle:
        handle.remove()
    assert anatomy(field) == before


def test_a_site_without_grids_is_refused_for_what_reads_grids() -> None:
    with pytest.raises(gridreg.InputError, match=r"TotalVariation\(mlp\.0\).*no grid parameters"):
        gridreg.apply(made("tensorf"), gridreg.TotalVariation(gridreg.outputs("mlp.0")), total_steps=10)


def test_only_frozen_dataclasses_can_be_registered() -> None:
    with pytest.raises(gridreg.InputError, match="frozen dataclass"):
        register(type("Plain", (Regularizer,), {}))
    assert overrides(Plus, "transform")
    assert not overrides(Plus(LINE), "penalty")
