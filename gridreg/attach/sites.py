"""Sites: tensors of a field that have a channel axis, as users and fields name them, and as regularizers see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, TypeAlias, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

from gridreg.attach.selectors import Kind, Selector, abridged
from gridreg.errors import InputError

# No grid has so many nodes along an edge: an axis beyond is the entries of a table.
_LONGEST_EDGE = 4096


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
        spatial: spatial axes; empty for outputs and inputs, and for tables.
        octaves: octave of each channel that takes part, None where the site knows none.
        size: length of the channel axis; None for outputs and inputs whose length shows at the first call.
        selected: indices of the channels that take part, None for all.
        stack: axis along which the tensor holds several grids, not negative; None: it is one.
    """

    name: str
    selector: Selector
    dim: int
    spatial: tuple[int, ...] = ()
    octaves: tuple[int, ...] | None = None
    size: int | None = None
    selected: tuple[int, ...] | None = None
    stack: int | None = None

    @property
    def kind(self) -> Kind:
        """Whether it is a parameter, an output or an input."""
        return self.selector.kind

    @property
    def channels(self) -> int | None:
        """Number of channels that take part: the length of a mask at this place."""
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
        dim: channel axis of `values`.
        spatial: spatial axes of `values`; none for a table, whose cells need not lie in space as in memory.
        selected: indices of the channels that take part, None for all.
        entry: where the parameter is a stack of grids: its axis, and the index of this one.
    """

    name: str
    parameter: Tensor = field(repr=False)
    dim: int
    spatial: tuple[int, ...]
    selected: tuple[int, ...] | None = None
    entry: tuple[int, int] | None = None

    @property
    def values(self) -> Tensor:
        """The grid with the channels that take part; the axes of `parameter`, without that of a stack."""
        grid = self.parameter if self.entry is None else self.parameter.select(*self.entry)
        if self.selected is None:
            return grid
        return grid.index_select(self.dim, torch.tensor(self.selected, device=grid.device))

    @property
    def whole(self) -> bool:
        """Whether this is all of its parameter."""
        return self.selected is None and self.entry is None


def spatial_axes(
    tensor: Tensor, dim: int, spatial: tuple[int, ...] | None, stack: int | None
) -> tuple[int, ...]:
    """Spatial axes of a grid: given, or after a leading channel axis, or before a trailing one; none of a table."""
    if spatial is not None:
        return tuple(sorted(axis % tensor.ndim for axis in spatial))
    leading = dim in (0, 1) and dim != tensor.ndim - 1
    axes = [axis for axis in (range(dim + 1, tensor.ndim) if leading else range(dim)) if axis != stack]
    entries_by_features = dim == tensor.ndim - 1 and len(axes) == 1
    if entries_by_features or any(tensor.shape[axis] > _LONGEST_EDGE for axis in axes):
        return ()
    return tuple(axis for axis in axes if tensor.shape[axis] > 1)


NOT_NEGATIVE = (0.0, float("inf"))
"""A range for `within`."""


def within(**ranges: tuple[float, float]) -> Mapping[str, tuple[float, float]]:
    """Lowest and highest values by the name of a field: for `Regularizer.ranges`."""
    return ranges


@lru_cache
def choices_of(cls: type[object]) -> dict[str, tuple[str, ...]]:
    """Fields that are one of several texts, by their annotation."""
    try:
        hints = get_type_hints(cls)
    except NameError:  # Names that are imported for type checkers alone.
        return {}
    return {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Literal}


def check_site(value: object) -> None:
    """Refuse what is not a site.

    Raises:
        InputError: naming the value and the four ways to name a site.
    """
    if not isinstance(value, (str, Selector, Site)):
        raise InputError(
            f"site={abridged(value)}: expected the name of a declared site, or "
            "gridreg.parameters(...), gridreg.outputs(...) or gridreg.inputs(...)"
        )
