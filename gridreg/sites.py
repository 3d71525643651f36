"""Sites: places on a field where features with a channel axis live, and how to name them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor, nn

from gridreg.errors import InputError

__all__ = [
    "Grid",
    "Match",
    "Place",
    "Selector",
    "Site",
    "SiteLike",
    "inputs",
    "outputs",
    "parameters",
    "raw_tensor",
]

Kind: TypeAlias = Literal["parameters", "outputs", "inputs"]


@dataclass(frozen=True)
class Selector:
    """Tensors of a field by name: parameters (or buffers), outputs of submodules, or inputs of submodules.

    Made by `parameters`, `outputs` and `inputs`; compares by value and goes to plain data and back.
    """

    kind: Kind
    pattern: str
    dim: int
    channels: tuple[int, ...] | str | None = None
    octaves: tuple[int, ...] | None = None
    spatial: tuple[int, ...] | None = None
    item: int | str | None = None

    def __str__(self) -> str:
        """As the user wrote it, without what is at its default."""
        text = f"{self.kind}({self.pattern!r}, dim={self.dim}"
        if self.channels is not None:
            text += f", channels={abridged(self.channels)}"
        return text + (")" if self.octaves is None else ", octaves=...)")


@dataclass(frozen=True)
class Site:
    """A site that a field declares: where a channel mask acts, and the raw grids for penalties and
    low-passes.

    Args:
        mask: selectors whose channels a mask multiplies. Masking one factor of a product (the lines of a
            plane-line product) masks the product.
        grids: selectors of the raw tensors behind the site; `None` means those of `mask` that are parameters.
    """

    mask: Selector | Sequence[Selector] = ()
    grids: Selector | Sequence[Selector] | None = None

    def __post_init__(self) -> None:
        """Tuples, so that sites compare by value."""
        object.__setattr__(self, "grids", self.selectors("grids"))
        object.__setattr__(self, "mask", self.selectors("mask"))

    def selectors(self, part: Literal["mask", "grids"]) -> tuple[Selector, ...]:
        """The selectors of one part."""
        chosen = self.mask if part == "mask" else self.grids
        if chosen is None:
            return tuple(selector for selector in self.selectors("mask") if selector.kind == "parameters")
        return (chosen,) if isinstance(chosen, Selector) else tuple(chosen)


SiteLike: TypeAlias = str | Selector | Site
"""What a regularizer accepts as a site: a declared name, a selector, or a `Site`."""


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


def parameters(
    glob: str,
    dim: int,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    spatial: Sequence[int] | None = None,
) -> Selector:
    """Site: parameters (or, where no parameter matches, buffers) whose dotted names match `glob`.

    A channel mask on a grid parameter equals the mask on the features interpolated from it.

    Args:
        glob: `*` and `?` stay within one dotted part; where nothing matches so, they cross dots.
        dim: the channel axis.
        channels: channels that take part, as a slice or indices; all by default.
        octaves: octave of each channel that takes part (-1: the identity), where channels are an encoding.
        spatial: spatial axes; by default those after a leading `dim`, those before a trailing one, without
            axes of length 1.

    >>> print(parameters("density_line.*", dim=1))
    parameters('density_line.*', dim=1)
    """
    return _selector("parameters", glob, dim, channels, octaves, spatial, None)


def outputs(
    glob: str,
    dim: int = -1,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    item: int | str | None = None,
) -> Selector:
    """Site: what submodules return whose dotted names match `glob` (`""` is the field itself).

    Only calls count (`encoder(x)`), not `encoder.forward(x)`. Arguments as in `parameters`; `item` is the
    index or key where a module returns a tuple or a dict.
    """
    return _selector("outputs", glob, dim, channels, octaves, None, item)


def inputs(
    glob: str,
    dim: int = -1,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    item: int | str | None = None,
) -> Selector:
    """Site: what submodules are called with, for encodings that are computed in a plain function.

    Arguments as in `outputs`; `item` is the position or keyword of the argument, by default the first tensor.

    >>> print(inputs("mlp.0", channels=slice(30, 150)))
    inputs('mlp.0', dim=-1, channels='30:150')
    """
    return _selector("inputs", glob, dim, channels, octaves, None, item)


def _selector(
    kind: Kind,
    glob: str,
    dim: int,
    channels: slice | Sequence[int] | str | None,
    octaves: Sequence[int] | None,
    spatial: Sequence[int] | None,
    item: int | str | None,
) -> Selector:
    """Check and normalise the arguments of the three functions above."""
    if not isinstance(glob, str):
        raise InputError(f"{kind}({glob!r}): expected a name or glob as text")
    if isinstance(dim, bool) or not isinstance(dim, int):
        raise InputError(f"{kind}({glob!r}, dim={dim!r}): expected the channel axis as an int")
    return Selector(
        kind,
        glob,
        dim,
        channels=_normalised_channels(channels),
        octaves=None if octaves is None else tuple(int(octave) for octave in octaves),
        spatial=None if spatial is None else tuple(int(axis) for axis in spatial),
        item=item,
    )


def _normalised_channels(channels: slice | Sequence[int] | str | None) -> tuple[int, ...] | str | None:
    """A slice as text ("30:150", so that it goes to plain data), indices as a tuple."""
    if channels is None:
        return None
    if isinstance(channels, slice):
        parts = ["" if part is None else str(part) for part in (channels.start, channels.stop, channels.step)]
        return ":".join(parts if parts[2] else parts[:2])
    if isinstance(channels, str):
        if not re.fullmatch(r"(-?\d+)?:(-?\d+)?(:(-?\d+)?)?", channels):
            raise InputError(f"channels={channels!r}: expected a slice as text, such as '30:150'")
        return channels
    indices = tuple(int(channel) for channel in channels)
    if not indices or len(set(indices)) != len(indices) or min(indices) < 0:
        raise InputError(f"channels={abridged(indices)}: expected distinct indices from 0")
    return indices


def abridged(values: object) -> str:
    """Short text for an error or a table."""
    text = repr(values)
    return text if len(text) <= 40 else text[:36] + "...)"
