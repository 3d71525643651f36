"""Regularizers made of plain functions."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gridreg.attach.sites import Grid, SiteLike
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError, near_names
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric

Function: TypeAlias = Callable[[Any], Tensor]


def from_function(
    function: Function | str, where: SiteLike = "samples", *, weight: Numeric = 1.0
) -> Regularizer:
    """A penalty made of a plain function, such as those of `gsplat.losses`.

    Args:
        function: takes one argument and returns a tensor, whose mean is the penalty; or text, ``"module:name"``. One
            that can be imported goes to plain data and back.
        where: what the function is given. "samples": the `RaySamples`; "samples.depth": that attribute of them; a
            site: the raw values of each of its grids, over which the penalty is added.
        weight: factor of the loss.

    Raises:
        InputError: the function cannot be called or found, or there is no such attribute.

    Example:
        >>> import gridreg
        >>> cubed = gridreg.from_function(lambda values: values.abs() ** 3, where=gridreg.parameters("line", dim=0))
        >>> field = torch.nn.ParameterDict({"line": torch.full((2, 5), 2.0)})
        >>> with gridreg.apply(field, cubed, total_steps=10) as handle:
        ...     handle.loss().item()
        8.0
    """
    name = f"{getattr(function, '__module__', None)}:{getattr(function, '__qualname__', None)}"
    try:
        kept = name if not isinstance(function, str) and _found(name) is function else function
    except InputError:
        kept = function
    if isinstance(where, str) and where.partition(".")[0] == "samples":
        return SamplesFunction(kept, where, weight)
    return GridFunction(kept, where, weight)


def _found(function: Any) -> Function:
    """The function itself, or that of a module.

    Raises:
        InputError: there is none.
    """
    found = function
    if isinstance(function, str):
        module, _, path = function.partition(":")
        try:
            found = attrgetter(path)(importlib.import_module(module))
        except (ImportError, AttributeError, ValueError) as error:
            raise InputError(
                f"function={function!r}: expected 'module:name' of a function ({error})"
            ) from None
    if not callable(found):
        raise InputError(f"function={function!r}: expected a function of one argument, or 'module:name'")
    checked: Function = found
    return checked


@dataclass(frozen=True)
class _FunctionPenalty(Regularizer):
    """Base of the two: the function, found and reduced."""

    function: Function | str

    def __post_init__(self) -> None:
        super().__post_init__()
        _found(self.function)

    def _value(self, argument: Any) -> Tensor:
        value = _found(self.function)(argument)
        if not isinstance(value, Tensor):
            raise InputError(f"{self.function}: returned {type(value).__name__}, expected a tensor")
        return value.mean() if value.numel() else value.sum()


@register
@dataclass(frozen=True)
class SamplesFunction(_FunctionPenalty):
    """A function of the samples, or of one attribute of them, is penalised: see `from_function`.

    Args:
        function: takes what `where` says and returns a tensor; or ``"module:name"``.
        where: "samples", or an attribute: "samples.depth", "samples.weights", ...
        weight: factor of the loss.

    Formula: ``mean(f(samples))``
    Unit: the function's
    Source: the function's
    """

    where: str = "samples"
    weight: Numeric = 1.0
    example_arguments = (
        {"function": "torch:square", "where": "samples.opacity"},
        {"function": "gridreg.regularizers.density:cauchy_sparsity"},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        head, _, attribute = self.where.partition(".")
        names = (*RaySamples.__dataclass_fields__, "opacity", "depth")
        if head != "samples" or (attribute and attribute not in names):
            raise InputError(
                f"where={self.where!r}: expected 'samples', or 'samples.' and one of {', '.join(names)}"
                f"{near_names(attribute, names)}"
            )

    def needs(self) -> tuple[str, ...]:
        """The attribute, if samples may lack it."""
        item = RaySamples.__dataclass_fields__.get(self.where.partition(".")[2])
        return () if item is None or item.default is not None else (item.name,)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """Mean of what the function returns."""
        attribute = self.where.partition(".")[2]
        return self._value(getattr(samples, attribute) if attribute else samples)


@register
@dataclass(frozen=True)
class GridFunction(_FunctionPenalty):
    """A function of the values of the site's grids is penalised: see `from_function`.

    Args:
        function: takes a grid's values and returns a tensor; or ``"module:name"``.
        site: its `grids` are penalised.
        weight: factor of the loss.

    Formula: ``sum over grids of mean(f(g))``
    Unit: the function's
    Source: the function's
    """

    site: SiteLike = "density"
    weight: Numeric = 1.0
    example_arguments = ({"function": "torch:square"},)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """Mean of what the function returns, added over the grids."""
        return torch.stack([self._value(grid.values) for grid in grids]).sum()
