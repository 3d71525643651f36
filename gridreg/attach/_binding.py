"""One regularizer of a handle: its name, the tensors that it reads and transforms, and whether it has acted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from gridreg.attach._resolve import Match
from gridreg.attach._slots import Slot
from gridreg.attach.selectors import Selector
from gridreg.attach.sites import Grid, SiteLike
from gridreg.base import Clock, Context, Regularizer, overrides
from gridreg.errors import InputError

READS_GRIDS = (
    Regularizer.grid_penalty,
    Regularizer.local_terms,
    Regularizer.parameter_groups,
    Regularizer.update_groups,
)
"""Methods that are given the raw grids of a site."""


@dataclass
class Binding:
    """One regularizer of a handle.

    Attributes:
        name: "TotalVariation(density)"; a second one of the same name gets " #2".
        regularizer: the configuration.
        context: for penalties and hooks; transforms have one per tensor.
        label: its sites as text.
        matches: grids that it reads.
        slots: what it transforms.
        asked: whether the handle was asked for its part in a loss, the samples, the optimizer, ...
    """

    name: str
    regularizer: Regularizer
    context: Context
    label: str
    matches: list[Match] = field(default_factory=list)
    slots: list[tuple[Match, Slot]] = field(default_factory=list)
    asked: bool = False

    def overrides(self, *methods: Callable[..., object]) -> bool:
        """Whether the regularizer overrides one of these methods."""
        return any(overrides(self.regularizer, method) for method in methods)

    @property
    def grids(self) -> list[Grid]:
        """The raw grids of its site, as they are now."""
        return [grid for match in self.matches for grid in match.grids()]

    @property
    def idle(self) -> str:
        """Why it has had no effect yet: which of its tensors nobody read, or that nobody asked; "" if it acted."""
        unread = [match.place.name or "the field" for match, slot in self.slots if not slot.read]
        if unread:
            all_of_them = len(unread) == len(self.slots)
            return "not read yet" if all_of_them else f"not read yet: {', '.join(unread[:6])}"
        return "" if self.slots or self.asked else "not asked yet"

    def value(self) -> float:
        """One number for tables and curves: the mean over its tensors; NaN until one has shown its width."""
        if not self.slots:
            return self.regularizer.value(self.context)
        sized = [slot.context for match, slot in self.slots if match.place.size is not None]
        values = [self.regularizer.value(context) for context in sized]
        return sum(values) / len(values) if values else float("nan")

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Put the regularizer's name in front of errors raised inside."""
        try:
            yield
        except InputError as error:
            if str(error).startswith(self.name):
                raise
            raise InputError(f"{self.name}: {error}") from error


def site_label(site: SiteLike) -> str:
    """A site as short text."""
    if isinstance(site, str):
        return site
    if isinstance(site, Selector):
        return site.pattern
    return ", ".join(selector.pattern for selector in site.selectors("mask") or site.selectors("grids"))


def bindings_of(regularizers: Sequence[Regularizer], clock: Clock) -> list[Binding]:
    """A binding for each regularizer, with a name that no other has."""
    bindings: list[Binding] = []
    counts: dict[str, int] = {}
    for regularizer in regularizers:
        label = ", ".join(site_label(site) for site in regularizer.sites())
        name = type(regularizer).__name__ + (f"({label})" if label else "")
        counts[name] = counts.get(name, 0) + 1
        if counts[name] > 1:
            name = f"{name} #{counts[name]}"
        bindings.append(Binding(name, regularizer, Context(clock), label))
    return bindings
