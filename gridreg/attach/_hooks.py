"""Transforms attached to the tensors of a module that is not ours, and taken off without a trace.

A parameter (or buffer) is attached to by a property on a subclass of the module's own class, made for this
one instance. The property reads what `_parameters` holds and transforms it; so names, `state_dict`,
optimizers and assignments go on working with the raw tensor. Outputs and inputs of submodules are attached to
by forward hooks. All state lives in the module's own `__dict__` and hook dictionaries, which is why copies
and pickles of the module carry it along.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, MutableMapping
from functools import cache
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.nn.parameter import is_lazy
from torch.optim.optimizer import register_optimizer_step_pre_hook

from gridreg.attach._instance_class import STACKS, set_instance_class
from gridreg.attach._slots import MADE, Slot, Stack, masked_parameter
from gridreg.errors import InputError


class Hook:
    """Base of both hooks: a slot, and which tensor of several passes through it."""

    def __init__(self, slot: Slot, item: int | str | None) -> None:
        self.slot, self.item = slot, item


class OutputHook(Hook):
    """Forward hook that passes a module's output, or one item of it, through a slot."""

    def __call__(self, module: nn.Module, arguments: Any, output: Any) -> Any:
        """The changed output, or None to leave it alone."""
        return _changed(self.slot, module, output, self.item)


class InputHook(Hook):
    """Forward pre-hook that passes one argument of a module, by default its first tensor, through a slot."""

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
    # An entry of a named tuple, a dataclass, ...
    named = isinstance(item, str) and not isinstance(value, Mapping)
    try:
        if named:
            tensor = getattr(value, str(item), None)
        else:
            tensor = value if isinstance(value, Tensor) and item is None else value[item]
    except (TypeError, KeyError, IndexError):
        tensor = None
    if not isinstance(tensor, Tensor):
        name = "a module" if place is None else f"{place.kind}({place.name!r})"
        found = sorted(value) if isinstance(value, Mapping) else type(value).__name__
        raise InputError(
            f"{name}: no tensor at item={item!r} of {found}; say with item=... which one to take"
        )
    slot.check(tensor)
    result = slot(tensor, module.training)
    if result is tensor:
        return None
    if isinstance(value, Tensor):
        return result
    if isinstance(value, MutableMapping):
        changed = copy.copy(value)
        changed[item] = result
        return changed
    if named:
        if hasattr(value, "_replace"):
            return value._replace(**{str(item): result})
        changed = copy.copy(value)
        object.__setattr__(changed, str(item), result)
        return changed
    # From the end as well: item=-1 is the last one.
    items = list(value)
    items[item] = result  # type: ignore[index]
    return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)


def attach(module: nn.Module, attribute: str, slot: Slot) -> None:
    """Let `slot` transform a parameter of this name, or what a module takes or returns, after what is there already.

    Raises:
        InputError: the module is of a class that cannot be extended.
    """
    place = slot.context.place
    assert place is not None
    if isinstance(module, torch.jit.ScriptModule):
        raise InputError(
            f"{place.name}: belongs to a TorchScript module, whose reads nobody sees; "
            "attach to a module around it, or script a field without regularizers"
        )
    if place.kind == "outputs":
        module.register_forward_hook(OutputHook(slot, place.selector.item))
    elif place.kind == "inputs":
        module.register_forward_pre_hook(InputHook(slot, place.selector.item), with_kwargs=True)
    else:
        _watch_torch()
        stacks = module.__dict__.setdefault(STACKS, {})
        stacks[attribute] = Stack((*stacks.get(attribute, ()), slot))
    try:
        _update_class(module)
    except TypeError as error:
        raise InputError(f"{place.name}: cannot attach to a {type(module).__name__}: {error}") from error


def detach(module: nn.Module, owner: str | None) -> list[tuple[nn.Module, str, Slot]]:
    """Take the slots of one owner (None: of all) off a module, whose class is the original again with the last one.

    Returns:
        The arguments of `attach` that put each back.
    """
    taken: list[tuple[nn.Module, str, Slot]] = []
    stacks: dict[str, Stack] | None = module.__dict__.get(STACKS)
    if stacks is not None:
        for attribute, stack in list(stacks.items()):
            stack.forget()
            gone = [slot for slot in stack if owner in (None, slot.owner)]
            taken += [(module, attribute, slot) for slot in gone]
            # A new stack, so that a compiled graph or a copy that holds the old one does not change underneath.
            rest = tuple(slot for slot in stack if slot not in gone)
            stacks[attribute] = Stack(rest)
            if not rest:
                del stacks[attribute]
        if not stacks:
            del module.__dict__[STACKS]
    for hooks, extra in (
        (module._forward_hooks, module._forward_hooks_with_kwargs),
        (module._forward_pre_hooks, module._forward_pre_hooks_with_kwargs),
    ):
        for key, hook in list(hooks.items()):
            if isinstance(hook, Hook) and owner in (None, hook.slot.owner):
                taken.append((module, "", hook.slot))
                del hooks[key]
                extra.pop(key, None)
    _update_class(module)
    return taken


def _update_class(module: nn.Module) -> None:
    """Give a module the class for what is attached to it now."""
    attached = next(slots_of(module), None) is not None
    set_instance_class(module, tuple(sorted(module.__dict__.get(STACKS, ()))) if attached else None)


@cache
def _watch_torch() -> None:
    """From the first masked parameter on, see where torch is handed a masked tensor in the place of a parameter."""
    register_module_parameter_registration_hook(_parameter_registered)  # type: ignore[arg-type]
    register_optimizer_step_pre_hook(_optimizer_steps)


def _parameter_registered(module: nn.Module, name: str, parameter: Tensor | None) -> Tensor | None:
    """A parameter made of a masked tensor becomes the raw parameter, read through the same stack.

    Slices and copies of a `ParameterList` or `ParameterDict` make such parameters in the middle of a forward pass:
    torch would cut their gradient off.
    """
    if parameter is None or is_lazy(parameter) or parameter.is_meta or not parameter.numel():
        return None
    for stack in tuple(MADE):
        made = stack.made
        if made is not None and parameter.data_ptr() == made.data_ptr() and parameter.shape == made.shape:
            module.__dict__.setdefault(STACKS, {})[name] = stack
            _update_class(module)
            return masked_parameter(made)
    return None


_CHECKED: WeakSet[torch.optim.Optimizer] = WeakSet()


def _optimizer_steps(optimizer: torch.optim.Optimizer, arguments: Any, keywords: Any) -> None:
    """Refuse, at its first step, an optimizer that was given masked tensors, which it would change in vain."""
    if optimizer in _CHECKED:
        return
    if any(masked_parameter(p) is not None for group in optimizer.param_groups for p in group["params"]):
        raise InputError(
            "optimizer: it holds masked tensors, not parameters; make it of handle.parameter_groups(groups), "
            "of field.parameters(), or inside handle.suspended()"
        )
    _CHECKED.add(optimizer)


def strip(module: nn.Module) -> None:
    """Take everything off a module, whoever attached it: for copies and unpickled fields without a handle."""
    for submodule in module.modules():
        detach(submodule, None)


def slots_of(module: nn.Module) -> Iterator[Slot]:
    """All slots on one module, for inspection."""
    for stack in module.__dict__.get(STACKS, {}).values():
        yield from stack
    for hook in (*module._forward_hooks.values(), *module._forward_pre_hooks.values()):
        if isinstance(hook, Hook):
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
    closed = []
    for slot in stacks.get(name, ()):
        slot.read = True
        if slot.active and slot.closed is not None:
            closed.append(slot.closed)
    if not closed:
        return None
    together = closed[0] if len(closed) == 1 else bytes(map(max, *closed))
    first, last, _ = (channels or slice(None)).indices(len(together))
    opened = max(0, together.rfind(b"\0", first, last) + 1 - first)
    return None if opened == last - first else opened
