"""Places: the tensors that a selector matched, and the raw grids behind them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gridreg.attach.selectors import Kind, Selector, abridged
from gridreg.errors import InputError

__all__ = ["Grid", "Match", "Place", "raw_tensor"]


@dataclass
class Place:
    """One tensor that a selector matched.

    Attributes:
        name: dotted name on the field, unique within its kind.
        selector: what matched it.
        dim: channel axis; not negative for parameters, as given for outputs and inputs.
        spatial: spatial axes; empty for outputs and inputs.
        octaves: octave of each channel that takes part, None where the site knows none.
        size: length of the channel axis; None for outputs and inputs whose length shows at the first call.
        selected: indices of the channels that take part, None for all.
    """

    name: str
    selector: Selector
    dim: int
    spatial: tuple[int, ...] = ()
    octaves: tuple[int, ...] | None = None
    size: int | None = None
    selected: tuple[int, ...] | None = None

    @property
    def kind(self) -> Kind:
        """Whether it is a parameter, an output or an input."""
        return self.selector.kind

    @property
    def channels(self) -> int | None:
        """How many channels take part: the length of a mask at this place."""
        return self.size if self.selected is None else len(self.selected)

    def complete(self, size: int) -> None:
        """Fill in the length of the channel axis, once it is known.

        Raises:
            InputError: the selected channels do not exist, or the octaves do not number one per channel.
        """
        selected, spec = None, self.selector.channels
        if isinstance(spec, str):
            start, stop, *step = (int(part) if part else None for part in spec.split(":"))
            selected = tuple(range(size))[slice(start, stop, *step)]
            if not selected or (stop or 0) > size:
                raise InputError(f"channels={spec!r} of {self.selector}: {self.name} has {size} channels")
        elif spec is not None:
            selected = spec
            if max(spec) >= size:
                raise InputError(
                    f"channels={abridged(spec)} of {self.selector}: {self.name} has {size} channels"
                )
        count = size if selected is None else len(selected)
        if self.octaves is not None and len(self.octaves) != count:
            raise InputError(
                f"octaves of {self.selector}: found {len(self.octaves)}, "
                f"expected one for each of the {count} channels of {self.name}"
            )
        self.size, self.selected = size, selected


@dataclass(frozen=True, eq=False)
class Grid:
    """A raw grid parameter, as penalties and optimizer hooks see it.

    Attributes:
        name: dotted name on the field.
        parameter: the raw tensor, never masked or filtered.
        dim: channel axis.
        spatial: spatial axes.
        selected: indices of the channels that take part, None for all.
    """

    name: str
    parameter: Tensor
    dim: int
    spatial: tuple[int, ...]
    selected: tuple[int, ...] | None = None

    @property
    def values(self) -> Tensor:
        """The channels that take part, same axes as `parameter`."""
        if self.selected is None:
            return self.parameter
        return self.parameter.index_select(
            self.dim, torch.tensor(self.selected, device=self.parameter.device)
        )


@dataclass(eq=False)
class Match:
    """A place together with the module and the attribute that hold it."""

    place: Place
    module: nn.Module
    attribute: str

    def grid(self) -> Grid:
        """The raw tensor behind this place."""
        return Grid(
            self.place.name,
            raw_tensor(self.module, self.attribute),
            self.place.dim,
            self.place.spatial,
            self.place.selected,
        )


def raw_tensor(module: nn.Module, attribute: str) -> Tensor:
    """What `_parameters` or `_buffers` hold, past any property that is attached."""
    tensor: Tensor | None = module._parameters.get(attribute)
    if tensor is None:
        tensor = module._buffers.get(attribute)
    if tensor is None:
        raise InputError(f"{attribute}: no longer a parameter or buffer of {type(module).__name__}")
    return tensor
