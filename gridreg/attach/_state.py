"""Memories of the regularizers of a handle, to a flat dict of tensors and back, and masks written into parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gridreg.attach._binding import Binding
from gridreg.attach._resolve import raw_tensor
from gridreg.attach._slots import Slot
from gridreg.errors import InputError

Slots = Mapping[tuple[str, str, str], Slot]


def state_of(slots: Slots) -> dict[str, Tensor]:
    """Copies of all tensors in the slots' memories, by "regularizer/kind/tensor/name"."""
    return {
        "/".join((*key, name)): tensor.detach().clone()
        for key, slot in slots.items()
        for name, tensor in slot.context.state.items()
    }


def load_state(slots: Slots, state: Mapping[str, Tensor], step: int) -> None:
    """Restore what `state_of` gave, at a step; nothing is changed if an entry does not fit.

    Raises:
        InputError: an entry belongs to no regularizer or tensor of these slots, or has another shape.
    """
    entries = {tuple(key.rsplit("/", 1)): tensor for key, tensor in state.items()}
    known = {"/".join(key): slot.context for key, slot in slots.items()}
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
        known[prefix].prepared_at = step
    for slot in slots.values():
        slot.refresh(prepare=slot.context.prepared_at != step)


def bake(bindings: Sequence[Binding]) -> None:
    """Write what the field reads in eval mode into its parameters.

    Raises:
        InputError: an output or input of a module is transformed, which no parameter can hold.
    """
    for binding in bindings:
        if any(slot.active and match.place.kind != "parameters" for match, slot in binding.slots):
            raise InputError(
                f"{binding.name}: acts on the {binding.slots[0][0].place.kind} of a module, which no parameter can "
                "hold; name its columns with gridreg.parameters(...), or go on until it is fully open"
            )
    with torch.no_grad():
        for binding in bindings:
            done: set[int] = set()
            for match, slot in binding.slots:
                raw = raw_tensor(match.module, match.attribute)
                if id(raw) not in done:
                    raw.copy_(slot(raw, training=False))
                    done.add(id(raw))
