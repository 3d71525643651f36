"""Checks of a regularizer's arguments when it is made."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Literal, get_args, get_origin, get_type_hints

from gridreg.attach.selectors import Selector, abridged
from gridreg.attach.sites import Site
from gridreg.errors import InputError

__all__ = ["NOT_NEGATIVE", "check_site", "choices_of", "within"]

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
