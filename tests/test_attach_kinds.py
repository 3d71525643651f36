"""Fields of all kinds: tied, lazy, sparse and complex parameters, outputs by name, tracing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn

import gridreg


class Tied(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = (nn.Linear(9, 9, bias=False) for _ in range(2))
        self.b.weight = self.a.weight

    def forward(self, x: Tensor) -> Tensor:
        return self.a(x).sum() + 2 * self.b(x).sum()


@pytest.mark.parametrize(("name", "reads"), [("a.weight", 1), ("b.weight", 2), ("*.weight", 3)])
def test_a_parameter_that_modules_share_is_masked_where_it_is_named(name: str, reads: int) -> None:
    field, x = Tied(), torch.ones(1, 9)
    weight = field.a.weight.detach().clone()
    mask = gridreg.FixedMask(gridreg.parameters(name, dim=1), visible_ratio=1 / 3)
    with gridreg.apply(field, mask, total_steps=5):
        found = field(x)
        found.backward()
    torch.testing.assert_close(found.detach(), reads * weight[:, :3].sum() + (3 - reads) * weight.sum())
    gradient = field.a.weight.grad
    assert gradient is not None
    assert bool((gradient[:, :3] == 3).all())
    assert bool((gradient[:, 3:] == 3 - reads).all())
    assert field.a.weight is field.b.weight


def test_a_parameter_that_modules_share_is_penalised_once() -> None:
    field = Tied()
    with gridreg.apply(
        field, gridreg.L1(gridreg.parameters("*.weight", dim=1), weight=1.0), total_steps=5
    ) as handle:
        torch.testing.assert_close(handle.loss(), field.a.weight.abs().mean())


@pytest.mark.parametrize("kind", ["named tuple", "dataclass"])
def test_an_output_is_taken_by_its_name(kind: str) -> None:
    class Pair(NamedTuple):
        a: Tensor
        b: Tensor

    @dataclass(frozen=True)
    class Both:
        a: Tensor
        b: Tensor

    make: Any = Pair if kind == "named tuple" else Both

    class Module(nn.Module):
        def forward(self, x: Tensor) -> Any:
            return make(x, x)

    field = Module()
    mask = gridreg.FixedMask(gridreg.outputs("", item="b"), visible_ratio=0.0)
    with gridreg.apply(field, mask, total_steps=5):
        found = field(torch.ones(2, 9))
    assert type(found) is make
    assert bool(found.a.all())
    assert not bool(found.b.any())


def test_lazy_modules_can_be_made_and_are_told_from_others() -> None:
    other = nn.Linear(9, 1)
    with gridreg.apply(other, gridreg.FrequencyMask(gridreg.parameters("weight", dim=1)), total_steps=5):
        field = nn.Sequential(nn.LazyLinear(9))
    with pytest.raises(gridreg.InputError, match=r"0\.weight: is lazy, without a shape"):
        gridreg.apply(field, gridreg.FixedMask(gridreg.parameters("0.weight", dim=0)), total_steps=5)
    with gridreg.apply(field, gridreg.FixedMask(gridreg.outputs("0"), visible_ratio=1 / 3), total_steps=5):
        assert int((field(torch.ones(1, 4)) != 0).sum()) == 3


def test_a_sparse_gradient_stays_sparse() -> None:
    field = nn.Embedding(64, 9, sparse=True)
    site = gridreg.parameters("weight", dim=1)
    with gridreg.apply(field, gridreg.FixedMask(site, visible_ratio=1 / 3), total_steps=5):
        field(torch.tensor([1, 2, 2])).sum().backward()
        gradient = dict(field.named_parameters())["weight"].grad
        assert gradient is not None
        assert gradient.is_sparse
        expected = torch.zeros(64, 9)
        expected[1, :3], expected[2, :3] = 1.0, 2.0
        assert torch.equal(gradient.to_dense(), expected)
        torch.optim.SparseAdam(list(field.parameters())).step()


def test_a_complex_grid_is_masked() -> None:
    field = nn.Module()
    field.register_parameter("grid", nn.Parameter(torch.full((9, 4), 1 + 2j)))
    mask = gridreg.FixedMask(gridreg.parameters("grid", dim=0), visible_ratio=1 / 3)
    with gridreg.apply(field, mask, total_steps=5):
        field.grid.abs().sum().backward()
        assert complex(field.grid.detach().sum()) == 12 + 24j


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_an_attached_field_is_traced() -> None:
    field = nn.Linear(9, 2)
    x = torch.randn(3, 9)
    site = gridreg.parameters("weight", dim=1)
    with gridreg.apply(field, gridreg.FixedMask(site, visible_ratio=1 / 3), total_steps=5):
        traced = torch.jit.trace(field, x)
        torch.testing.assert_close(traced(2 * x), field(2 * x))
