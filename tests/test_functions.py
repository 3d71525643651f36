"""Regularizers made of plain functions."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from tests.oracles import make_batch

LINES = gridreg.parameters("lines.*", dim=0)


class Field(nn.Module):
    """Two lines."""

    def __init__(self) -> None:
        super().__init__()
        self.lines = nn.ParameterList([torch.full((2, 4), 3.0), torch.full((2, 5), -2.0)])


def cubed(values: Tensor) -> Tensor:
    """A function at the top of a module."""
    return values.abs() ** 3


def loss(regularizer: gridreg.Regularizer, samples: Any = None) -> Tensor:
    with gridreg.apply(Field(), regularizer, total_steps=10) as handle:
        return handle.loss(samples)


def test_a_function_of_grids_is_averaged_and_added() -> None:
    assert loss(gridreg.from_function(cubed, where=LINES, weight=2.0)).item() == 2 * (27 + 8)


def test_a_function_of_the_samples_or_of_one_attribute() -> None:
    samples = make_batch(0, 4, 5).samples()
    whole = gridreg.from_function(lambda s: s.depth * s.opacity)
    torch.testing.assert_close(loss(whole, samples), (samples.depth * samples.opacity).mean())
    part = gridreg.from_function(torch.exp, "samples.depth", weight=0.5)
    torch.testing.assert_close(loss(part, samples), 0.5 * samples.depth.exp().mean())


def test_what_can_be_imported_goes_to_plain_data_and_back() -> None:
    for made in (gridreg.from_function(cubed, LINES), gridreg.from_function(cubed, "samples.weights")):
        (plain,) = gridreg.to_config([made])
        assert plain["function"] == f"{__name__}:cubed"
        assert gridreg.from_config([plain]) == [made]
    assert gridreg.from_function(f"{__name__}:cubed", LINES) == gridreg.from_function(cubed, LINES)
    with pytest.raises(
        gridreg.InputError, match=r"GridFunction.function=.*has no plain form; .*top of a module"
    ):
        gridreg.to_config([gridreg.from_function(lambda x: x, LINES)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3,), "function=3: expected a function of one argument, or 'module:name'"),
        (("no_such_module:f",), "function='no_such_module:f': expected 'module:name' of a function"),
        (("torch:nothing",), "function='torch:nothing'"),
        (("torch",), "function='torch'"),
        (("torch:pi",), "expected a function of one argument"),
        ((cubed, "samples.dept"), "where='samples.dept': .* did you mean 'depth'"),
        ((cubed, 3), "site=3: expected the name of a declared site"),
        ((cubed, LINES, -1.0), "weight=-1"),
    ],
)
def test_what_is_no_penalty_is_refused(arguments: tuple[Any, ...], message: str) -> None:
    function, where, weight = (*arguments, *("samples", 1.0)[len(arguments) - 1 :])
    with pytest.raises(gridreg.InputError, match=message):
        gridreg.from_function(function, where, weight=weight)


def test_a_result_that_is_no_tensor_is_refused() -> None:
    with pytest.raises(gridreg.InputError, match="returned float, expected a tensor"):
        loss(gridreg.from_function(lambda values: 1.0, LINES))  # type: ignore[arg-type, return-value]
    assert loss(gridreg.from_function(lambda values: values[:, :0], LINES)).item() == 0
