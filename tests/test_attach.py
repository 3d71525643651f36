"""Attaching to parameters, outputs and inputs of any module, and what survives it."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import weakref
from abc import ABC, abstractmethod
from collections import namedtuple
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg import inputs, outputs, parameters

HALF = {"visible_ratio": 0.5}


class Grids(nn.Module):
    """Parameters of every kind: own, in a list, in a dict, nested, tied, and a buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.own = nn.Parameter(torch.rand(4, 6) + 1)
        self.lines = nn.ParameterList(nn.Parameter(torch.rand(1, 6, n, 1) + 1) for n in (2, 3))
        self.named = nn.ParameterDict({"a": nn.Parameter(torch.rand(6, 2) + 1)})
        self.nested = nn.ModuleList([nn.Linear(5, 6), nn.Linear(5, 6)])
        self.nested[1].weight = self.nested[0].weight
        self.register_buffer("table", torch.rand(3, 6) + 1)

    def parts(self) -> dict[str, Tensor]:
        """Every tensor with its six channels first."""
        return {
            "own": self.own.T,
            "lines.0": self.lines[0][0, :, :, 0],
            "lines.1": next(line for i, line in enumerate(self.lines) if i == 1)[0, :, :, 0],
            "named.a": self.named["a"],
            "nested.0.weight": self.nested[0].weight,
            "nested.1.weight": self.nested[1].weight,
            "table": self.table.T,
        }

    def forward(self, x: Tensor) -> Tensor:
        features = x + sum(part.sum(1) for part in self.parts().values())
        return features + self.nested[1](x[..., :5])


SELECTORS = {
    "own": parameters("own", dim=1),
    "lines.0": parameters("lines.*", dim=1),
    "lines.1": parameters("lines.*", dim=1),
    "named.a": parameters("named.a", dim=0),
    "nested.0.weight": parameters("nested.0.weight", dim=0),
    "nested.1.weight": parameters("nested.1.weight", dim=0),
    "table": parameters("table", dim=1),
}


def made() -> Grids:
    torch.manual_seed(0)
    return Grids()


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


# --- outputs and inputs ------------------------------------------------------------------------

Pair = namedtuple("Pair", "first second")


class Returning(nn.Module):
    """Returns its input in some container."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind

    def forward(self, x: Tensor, scale: float = 1.0, extra: Tensor | None = None) -> Any:
        y = x * scale if extra is None else x * scale + extra
        made = {
            "tensor": y,
            "tuple": (1, y),
            "list": [1, y],
            "named": Pair(1, y),
            "dict": {"a": 1, "second": y},
        }
        return made[self.kind]


@pytest.mark.parametrize(
    ("kind", "item"), [("tensor", None), ("tuple", 1), ("list", 1), ("named", 1), ("dict", "second")]
)
def test_outputs_in_containers(kind: str, item: Any) -> None:
    field = nn.ModuleDict({"part": Returning(kind)})
    with gridreg.apply(field, gridreg.FixedMask(outputs("part", item=item), **HALF), total_steps=10):
        found = field["part"](torch.ones(2, 4))
        assert type(found) is type(field["part"].forward(torch.ones(2, 4)))
        tensor = found if item is None else found[item]
        assert tensor.tolist() == [[1, 1, 0, 0]] * 2


def test_inputs_by_position_keyword_or_first_tensor() -> None:
    part = Returning("tensor")
    field = nn.ModuleDict({"part": part})
    ones, extra = torch.ones(4), torch.full((4,), 5.0)
    with gridreg.apply(field, gridreg.FixedMask(inputs("part"), **HALF), total_steps=10):
        assert part(ones, 2.0).tolist() == [2, 2, 0, 0]
        assert part(x=ones).tolist() == [1, 1, 0, 0]
        assert part(scale=3.0, x=ones).tolist() == [3, 3, 0, 0]
        assert part(ones, extra=extra).tolist() == [6, 6, 5, 5]
    with gridreg.apply(field, gridreg.FixedMask(inputs("part", item="extra"), **HALF), total_steps=10):
        assert part(ones, extra=extra).tolist() == [6, 6, 1, 1]
    with gridreg.apply(field, gridreg.FixedMask(inputs("part", item=2), **HALF), total_steps=10):
        assert part(ones, 1.0, extra).tolist() == [6, 6, 1, 1]


@pytest.mark.parametrize(
    ("site", "arguments", "text"),
    [
        (outputs("part"), (torch.ones(4),), r"outputs\('part'\): no tensor at item=None of tuple"),
        (outputs("part", item=5), (torch.ones(4),), "no tensor at item=5"),
        (inputs("part", item="extra"), (torch.ones(4),), r"no tensor at item='extra' of \[\]"),
        (inputs("part", dim=3), (torch.ones(4),), r"dim=3.*shape \(4,\)"),
    ],
)
def test_a_tensor_that_is_not_there_is_named(site: Any, arguments: Any, text: str) -> None:
    field = nn.ModuleDict({"part": Returning("tuple")})
    with (
        gridreg.apply(field, gridreg.FixedMask(site), total_steps=10),
        pytest.raises(gridreg.InputError, match=text),
    ):
        field["part"](*arguments)


def test_the_width_of_an_output_is_learnt_at_the_first_call_and_followed() -> None:
    field = nn.ModuleDict({"part": Returning("tensor")})
    with gridreg.apply(field, gridreg.FixedMask(outputs("part"), **HALF), total_steps=10) as handle:
        assert "?" in repr(handle)
        assert field["part"](torch.ones(4)).sum() == 2
        assert field["part"](torch.ones(3, 10)).sum() == 15
        assert "10" in repr(handle)
        with handle.suspended():
            assert field["part"](torch.ones(4)).sum() == 4
        assert field["part"](torch.ones(4)).sum() == 2


def test_a_channel_axis_in_the_middle() -> None:
    field = nn.ModuleDict({"part": Returning("tensor")})
    with gridreg.apply(field, gridreg.FixedMask(outputs("part", dim=1), **HALF), total_steps=10):
        assert field["part"](torch.ones(2, 4, 3)).sum((0, 2)).tolist() == [6, 6, 0, 0]


def test_state_made_in_inference_mode_can_be_updated_outside() -> None:
    field = nn.ModuleDict({"part": Returning("tensor")})
    with gridreg.apply(field, gridreg.FrequencyMask(outputs("part"), until=8), total_steps=10) as handle:
        with torch.inference_mode():
            field["part"](torch.ones(6))
        handle.step(3)
        x = torch.ones(6, requires_grad=True)
        field["part"](x).sum().backward()
        handle.step(10)


def test_the_next_step_may_come_before_the_backward_pass() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FrequencyMask(SELECTORS["own"], until=8), total_steps=10) as handle:
        handle.step(2)
        expected = field.own.detach() != 0
        loss = field.own.sum()
        handle.step(7)
        loss.backward()
        assert torch.equal(field._parameters["own"].grad != 0, expected)  # type: ignore[union-attr]


# --- open channels -----------------------------------------------------------------------------


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


# --- copies, pickles, classes ------------------------------------------------------------------


class Slotted(ABC, nn.Module):
    """A class with a metaclass, its own `__getstate__`, and a subclass hook."""

    subclasses: ClassVar[list[str]] = []

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        Slotted.subclasses.append(cls.__name__)

    @abstractmethod
    def forward(self) -> Tensor: ...

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "cache"}


class Concrete(Slotted):
    def __init__(self) -> None:
        super().__init__()
        self.own = nn.Parameter(torch.ones(2, 4))
        self.cache = torch.ones(1)

    def forward(self) -> Tensor:
        return super().forward() or self.own.sum()


def test_classes_with_a_metaclass_and_their_own_pickling() -> None:
    field = Concrete()
    with gridreg.apply(field, gridreg.FixedMask(parameters("own", dim=1), **HALF), total_steps=10):
        assert isinstance(field, Concrete)
        assert type(field).__name__ == "Concrete"
        assert field() == 4
        for twin in (copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
            assert not hasattr(twin, "cache")
            assert twin() == 4
            assert isinstance(twin, Concrete)
    assert type(field) is Concrete
    assert hasattr(field, "cache")


def test_the_same_class_serves_all_instances_and_is_freed_with_them() -> None:
    first, second = Concrete(), Concrete()
    mask = gridreg.FixedMask(parameters("own", dim=1), **HALF)
    handles = [gridreg.apply(field, mask, total_steps=10) for field in (first, second)]
    assert type(first) is type(second) is not Concrete
    made_for = weakref.ref(type(first))
    for handle in handles:
        handle.remove()
    gc.collect()
    assert made_for() is None


def test_a_field_is_freed_with_its_handle() -> None:
    field = made()
    handle = gridreg.apply(field, gridreg.FixedMask(SELECTORS["own"], **HALF), total_steps=10)
    gone = weakref.ref(field)
    del field, handle
    gc.collect()
    assert gone() is None


def test_a_copy_of_a_part_works_alone() -> None:
    field = made()
    with gridreg.apply(field, gridreg.FixedMask(SELECTORS["lines.0"], **HALF), total_steps=10):
        lines = copy.deepcopy(field.lines)
        assert all((line[:, 3:] == 0).all() for line in lines)
        assert all(parameter.is_leaf for parameter in lines.parameters())
    assert all((line[:, 3:] == 0).all() for line in lines)
    gridreg.strip(lines)
    assert all((line != 0).all() for line in lines)
    assert type(lines) is nn.ParameterList


def _worker(payload: bytes, queue: Any) -> None:
    """In another process: what does the unpickled field give?"""
    field, x = pickle.loads(payload)
    queue.put(field(x).detach().numpy().tolist())


def test_a_worker_process_gets_the_same_field() -> None:
    field, x = made(), torch.rand(2, 6)
    masks = (gridreg.FixedMask(SELECTORS["own"], **HALF), gridreg.FrequencyMask(inputs("nested.1"), until=8))
    with gridreg.apply(field, *masks, total_steps=10) as handle:
        handle.step(2)
        context = multiprocessing.get_context("spawn")
        queue = context.Queue()
        process = context.Process(target=_worker, args=(pickle.dumps((field, x)), queue))
        process.start()
        try:
            found = queue.get(timeout=60)
        finally:
            process.join(60)
        assert torch.equal(torch.tensor(found), field(x).detach())
    assert not torch.equal(torch.tensor(found), field(x).detach())


# --- torch.compile -----------------------------------------------------------------------------


class Compiled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.lines = nn.ParameterList(nn.Parameter(torch.rand(1, 8, n, 1)) for n in (2, 3))
        self.encoder = Returning("tensor")
        self.mlp = nn.Sequential(nn.Linear(6, 8), nn.ReLU(), nn.Linear(8, 3))

    def forward(self, x: Tensor) -> Tensor:
        return self.mlp(self.encoder(x)) + sum(line.square().sum() for line in self.lines)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
def test_compiled_code_follows_the_masks_without_recompiling_each_step(backend: str) -> None:
    torch._dynamo.reset()
    torch.manual_seed(0)
    field, x = Compiled(), torch.rand(4, 6)
    masks = (
        gridreg.FrequencyMask(parameters("lines.*", dim=1), until=80),
        gridreg.FrequencyMask(outputs("encoder"), until=60),
        gridreg.CosineMask(inputs("mlp.0", octaves=[-1, -1, 0, 0, 1, 1]), until=70, detach=True),
    )
    with gridreg.apply(field, *masks, total_steps=100) as handle:
        compiled = torch.compile(field, backend=backend)
        torch._dynamo.utils.counters.clear()
        for step in (0, 7, 20, 33, 50):
            handle.step(step)
            check_compiled(field, compiled, x)
        graphs = torch._dynamo.utils.counters["stats"]["unique_graphs"]
        assert graphs <= 2
        for step in (65, 75, 100):
            handle.step(step)
            check_compiled(field, compiled, x)
        # One more for each mask that was found to be fully open.
        assert torch._dynamo.utils.counters["stats"]["unique_graphs"] <= graphs + 3
    assert torch.equal(compiled(x), field(x))
    torch._dynamo.reset()


def check_compiled(field: nn.Module, compiled: Any, x: Tensor) -> None:
    found = []
    for function in (field, compiled):
        field.zero_grad()
        out = function(x)
        out.sum().backward()
        found.append([out.detach(), *(parameter.grad.clone() for parameter in field.parameters())])  # type: ignore[union-attr]
    assert all(torch.allclose(a, b) for a, b in zip(*found, strict=True))
