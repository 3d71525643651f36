"""Attaching to what submodules return and to what they are called with."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg import inputs, outputs
from tests.grids import HALF

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
        assert "?" in str(handle)
        assert field["part"](torch.ones(4)).sum() == 2
        assert field["part"](torch.ones(3, 10)).sum() == 15
        assert "10" in str(handle)
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
