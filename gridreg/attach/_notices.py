"""Warnings that come unasked: one where something attached does not do what it seems to."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from gridreg.attach._hooks import slots_of
from gridreg.attach._slots import COPIES, Stack
from gridreg.attach._snapshot import MaskedTensor
from gridreg.schedules import Schedule, fixed_end

if TYPE_CHECKING:
    from gridreg.attach._attachment import Attachment


class AttachWarning(UserWarning):
    """Something attached does not do what it seems to; the text says what to do."""


LOOKS = 8
"""Steps from one look for writes past torch's counting to the next."""

PATIENCE = 3
"""Steps after which a regularizer that has had no effect is named."""


def _warn(text: str) -> None:
    # From here to whoever called apply or a method of the handle.
    warnings.warn(text, AttachWarning, stacklevel=5)


def at_apply(attachment: Attachment) -> None:
    """Warn about schedules that end after the run, and about a regularizer that is on the field already."""
    total = attachment.clock.total_steps
    for binding in attachment.bindings:
        for entry in fields(binding.regularizer):
            value = getattr(binding.regularizer, entry.name)
            until = getattr(value, "until", None) if isinstance(value, Schedule) else value
            if (isinstance(value, Schedule) or entry.name == "until") and value != entry.default:
                end = None if until is None else fixed_end(until, total)
                if end is not None and end > total:
                    _warn(
                        f"{binding.name}: {entry.name} ends at step {end}, after the run of total_steps={total}"
                    )
        if any(slot.matches(other) for match, slot in binding.slots for other in slots_of(match.module)):
            _warn(
                f"{binding.name}: acts on this {type(attachment.field).__name__} already, and both do; remove() the "
                "handle that was applied before, or take off what a copied field brought along with gridreg.strip"
            )


def at_step(attachment: Attachment, steps: int) -> None:
    """Warn once, after some steps, about what has had no effect in them."""
    idle = [f"{b.name} {b.idle}" for b in attachment.bindings if b.idle] if steps == PATIENCE else []
    if idle:
        _warn(
            f"{'; '.join(idle)}: without effect in {steps} steps. Parameters are read as attributes of their module, "
            "outputs and inputs in calls (module(x), not module.forward(x)); losses and optimizers ask the handle"
        )


def stale_copies(attachment: Attachment) -> bool:
    """Warn about a copy of the field whose masks stay behind those of the field; whether there is one."""
    for copied in tuple(COPIES):
        for binding in attachment.bindings:
            for _, slot in binding.slots:
                if copied.owner == slot.owner and slot.matches(copied, own=True):
                    mine, theirs = slot.context.state, copied.context.state
                    if any(
                        n in theirs and not torch.equal(v, theirs[n].to(v.device)) for n, v in mine.items()
                    ):
                        _warn(
                            f"{binding.name}: a copy of the field (copy.deepcopy, AveragedModel) stays as at step "
                            f"{copied.context.step}; handle.follow(copy) keeps it up, gridreg.strip(copy) takes it off"
                        )
                        return True
    return False


def replaced(
    before: Mapping[tuple[str, str], tuple[Tensor, bytes | None]],
    after: Mapping[tuple[str, str], MaskedTensor],
) -> None:
    """Warn about parameters that were replaced while masked, unless new ones show that they come from raw ones."""
    lost = [
        f"{name} ({regularizer})"
        for (regularizer, name), (old, closed) in before.items()
        if (new := after.get((regularizer, name))) is not None
        and new.raw is not old
        and new.slot.read
        and not _made_of_raw(new, closed)
    ]
    if lost:
        _warn(
            f"{', '.join(lost)}: replaced outside handle.suspended(). What was computed from a masked parameter holds "
            "the mask for good. Write `with handle.suspended(): ...` around it, or, where somebody else calls the "
            "method, handle.suspends('path.of.method') after gridreg.apply"
        )


def _made_of_raw(new: MaskedTensor, closed: bytes | None) -> bool:
    """Whether a new parameter has values in channels that a mask had closed."""
    place = new.slot.context.place
    if closed is None or place is None or new.raw.is_meta or new.raw.shape[place.dim] != len(closed):
        return False
    channels = torch.tensor(list(closed), dtype=torch.bool, device=new.raw.device)
    return bool(new.raw.detach().movedim(place.dim, 0)[channels].any())


def written(stack: Stack) -> None:
    """Warn about values that were written into a masked tensor, and so into nothing that lasts."""
    if stack.written:
        stack.written = False
        place = next(iter(stack)).context.place
        _warn(
            f"{'' if place is None else place.name}: something wrote in place into the masked tensor that the field "
            "reads, which leaves the parameter as it was; write inside handle.suspended()"
        )


def baked(tensors: Mapping[tuple[str, str], MaskedTensor]) -> None:
    """Warn about parameters that were overwritten with what the field reads, closed channels and all."""
    lost = [
        f"{name} ({regularizer})" for (regularizer, name), (raw, slot) in tensors.items() if slot.lost(raw)
    ]
    if lost:
        _warn(
            f"{', '.join(lost)}: a closed channel had values, and is all 0 now. What wrote the masked values into the "
            "parameter made the mask permanent; read and write inside handle.suspended()"
        )


def dropped(names: Sequence[str], field: nn.Module | None) -> None:
    """Warn that a field is bare again because nobody kept its handle."""
    _warn(
        f"{', '.join(names)}: the handle was dropped, so {type(field).__name__} is bare again; keep what gridreg.apply "
        "returns, or call handle.remove() or handle.bake() at the end"
    )
