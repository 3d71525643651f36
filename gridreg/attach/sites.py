"""Sites: places on a field where features with a channel axis live, and how to name them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from gridreg.attach._places import Grid, Match, Place, raw_tensor
from gridreg.attach.selectors import Selector, inputs, outputs, parameters

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
