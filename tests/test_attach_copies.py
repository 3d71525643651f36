"""Copies, pickles, worker processes and compiled code of a field with something attached."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import weakref
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg import inputs, outputs, parameters
from tests.grids import HALF, SELECTORS, made


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
            found = queue.get(timeout=300)
        finally:
            process.join(300)
        assert torch.equal(torch.tensor(found), field(x).detach())
    assert not torch.equal(torch.tensor(found), field(x).detach())


class Compiled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.lines = nn.ParameterList(nn.Parameter(torch.rand(1, 8, n, 1)) for n in (2, 3))
        self.encoder = nn.Identity()
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


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("site", [parameters("lines.*", dim=1), inputs("mlp.0"), outputs("mlp.0")])
def test_code_that_was_compiled_before_notices_what_is_attached_and_removed(site: gridreg.Selector) -> None:
    torch._dynamo.reset()
    field, x = Compiled(), torch.rand(4, 6)
    compiled = torch.compile(field, backend="eager")
    bare = compiled(x)
    # Names may be those of the field, though the wrapper puts a prefix in front.
    with gridreg.apply(compiled, gridreg.FixedMask(site, **HALF), total_steps=10) as handle:
        masked = field(x)
        assert not torch.equal(masked, bare)
        assert torch.equal(compiled(x), masked)
        with handle.suspended():
            assert torch.equal(compiled(x), bare)
        assert torch.equal(compiled(x), masked)
    assert torch.equal(compiled(x), bare)
    torch._dynamo.reset()


def test_a_class_made_on_top_of_ours_still_copies() -> None:
    """Other tools change classes too; a copy then falls back to what that class can do."""
    field = Concrete()
    handle = gridreg.apply(field, gridreg.FixedMask(parameters("own", dim=1), **HALF), total_steps=10)
    field.__class__ = type("OnTop", (type(field),), {})
    twin = copy.deepcopy(field)
    assert type(twin) is type(field)
    assert twin() == field() == 4
    handle.remove()
    assert field() == 8
