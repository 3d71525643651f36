"""Which regularizer of a handle acts on which tensors, kept up while the field changes."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from torch import Tensor, nn

from gridreg.attach._hooks import Slot, attach, detach
from gridreg.attach._resolve import Match, find
from gridreg.attach.sites import Grid, Selector, SiteLike
from gridreg.base import Clock, Context, Regularizer, overrides
from gridreg.errors import InputError

__all__ = ["READS_GRIDS", "Attachment", "Binding"]

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
    """

    name: str
    regularizer: Regularizer
    context: Context
    label: str
    matches: list[Match] = field(default_factory=list)
    slots: list[tuple[Match, Slot]] = field(default_factory=list)

    def overrides(self, *methods: Callable[..., object]) -> bool:
        """Whether the regularizer overrides one of these methods."""
        return any(overrides(self.regularizer, method) for method in methods)

    @property
    def grids(self) -> list[Grid]:
        """The raw grids of its site, as they are now."""
        return [grid for match in self.matches for grid in match.grids()]

    def value(self) -> float:
        """One number for tables and curves: the mean over its tensors; NaN until one has shown its width."""
        if not self.slots:
            return self.regularizer.value(self.context)
        sized = [slot.context for match, slot in self.slots if match.place.size is not None]
        values = [self.regularizer.value(context) for context in sized]
        return sum(values) / len(values) if values else float("nan")


class Attachment:
    """The regularizers of one handle on one field: attaches, detaches, and follows replaced parameters."""

    def __init__(self, module: nn.Module, regularizers: Sequence[Regularizer], clock: Clock) -> None:
        self.field = module
        self.clock = clock
        self.bindings = _bindings(regularizers, clock)
        self._owner = uuid.uuid4().hex
        # Contexts outlive slots, so that what a regularizer remembers survives replaced parameters.
        self._contexts: dict[tuple[str, str, str], Context] = {}
        self._structure: list[Any] = []
        self._suspensions = 0
        self.attach()

    def attach(self) -> None:
        """Find all sites and attach; the field is left alone if one of them does not fit."""
        resolved = [(binding, *self._resolved(binding)) for binding in self.bindings]
        for binding, matches, slots in resolved:
            binding.matches, binding.slots = matches, slots
            for match, slot in slots:
                attach(match, slot)
        # What belonged to tensors that are gone would not fit the field that loads the state.
        used = {id(slot.context) for binding in self.bindings for _, slot in binding.slots}
        self._contexts = {key: context for key, context in self._contexts.items() if id(context) in used}
        self._structure = _structure(self.field)

    def detach(self) -> None:
        """Take everything of this handle off, also off modules that were replaced since."""
        for module in [match.module for binding in self.bindings for match, _ in binding.slots]:
            detach(module, self._owner)

    def suspend(self) -> None:
        """Detach until as many calls of `resume`."""
        self._suspensions += 1
        if self._suspensions == 1:
            self.detach()

    def resume(self) -> None:
        """Undo one `suspend`."""
        self._suspensions -= 1
        if self._suspensions == 0:
            self.attach()

    def sync(self) -> None:
        """Attach anew if modules or parameters were replaced outside `suspended`."""
        if self._suspensions == 0 and self._structure != _structure(self.field):
            self.detach()
            self.attach()

    def refresh(self) -> None:
        """Bring all slots up to the clock's step."""
        self.sync()
        if self._suspensions == 0:
            for binding in self.bindings:
                with _naming(binding):
                    for _, slot in binding.slots:
                        slot.refresh()

    def _resolved(self, binding: Binding) -> tuple[list[Match], list[tuple[Match, Slot]]]:
        """The grids that a regularizer reads, and a slot for each tensor that it transforms."""
        matches: list[Match] = []
        slots: list[tuple[Match, Slot]] = []
        with _naming(binding):
            for site in binding.regularizer.sites():
                if binding.overrides(*READS_GRIDS):
                    matches += self._found(site, "grids")
                if binding.overrides(Regularizer.transform):
                    found = self._found(site, type(binding.regularizer).acts_on)
                    slots += [(match, self._slot(binding, match)) for match in found]
        return matches, slots

    def _found(self, site: SiteLike, part: Literal["mask", "grids"]) -> list[Match]:
        """Matches of a site, at least one."""
        matches = find(self.field, site, part)
        if not matches:
            wanted = "grid parameters" if part == "grids" else "a place for a mask"
            raise InputError(
                f"site={_label(site)!r}: has no {wanted}; use a site that does, see gridreg.sites_of"
            )
        return matches

    def _slot(self, binding: Binding, match: Match) -> Slot:
        """A slot with the context of this place, the one from before if the channels are the same."""
        key = (binding.name, match.place.kind, match.place.name)
        context = self._contexts.get(key)
        width = None if context is None or context.place is None else context.place.size
        if match.place.size is None and width is not None:
            match.place.complete(width)
        if context is None or context.place is None or context.place.channels != match.place.channels:
            context = self._contexts[key] = Context(self.clock)
        context.place = match.place
        slot = Slot(self._owner, binding.regularizer, context)
        slot.refresh(prepare=context.prepared_at != self.clock.step)
        return slot

    def state(self) -> dict[str, Tensor]:
        """What the regularizers remember, by "regularizer/kind/tensor/name"."""
        return {
            "/".join((*key, name)): tensor.detach().clone()
            for key, context in self._contexts.items()
            for name, tensor in context.state.items()
        }

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` gave, at the clock's step.

        Raises:
            InputError: an entry belongs to no regularizer or tensor of this handle, or has another shape.
        """
        entries = {tuple(key.rsplit("/", 1)): tensor for key, tensor in state.items()}
        known = {"/".join(key): context for key, context in self._contexts.items()}
        for (prefix, name), tensor in entries.items():
            if prefix not in known:
                raise InputError(f"state: found an entry for {prefix!r}, expected one of {sorted(known)}")
            own = known[prefix].state.get(name)
            if own is not None and own.shape != tensor.shape:
                raise InputError(
                    f"state: {prefix}/{name} has shape {tuple(tensor.shape)}, expected {tuple(own.shape)}"
                )
        for (prefix, name), tensor in entries.items():
            memory = known[prefix].state
            # In place, so that compiled code sees it.
            if name in memory:
                memory[name].copy_(tensor)
            else:
                memory[name] = tensor.detach().clone()
            known[prefix].prepared_at = self.clock.step
        for binding in self.bindings:
            for _, slot in binding.slots:
                slot.refresh(prepare=slot.context.prepared_at != self.clock.step)


class _naming:
    """Put the regularizer's name in front of errors raised inside."""

    def __init__(self, binding: Binding) -> None:
        self._name = binding.name

    def __enter__(self) -> None:
        """Nothing to do on entry."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, InputError) and not str(error).startswith(self._name):
            raise InputError(f"{self._name}: {error}") from error


def _structure(module: nn.Module) -> list[Any]:
    """All modules, with names and shapes of what they hold, to notice replacements."""
    return [
        (
            part,
            [(name, None if tensor is None else tensor.shape) for name, tensor in part._parameters.items()],
            [(name, None if tensor is None else tensor.shape) for name, tensor in part._buffers.items()],
        )
        for part in module.modules()
    ]


def _label(site: SiteLike) -> str:
    """A site as short text."""
    if isinstance(site, str):
        return site
    if isinstance(site, Selector):
        return site.pattern
    return ", ".join(selector.pattern for selector in site.selectors("mask") or site.selectors("grids"))


def _bindings(regularizers: Sequence[Regularizer], clock: Clock) -> list[Binding]:
    """A binding for each regularizer, with a name that no other has."""
    bindings: list[Binding] = []
    counts: dict[str, int] = {}
    for regularizer in regularizers:
        label = ", ".join(_label(site) for site in regularizer.sites())
        name = type(regularizer).__name__ + (f"({label})" if label else "")
        counts[name] = counts.get(name, 0) + 1
        if counts[name] > 1:
            name = f"{name} #{counts[name]}"
        bindings.append(Binding(name, regularizer, Context(clock), label))
    return bindings
