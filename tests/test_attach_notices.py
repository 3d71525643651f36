"""Nothing silent: what is dropped, doubled, never read, copied, replaced or written into is made right or said."""

from __future__ import annotations

import copy
import gc
import pickle
import warnings
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach._notices import AttachWarning

GRID = gridreg.parameters("grid", dim=1)


class Voxels(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(1 + torch.rand(1, 9, 4, 4, 4))
        self.head = nn.Linear(9, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(x @ self.grid.mean((0, 2, 3, 4)).diag())

    def grow(self) -> None:
        self.grid = nn.Parameter(nn.functional.interpolate(self.grid.data, size=(6, 6, 6)))


class Model(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.field, self.other = Voxels(), Voxels()


def mask(**options: Any) -> gridreg.FrequencyMask:
    return gridreg.FrequencyMask(GRID, **options)


def opened(field: nn.Module) -> int:
    return int((field.grid != 0).flatten(2).any(-1).sum())  # type: ignore[operator, union-attr]


def test_a_dropped_handle_leaves_the_field_bare() -> None:
    field = Voxels()
    handle = gridreg.apply(field, mask(until=0.5), total_steps=10)
    handle.step(1)
    del handle
    assert type(field) is Voxels
    assert opened(field) == 9


@pytest.mark.filterwarnings("ignore::gridreg.attach._notices.AttachWarning")
def test_a_cell_that_is_run_twice_leaves_one_mask() -> None:
    field = Voxels()
    for _ in range(2):
        handle = gridreg.apply(field, mask(until=0.5), total_steps=10)
    for step in range(11):
        handle.step(step)
    assert opened(field) == 9
    handle.remove()
    assert type(field) is Voxels


def test_a_second_handle_beside_the_first_is_said() -> None:
    field = Voxels()
    with (
        gridreg.apply(field, mask(), total_steps=10),
        pytest.warns(AttachWarning, match=r"FrequencyMask\(grid\): acts on this Voxels already"),
    ):
        gridreg.apply(field, mask(), total_steps=10).remove()


def test_a_schedule_that_ends_after_the_run_is_said() -> None:
    with pytest.warns(
        AttachWarning, match=r"FrequencyMask\(grid\): until ends at step 20, after .*total_steps=10"
    ):
        gridreg.apply(Voxels(), mask(until=20), total_steps=10).remove()
    late = gridreg.FixedMask(GRID, visible_ratio=gridreg.Linear(0, 1, until=11))
    with pytest.warns(AttachWarning, match="visible_ratio ends at step 11"):
        gridreg.apply(Voxels(), late, total_steps=10).remove()


@pytest.mark.parametrize("inner_masks", [True, False])
def test_suspended_covers_handles_above_and_below(inner_masks: bool) -> None:
    model = Model()
    on_model = gridreg.FrequencyMask(gridreg.parameters("field.grid", dim=1))
    outer = gridreg.apply(model, gridreg.OcclusionLoss() if inner_masks else on_model, total_steps=10)
    inner = gridreg.apply(model.field, mask() if inner_masks else gridreg.L1(GRID), total_steps=10)
    for handle in (outer, inner):
        with handle.suspended():
            assert opened(model.field) == 9
            assert type(model.field) is Voxels
        assert opened(model.field) == 3
    inner.remove()
    outer.remove()


def test_suspended_covers_what_is_shared_and_what_a_copy_brought_along() -> None:
    first, second = Model(), Model()
    second.field = first.field
    with gridreg.apply(first, gridreg.FixedMask(gridreg.parameters("field.grid", dim=1), 0.0), total_steps=9):
        with gridreg.apply(
            second, gridreg.L1(gridreg.parameters("other.grid", dim=1)), total_steps=9
        ) as other:
            with other.suspended():
                assert opened(first.field) == 9
            assert opened(first.field) == 0
        twin = copy.deepcopy(first.field)
    with gridreg.apply(twin, gridreg.L1(GRID), total_steps=9) as handle:
        with handle.suspended():
            assert opened(twin) == 9
        assert opened(twin) == 0


def test_one_handle_that_cannot_come_back_keeps_no_other_off() -> None:
    field = Voxels()
    first = gridreg.apply(field, mask(), total_steps=10)
    second = gridreg.apply(
        field, gridreg.FrequencyMask(gridreg.parameters("head.weight", dim=1)), total_steps=10
    )
    with pytest.raises(gridreg.InputError, match=r"'grid'.*matches no parameter"), first.suspended():
        del field.grid
    second.step(1)
    assert (field.head.weight[:, 6:] == 0).all()
    with pytest.raises(gridreg.InputError, match="matches no parameter"):
        first.step(1)
    second.remove()


class Refusing(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.ones(9, 4))
        self.__dict__["ready"] = True

    def __setattr__(self, name: str, value: Any) -> None:
        if self.__dict__.get("ready"):
            raise AttributeError(f"{name}: frozen")
        super().__setattr__(name, value)


def test_a_class_that_refuses_to_be_changed_can_be_attached_to() -> None:
    field = Refusing()
    with gridreg.apply(field, gridreg.FixedMask(gridreg.parameters("grid", dim=0), 0.0), total_steps=9):
        assert not field.grid.any()
    assert type(field) is Refusing


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    "site", [gridreg.parameters("1.weight", dim=1), gridreg.inputs("1"), gridreg.outputs("1")]
)
def test_apply_happens_whole_or_not_at_all(site: gridreg.Selector) -> None:
    field = nn.Sequential(nn.Linear(9, 9), torch.jit.script(nn.Linear(9, 9)))
    first = gridreg.FixedMask(gridreg.parameters("0.weight", dim=1), 0.0)
    with pytest.raises(gridreg.InputError, match=r"^FixedMask\(1.*TorchScript"):
        gridreg.apply(field, first, gridreg.FixedMask(site, 0.0), total_steps=9)
    assert type(field[0]) is nn.Linear
    assert field[0].weight.all()


class Registered(nn.Module):
    known: ClassVar[dict[str, type]] = {}

    def __init_subclass__(cls, *, key: str) -> None:
        Registered.known[key] = cls


class Member(Registered, key="member"):
    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.ones(1, 9, 2))


def test_registries_of_classes_see_no_class_of_ours() -> None:
    with gridreg.apply(Member(), mask(), total_steps=9):
        assert Registered.known == {"member": Member}


@pytest.mark.parametrize("item", [-1, -2])
def test_items_from_the_end(item: int) -> None:
    class Two(nn.Module):
        def forward(self, x: Tensor) -> OrderedDict[str, Tensor] | tuple[Tensor, Tensor]:
            return x, x

    with gridreg.apply(field := Two(), gridreg.FixedMask(gridreg.outputs("", item=item), 0.0), total_steps=9):
        found = field(torch.ones(9))
        assert not found[item].any()
        assert found[-3 - item].all()


def test_what_never_acts_is_said_once_and_stands_in_the_table() -> None:
    class Field(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.encoder = nn.Linear(9, 9)
            self.grid = nn.Parameter(torch.ones(9, 4))

        def density(self, x: Tensor) -> Tensor:
            return self.encoder.forward(x).sum() + dict(self.named_parameters())["grid"].sum()

    field = Field()
    sites = gridreg.outputs("encoder"), gridreg.parameters("grid", dim=0)
    masks = [gridreg.FixedMask(site, visible_ratio=0.0) for site in sites]
    with gridreg.apply(
        field, *masks, gridreg.L1(sites[1]), gridreg.RandomBackground(), total_steps=9
    ) as handle:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for step in range(8):
                handle.step(step)
                field.density(torch.ones(2, 9))
                handle.loss()
        (warning,) = caught
        text = str(warning.message)
        assert text.startswith(
            "FixedMask(encoder) not read yet; FixedMask(grid) not read yet; RandomBackground not"
        )
        ends = [line.rpartition("  ")[2] for line in str(handle).splitlines()[3:]]
        assert ends == ["not read yet", "not read yet", "yes", "not asked yet"]
        _ = field.grid
        assert str(handle).splitlines()[4].endswith("yes")


def test_copies_that_stay_behind_are_said_and_may_follow() -> None:
    field = Voxels()
    with gridreg.apply(field, mask(until=5), total_steps=10) as handle:
        average = torch.optim.swa_utils.AveragedModel(field)
        _ = field.grid
        with pytest.warns(AttachWarning, match=r"stays as at step 0; handle\.follow\(copy\)"):
            handle.step(3)
        assert handle.follow(average) is handle
        for step in range(4, 6):
            handle.step(step)
            average.update_parameters(field)
        assert opened(average.module) == 9
        handle.step(0)
        with handle.suspended():
            assert opened(average.module) == 9
        assert opened(average.module) == 3
        with pytest.raises(gridreg.InputError, match="matches no parameter"):
            handle.follow(nn.Linear(2, 2))
    assert type(average.module) is Voxels
    gc.collect()


def test_a_copy_without_anything_may_follow() -> None:
    field, twin = Voxels(), Voxels()
    with gridreg.apply(field, mask(until=5), total_steps=10) as handle:
        handle.follow(twin).step(0)
        assert opened(twin) == 3


def test_a_handle_that_was_copied_with_its_field_belongs_to_the_copy() -> None:
    field = Voxels()
    handle = gridreg.apply(field, mask(until=5), total_steps=10)
    for make in (copy.deepcopy, lambda pair: pickle.loads(pickle.dumps(pair))):
        other, own = make((field, handle))
        own.step(5)
        assert (opened(other), opened(field)) == (9, 3)
        own.step(0)
        with own.suspended():
            assert (opened(other), opened(field)) == (9, 3)
        own.remove()
        assert type(other) is Voxels
    assert opened(field) == 3
    handle.remove()


def test_surgery_outside_suspended_is_said_and_suspends_makes_it_right() -> None:
    field = Voxels()
    with gridreg.apply(field, mask(), total_steps=10) as handle:
        field.grow()
        with pytest.warns(
            AttachWarning, match=r"grid \(FrequencyMask\(grid\)\): replaced outside .*handle\.suspends"
        ):
            handle.step(1)
    field = Voxels()
    with gridreg.apply(field, mask(), total_steps=10) as handle:
        assert handle.suspends("grow") is handle
        field.grow()
        handle.step(1)
        assert opened(field) == 6
        assert copy.deepcopy(field).grow() is None
    assert "grow" not in field.__dict__
    assert field.grid.shape[-1] == 6
    assert opened(field) == 9


def test_a_method_of_a_part_may_suspend_and_a_wrong_name_is_told() -> None:
    model = Model()
    with gridreg.apply(
        model, gridreg.FrequencyMask(gridreg.parameters("field.grid", dim=1)), total_steps=9
    ) as handle:
        handle.suspends("field.grow")
        model.field.grow()
        assert opened(model.field) == 3
        with pytest.raises(
            gridreg.InputError, match=r"suspends\('field\.growe'\).*did you mean 'field\.grow'"
        ):
            handle.suspends("field.growe")
    assert opened(model.field) == 9


def test_writing_into_a_masked_tensor_is_said() -> None:
    field = Voxels()
    with gridreg.apply(field, mask(), total_steps=10) as handle:
        with torch.no_grad():
            field.grid.clamp_(max=0)
        assert opened(field) == 3
        with pytest.warns(AttachWarning, match="grid: something wrote in place"):
            handle.step(1)


def test_replacing_by_what_was_made_of_raw_values_is_not_said() -> None:
    field = Voxels()
    with gridreg.apply(field, mask(), total_steps=10) as handle:
        _ = field.grid
        field.grid = nn.Parameter(torch.rand(1, 9, 2, 2, 2))
        handle.step(1)
        assert opened(field) == 6


def steps(field: Voxels, handle: gridreg.Handle, first: int, last: int, write: Any = None) -> None:
    for step in range(first, last):
        handle.step(step)
        field(torch.zeros(1, 9)).sum().backward()
        if write is not None:
            write()


@pytest.mark.parametrize("grad", [True, False])
def test_values_written_past_torch_s_counting_are_noticed(grad: bool) -> None:
    field = Voxels()

    def write() -> None:
        with torch.set_grad_enabled(grad):
            field.grid.data.clamp_(min=0.5)

    handle = gridreg.apply(field, gridreg.FrequencyMask(GRID, until=1.0), total_steps=1000)
    with pytest.warns(AttachWarning, match="grid: something wrote in place"):
        steps(field, handle, 0, 12, write)
    handle.remove()


@pytest.mark.parametrize("how", ["data", "copy", "load"])
def test_a_mask_written_into_its_parameter_is_noticed(how: str) -> None:
    field = Voxels()
    handle = gridreg.apply(field, gridreg.FrequencyMask(GRID, until=1.0), total_steps=1000)
    steps(field, handle, 0, 20)
    raw = dict(field.named_parameters())["grid"]
    with torch.no_grad():
        if how == "data":
            raw.data.copy_(field.grid)
        elif how == "copy":
            raw.copy_(field.grid)
        else:
            field.load_state_dict({**field.state_dict(), "grid": field.grid.clone()})
    with pytest.warns(AttachWarning, match=r"grid \(FrequencyMask\(grid\)\): a closed channel had values"):
        steps(field, handle, 20, 30)
    handle.remove()


def test_a_grid_that_begins_with_zeros_is_no_loss() -> None:
    field = Voxels()
    with torch.no_grad():
        field.grid.zero_()
    with gridreg.apply(field, gridreg.FrequencyMask(GRID, until=1.0), total_steps=1000) as handle:
        steps(field, handle, 0, 20)


@dataclass(frozen=True)
class Misspelt(gridreg.Regularizer):
    """Asks itself for what it does not have, in `transform`."""

    site: Any

    def transform(self, value: Tensor, context: gridreg.base.Context) -> Tensor:
        return value * self.facter  # type: ignore[attr-defined]


@pytest.mark.parametrize("buffer", [False, True])
def test_a_missing_attribute_of_a_regularizer_is_no_missing_attribute_of_the_field(buffer: bool) -> None:
    """Python asks `__getattr__` where a property raises AttributeError; torch's would give the raw tensor."""
    field = nn.Module()
    if buffer:
        field.register_buffer("grid", torch.ones(1, 6, 4))
    else:
        field.grid = nn.Parameter(torch.ones(1, 6, 4))
    handle = gridreg.apply(field, Misspelt(gridreg.parameters("grid", dim=1)), total_steps=10)
    with pytest.raises(RuntimeError, match=r"grid: a regularizer on it raised .*facter"):
        _ = field.grid
    handle.remove()
    assert bool((field.grid == 1).all())
