"""The regularizers of one handle on one field: attached, detached, and kept up while the field changes."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any
from weakref import WeakSet, ref

from torch import Tensor, nn

from gridreg.attach import _notices
from gridreg.attach._binding import READS_GRIDS, Binding, bindings_of, site_label
from gridreg.attach._hooks import attach, detach
from gridreg.attach._instance_class import STACKS
from gridreg.attach._methods import SuspendingMethod, resume, wrap
from gridreg.attach._resolve import Match, Part, find
from gridreg.attach._slots import Slot, Stack
from gridreg.attach._snapshot import Snapshot
from gridreg.attach._state import bake, load_state, state_of
from gridreg.attach.sites import SiteLike
from gridreg.base import Clock, Context, Regularizer
from gridreg.errors import InputError

Key = tuple[str, str, str]

_NUMBERS = count()
_LIVE: WeakSet[Attachment] = WeakSet()
"""All attachments that a handle holds; weak, because each holds its field."""


class Attachment:
    """The regularizers of one handle on one field, and on copies that follow it.

    Attributes:
        field: the module that they were applied to.
        clock: step, run length and random generator.
        bindings: one for each regularizer, in order.
        removed: taken off for good.
    """

    def __init__(self, module: nn.Module, regularizers: Sequence[Regularizer], clock: Clock) -> None:
        self.field = module
        self.clock = clock
        self.bindings = bindings_of(regularizers, clock)
        self.removed = False
        self._owner = uuid.uuid4().hex
        # Slots outlive what they are attached to, so that what a regularizer remembers survives replaced parameters.
        self._slots: dict[Key, Slot] = {}
        self._placed: list[tuple[Match, Slot]] = []
        self._snapshot: Snapshot | None = None
        self._suspensions = 0
        self._steps = 0
        self._told = False
        self._methods: list[str] = []
        self._wrapped: list[SuspendingMethod] = []
        self._followers: list[ref[nn.Module]] = []
        self.attach()
        self._enlist()
        _notices.at_apply(self)

    def _enlist(self) -> None:
        self._number = next(_NUMBERS)
        _LIVE.add(self)

    # --- attaching -------------------------------------------------------------------------------

    def attach(self) -> None:
        """Find all sites and attach; the field is left alone if one of them does not fit."""
        resolved = [(binding, *self._resolved(binding)) for binding in self.bindings]
        for binding, matches, slots in resolved:
            binding.matches, binding.slots = matches, slots
        # What belonged to tensors that are gone would not fit the field that loads the state.
        used = {id(slot) for binding in self.bindings for _, slot in binding.slots}
        self._slots = {key: slot for key, slot in self._slots.items() if id(slot) in used}
        copies = self._copies()
        self._placed = []
        try:
            for binding in self.bindings:
                with binding.naming():
                    for match, slot in binding.slots + self._on_copies(binding, copies):
                        self._placed.append((match, slot))
                        attach(match.module, match.attribute, slot)
            self._wrapped = [wrap(self, self.field, name) for name in self._methods]
        except BaseException:
            self.detach()
            raise
        self._snapshot = Snapshot(self.modules().values(), self.bindings)

    def detach(self) -> None:
        """Take everything of this handle off, also off modules that were replaced since."""
        for method in self._wrapped:
            method.unwrap()
        modules = {id(match.module): match.module for match, _ in self._placed}
        for module in {**modules, **self.modules()}.values():
            detach(module, self._owner)
        self._placed, self._wrapped = [], []

    def remove(self) -> None:
        """Take everything off for good."""
        self.detach()
        self.removed = True
        _LIVE.discard(self)

    def names(self) -> list[str]:
        """Names of the regularizers."""
        return [binding.name for binding in self.bindings]

    def modules(self) -> dict[int, nn.Module]:
        """All modules of the field and of the copies that follow it, by identity."""
        return {id(module): module for field in (self.field, *self._copies()) for module in field.modules()}

    def _copies(self) -> list[nn.Module]:
        """The copies that follow the field and are still there."""
        return [copy for follower in self._followers if (copy := follower()) is not None]

    def _resolved(self, binding: Binding) -> tuple[list[Match], list[tuple[Match, Slot]]]:
        """The grids that a regularizer reads, and a slot for each tensor that it transforms."""
        matches: list[Match] = []
        slots: list[tuple[Match, Slot]] = []
        with binding.naming():
            for site in binding.regularizer.sites():
                if binding.overrides(*READS_GRIDS):
                    matches += self._found(self.field, site, "grids", once=True)
                if binding.overrides(Regularizer.transform):
                    found = self._found(self.field, site, type(binding.regularizer).acts_on)
                    slots += [(match, self._slot(binding, match)) for match in found]
        return matches, slots

    def _found(self, field: nn.Module, site: SiteLike, part: Part, once: bool = False) -> list[Match]:
        """Matches of a site, at least one."""
        matches = find(field, site, part, once)
        if not matches:
            wanted = "grid parameters" if part == "grids" else "a place for a mask"
            raise InputError(
                f"site={site_label(site)!r}: has no {wanted}; use a site that does, see gridreg.sites_of"
            )
        return matches

    def _slot(self, binding: Binding, match: Match) -> Slot:
        """The slot of this tensor: the one from before if the channels are the same."""
        place = match.place
        key = (binding.name, place.kind, place.name)
        slot = self._slots.get(key)
        before = None if slot is None else slot.context.place
        if place.size is None and before is not None and before.size is not None:
            place.complete(before.size)
        if slot is None or before is None or before.channels != place.channels:
            slot = self._slots[key] = Slot(self._owner, binding.regularizer, Context(self.clock))
        slot.context.place = place
        slot.refresh(prepare=slot.context.prepared_at != self.clock.step)
        return slot

    # --- following the field ---------------------------------------------------------------------

    def sync(self) -> None:
        """Attach anew if modules or parameters were replaced outside `suspended`; warn where a mask went into them."""
        if self._suspensions or (self._snapshot is not None and self._snapshot.holds()):
            return
        before = {} if self._snapshot is None else self._snapshot.masked
        self.detach()
        self.attach()
        assert self._snapshot is not None
        _notices.replaced(before, self._snapshot.tensors)

    def refresh(self) -> None:
        """Bring all slots up to the clock's step."""
        _notices.at_step(self, self._steps)
        self._steps += 1
        self.sync()
        if self._steps == 1:
            # Reads before the first step may have been an optimizer's or a summary's.
            for slot in self._slots.values():
                slot.read = False
        if self._suspensions:
            return
        for binding in self.bindings:
            with binding.naming():
                for _, slot in binding.slots:
                    slot.refresh()
        looks = self._steps % _notices.LOOKS == 1
        for stack in self.stacks():
            stack.forget()
            _notices.written(stack)
            stack.looks = looks
        if looks and self._snapshot is not None:
            _notices.baked(self._snapshot.tensors)
        self._told = self._told or _notices.stale_copies(self)

    def stacks(self) -> list[Stack]:
        """The stacks that its slots stand in."""
        found = (match.module.__dict__.get(STACKS, {}).get(match.attribute) for match, _ in self._placed)
        return [stack for stack in found if stack is not None]

    def follow(self, copy: nn.Module) -> None:
        """Let a copy of the field be read through the slots of this one, from now on and after each `attach`."""
        for binding in self.bindings:
            with binding.naming():
                self._on_copies(binding, [copy])
        if all(copy is not known for known in self._copies()):
            self._followers.append(ref(copy))
        if not self._suspensions:
            self.detach()
            self.attach()

    def _on_copies(self, binding: Binding, copies: Sequence[nn.Module]) -> list[tuple[Match, Slot]]:
        """A binding's slots at the same tensors of the copies."""
        placed: list[tuple[Match, Slot]] = []
        if binding.slots:
            part = type(binding.regularizer).acts_on
            for copy in copies:
                matches = [m for site in binding.regularizer.sites() for m in self._found(copy, site, part)]
                own = [match.place.channels for match, _ in binding.slots]
                if len(own) != len(matches) or any(
                    m.place.channels not in (None, channels) for m, channels in zip(matches, own, strict=True)
                ):
                    raise InputError(
                        f"follow: {type(copy).__name__} has other tensors than the field; copy it anew"
                    )
                placed += zip(matches, (slot for _, slot in binding.slots), strict=True)
        return placed

    # --- suspending ------------------------------------------------------------------------------

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Nothing is attached to the field, what holds it, and what it holds or shares, whoever attached it."""
        own = self.modules()
        related = [a for a in _LIVE if a is self or not own.keys().isdisjoint(a.modules())]
        related.sort(key=lambda attachment: attachment._number)
        for attachment in related:
            attachment._suspensions += 1
            if attachment._suspensions == 1:
                attachment.detach()
        # Left are slots without a handle, of copies and unpickled fields.
        orphans = [entry for module in own.values() for entry in detach(module, None)]
        try:
            yield
        except BaseException:
            resume(related, orphans)
            raise
        error = resume(related, orphans)
        if error is not None:
            raise error

    def suspends(self, name: str) -> None:
        """Wrap a method so that it always runs inside `suspended`."""
        method = wrap(self, self.field, name)
        if name in self._methods or self._suspensions:
            method.unwrap()
        else:
            self._wrapped.append(method)
        self._methods = list(dict.fromkeys([*self._methods, name]))

    def bake(self) -> None:
        """Write what the field reads in eval mode into its parameters, and take everything off."""
        bake(self.bindings)
        self.remove()

    # --- saving ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """The memory of the regularizers, by "regularizer/kind/tensor/name"."""
        return state_of(self._slots)

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` gave, at the clock's step; refused if it is of other regularizers or tensors."""
        load_state(self._slots, state, self.clock.step)
        for stack in self.stacks():
            stack.forget()

    def __getstate__(self) -> dict[str, Any]:
        """The part that can be copied: a copy of a handle belongs to the copy of the field that comes with it."""
        return {**self.__dict__, "_snapshot": None, "_followers": [], "_suspensions": 0}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # An owner of its own, so that neither handle takes off what the other attached.
        self._owner = uuid.uuid4().hex
        for slot in self._slots.values():
            slot.owner = self._owner
        self._enlist()

    def __del__(self) -> None:
        """The handle was dropped: take off what nobody could take off any more, and say so if it was never kept."""
        if sys.is_finalizing() or not self.__dict__.get("_snapshot") or self.removed:
            return
        names, field = self.names(), ref(self.field)
        # At the end of a program or a function, a handle may well go before its field.
        used = self._steps or any(binding.asked for binding in self.bindings)
        replaced = any(a.field is self.field and a.names() == names for a in _LIVE)
        self.detach()
        self.__dict__.clear()
        if field() is not None and not replaced and not used:
            _notices.dropped(names, field())
