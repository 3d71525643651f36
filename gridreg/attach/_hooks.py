"""Attaching transforms to the tensors of a module that is not ours, and taking them off without a trace.

A parameter (or buffer) is attached to by a property on a subclass of the module's own class, made for this
one instance. The property reads what `_parameters` holds and transforms it; so names, `state_dict`,
optimizers and assignments go on working with the raw tensor. Outputs and inputs of submodules are attached to
by forward hooks. All state lives in the module's own `__dict__` and hook dictionaries, which is why copies
and pickles of the module carry it along.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from gridreg.attach._instance_class import STACKS, set_instance_class
from gridreg.attach._resolve import Match
from gridreg.base import Context, Regularizer
from gridreg.errors import InputError

__all__ = ["Slot", "attach", "detach", "open_channels", "strip"]


class Slot:
    """One regularizer at one tensor: what is attached, and whether it does anything at this step.

    Attributes:
        owner: token of the handle that it belongs to.
        active: False while the transform is the identity and is skipped.
        closed: a byte for each channel of the tensor, 1 where it is exactly 0; None if that is not known.
    """

    def __init__(self, owner: str, regularizer: Regularizer, context: Context) -> None:
        self.owner = owner
        self.regularizer = regularizer
        self.context = context
        self.train_only = type(regularizer).train_only
        self.active = True
        self.closed: bytes | None = None

    def refresh(self, prepare: bool = True) -> None:
        """Bring the slot up to the context's step, if its channels are known yet."""
        place = self.context.place
        if place is None or place.size is None:
            return
        if prepare and not self.active and self.regularizer.is_over(self.context):
            self.context.prepared_at = self.context.step
            return
        if prepare:
            # A state made in inference mode could not be updated outside it.
            with torch.inference_mode(False):
                self.regularizer.prepare(self.context)
            self.context.prepared_at = self.context.step
        self.active = not self.regularizer.is_identity(self.context)
        closed = self.regularizer.closed_channels(self.context) if self.active else None
        self.closed = None if closed is None else closed.cpu().numpy().tobytes()

    def __call__(self, value: Tensor, training: bool) -> Tensor:
        """The transformed tensor, or `value` itself."""
        if not self.active or (self.train_only and not training):
            return value
        return self.regularizer.transform(value, self.context)

    def check(self, value: Tensor) -> None:
        """Learn the number of channels at the first call, and follow it if it changes."""
        place = self.context.place
        if place is None:
            return
        if not -value.ndim <= place.dim < value.ndim:
            raise InputError(
                f"dim={place.dim} of {place.selector}: {place.name} has shape {tuple(value.shape)}"
            )
        size = value.shape[place.dim]
        if place.size != size:
            # A state that was loaded before the first call is not to be drawn anew.
            fresh = place.size is not None or self.context.prepared_at != self.context.step
            place.complete(size)
            self.refresh(prepare=fresh)


class OutputHook:
    """Forward hook that passes a module's output, or one item of it, through a slot."""

    def __init__(self, slot: Slot, item: int | str | None) -> None:
        self.slot, self.item = slot, item

    def __call__(self, module: nn.Module, arguments: Any, output: Any) -> Any:
        """The changed output, or None to leave it alone."""
        return _changed(self.slot, module, output, self.item)


class InputHook:
    """Forward pre-hook that passes one argument of a module, by default its first tensor, through a slot."""

    def __init__(self, slot: Slot, item: int | str | None) -> None:
        self.slot, self.item = slot, item

    def __call__(self, module: nn.Module, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        """The changed arguments, or None to leave them alone."""
        item: int | str | None = self.item
        if item is None:
            item = next((i for i, value in enumerate(arguments) if isinstance(value, Tensor)), None)
        if item is None:
            item = next((name for name, value in keywords.items() if isinstance(value, Tensor)), None)
        if isinstance(item, str):
            changed = _changed(self.slot, module, keywords, item)
            return None if changed is None else (arguments, changed)
        changed = _changed(self.slot, module, arguments, item)
        return None if changed is None else (changed, keywords)


def _changed(slot: Slot, module: nn.Module, value: Any, item: int | str | None) -> Any:
    """`value`, a tensor or a container, with one tensor passed through the slot; None if nothing changes."""
    place = slot.context.place
    try:
        tensor = value if isinstance(value, Tensor) and item is None else value[item]
    except (TypeError, KeyError, IndexError):
        tensor = None
    if not isinstance(tensor, Tensor):
        name = "a module" if place is None else f"{place.kind}({place.name!r})"
        found = sorted(value) if isinstance(value, dict) else type(value).__name__
        raise InputError(
            f"{name}: no tensor at item={item!r} of {found}; say with item=... which one to take"
        )
    slot.check(tensor)
    result = slot(tensor, module.training)
    if result is tensor:
        return None
    if isinstance(value, Tensor):
        return result
    if isinstance(value, dict):
        return {**value, item: result}
    items = [result if i == item else other for i, other in enumerate(value)]
    return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)


def attach(match: Match, slot: Slot) -> None:
    """Let `slot` transform the tensor of a match from now on, after whatever is attached there already."""
    if match.place.kind == "outputs":
        match.module.register_forward_hook(OutputHook(slot, match.place.selector.item))
    elif match.place.kind == "inputs":
        match.module.register_forward_pre_hook(InputHook(slot, match.place.selector.item), with_kwargs=True)
    else:
        stacks = match.module.__dict__.setdefault(STACKS, {})
        stacks.setdefault(match.attribute, []).append(slot)
    _update_class(match.module)


def detach(module: nn.Module, owner: str | None) -> None:
    """Take the slots of one owner (None: of all) off a module; with the last one its class is the original
    again."""
    stacks: dict[str, list[Slot]] | None = module.__dict__.get(STACKS)
    if stacks is not None:
        for attribute, slots in list(stacks.items()):
            # A new list, so that a compiled graph or a copy that holds the old one does not change
            # underneath.
            stacks[attribute] = [slot for slot in slots if owner is not None and slot.owner != owner]
            if not stacks[attribute]:
                del stacks[attribute]
        if not stacks:
            del module.__dict__[STACKS]
    for hooks, extra in (
        (module._forward_hooks, module._forward_hooks_with_kwargs),
        (module._forward_pre_hooks, module._forward_pre_hooks_with_kwargs),
    ):
        for key, hook in list(hooks.items()):
            if isinstance(hook, (OutputHook, InputHook)) and owner in (None, hook.slot.owner):
                del hooks[key]
                extra.pop(key, None)
    _update_class(module)


def _update_class(module: nn.Module) -> None:
    """Give a module the class for what is attached to it now."""
    attached = next(slots_of(module), None) is not None
    set_instance_class(module, tuple(sorted(module.__dict__.get(STACKS, ()))) if attached else None)


def strip(module: nn.Module) -> None:
    """Take everything off a module, whoever attached it: for copies and unpickled fields without a handle."""
    for submodule in module.modules():
        detach(submodule, None)


def slots_of(module: nn.Module) -> Iterator[Slot]:
    """All slots on one module, for inspection."""
    for slots in module.__dict__.get(STACKS, {}).values():
        yield from slots
    for hook in (*module._forward_hooks.values(), *module._forward_pre_hooks.values()):
        if isinstance(hook, (OutputHook, InputHook)):
            yield hook.slot


def open_channels(module: nn.Module, name: str, channels: slice | None = None) -> int | None:
    """Channels of a parameter that a field need not read: those at and beyond this index are closed by a
    mask.

    Cheap enough for a hot path: what a mask closes is found once per step.

    Args:
        module: the module that holds the parameter, or one above it.
        name: the parameter's name from there ("0" in a `ParameterList`, "density_lines.0" from the field).
        channels: look at this part alone, such as ``slice(27, 81)``; the index counts from its start.

    Returns:
        The index, or None if nothing is attached or no channel at the end is closed.
    """
    if "." in name:
        path, _, name = name.rpartition(".")
        module = module.get_submodule(path)
    stacks = module.__dict__.get(STACKS)
    if stacks is None:
        return None
    closed = [slot.closed for slot in stacks.get(name, ()) if slot.active and slot.closed is not None]
    if not closed:
        return None
    together = closed[0] if len(closed) == 1 else bytes(map(max, *closed))
    first, last, _ = (channels or slice(None)).indices(len(together))
    opened = max(0, together.rfind(b"\0", first, last) + 1 - first)
    return None if opened == last - first else opened
