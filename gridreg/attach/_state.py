"""What the regularizers of a handle remember, as a flat dict of tensors and back."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from gridreg.attach._slots import Slot
from gridreg.errors import InputError

__all__ = ["load_state", "state_of"]

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
