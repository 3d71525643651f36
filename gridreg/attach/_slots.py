"""Slots: one regularizer at one tensor each, and the stack of slots that a parameter is read through."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn

from gridreg.base import Context, Regularizer
from gridreg.errors import InputError

_MASKED = "_gridreg_parameter"
"""Attribute of a masked tensor: the parameter that it was made of."""


class Slot:
    """One regularizer at one tensor: what is attached, and whether it does anything at this step.

    Attributes:
        owner: token of the handle that it belongs to.
        active: False while the transform is the identity and is skipped.
        closed: a byte for each channel of the tensor, 1 where it is exactly 0; None if that is not known.
        read: whether the field has read the tensor through it since this was last set to False.
    """

    def __init__(self, owner: str, regularizer: Regularizer, context: Context) -> None:
        self.owner = owner
        self.regularizer = regularizer
        self.context = context
        self.train_only = type(regularizer).train_only
        self.active = True
        self.closed: bytes | None = None
        self.read = False
        self._filled = -1

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Made by copying or unpickling: nobody steps it, unless its handle came along."""
        self.__dict__.update(state)
        COPIES.add(self)

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

    def matches(self, other: Slot, own: bool = False) -> bool:
        """Whether another slot has the same regularizer at a tensor of this name, of another owner or of the own."""
        mine, place = self.context.place, other.context.place
        return (
            self is not other
            and (self.owner == other.owner) == own
            and self.regularizer == other.regularizer
            and mine is not None
            and place is not None
            and (mine.kind, mine.name.rpartition(".")[2]) == (place.kind, place.name.rpartition(".")[2])
        )

    def __call__(self, value: Tensor, training: bool) -> Tensor:
        """The transformed tensor, or `value` itself."""
        self.read = True
        if not self.active or (self.train_only and not training):
            return value
        return self.regularizer.transform(value, self.context)

    def lost(self, raw: Tensor) -> bool:
        """Whether a channel that is closed had values when this was asked last, and has none in the parameter now."""
        channel = -1 if self.closed is None else self.closed.rfind(b"\1")
        if channel < 0 or raw.is_meta or self.context.place is None:
            return False
        filled = bool(raw.detach().select(self.context.place.dim, channel).any())
        before, self._filled = self._filled, channel if filled else -1
        return not filled and before == channel

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


COPIES: WeakSet[Slot] = WeakSet()
"""Slots made by copying or unpickling a field."""


class Stack:
    """The slots that act on one parameter, in order, and the tensor that they made of it last.

    A field may read its parameter many times in a step (a hash table for each of eight corners). The transform
    is computed once: until the next step, the next backward pass or a change of the parameter, the same masked
    tensor is handed out. That a second backward pass of the same step finds its graph is `_Shared`'s work.

    Attributes:
        slots: in order.
        keep: above 0 inside `handle.cached()`: tensors made without gradients are handed out again as well.
        written: whether somebody wrote into a masked tensor, which no parameter will ever see.
        looks: whether to look for writes that torch does not count (into `.data`), by a few values.
    """

    def __init__(self, slots: tuple[Slot, ...]) -> None:
        self.slots = slots
        self.keep = 0
        self.written = False
        self.looks = False
        self._made: Tensor | None = None
        self._key: tuple[Any, ...] = ()
        self._version = 0
        self._some: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the masked tensor, which torch cannot copy."""
        return {**Stack(self.slots).__dict__}

    def __iter__(self) -> Iterator[Slot]:
        return iter(self.slots)

    @property
    def made(self) -> Tensor | None:
        """The tensor that was handed out last, if it may still be in use; notices who wrote into it."""
        if self._made is not None and self._made._version != self._version:
            self.written, self._made = True, None
        return self._made

    def forget(self) -> None:
        """Make the tensor anew at the next read."""
        if self.made is not None and self._some is not None:
            self.written |= not torch.allclose(_some(self._made), self._some, 0, 0, equal_nan=True)
        self._made = self._some = None

    def __call__(self, raw: Tensor, training: bool) -> Tensor:
        """The tensor that the field sees instead of its parameter, or the parameter itself."""
        acting = False
        for slot in self.slots:
            slot.read = True
            acting = acting or (slot.active and (training or not slot.train_only))
        if not acting:
            return raw
        if torch.compiler.is_compiling() or not _plain(raw):
            return self._through(raw, training)
        gradient = torch.is_grad_enabled() and raw.requires_grad
        autocast = raw.device.type in ("cpu", "cuda") and torch.is_autocast_enabled(raw.device.type)
        key = (id(raw), raw._version, raw.data_ptr(), raw.dtype, training, gradient, autocast)
        made = self.made
        if made is None or key != self._key or not (gradient or self.keep):
            made = _shared(self, raw, training) if gradient else self._through(raw, training)
            if made is raw:
                return raw
            setattr(made, _MASKED, raw)
            self.forget()
            self._made, self._key, self._version = made, key, made._version
            self._some = _some(made) if self.looks and not made.is_meta else None
            MADE.add(self)
        return made

    def _through(self, value: Tensor, training: bool) -> Tensor:
        """The tensor after all transforms."""
        for slot in self.slots:
            value = slot(value, training)
        return value


def _some(made: Tensor | None) -> Tensor:
    """A copy of a few values, evenly spread."""
    assert made is not None
    values = made.detach().flatten()
    return (
        values[torch.linspace(0, len(values) - 1, 64, device=made.device).long()] if len(values) else values
    )


MADE: WeakSet[Stack] = WeakSet()
"""Stacks that have handed out a masked tensor."""


def masked_parameter(value: object) -> Tensor | None:
    """The parameter that a masked tensor was made of; None for any other object."""
    found: Tensor | None = getattr(value, _MASKED, None)
    return found


def _plain(raw: Tensor) -> bool:
    """Whether a tensor made of `raw` now may be handed out again: nothing traces, batches or captures the read."""
    return (
        type(raw) is nn.Parameter
        and not torch.is_inference_mode_enabled()
        and not raw.is_inference()
        and not torch._C._are_functorch_transforms_active()
        and torch._C._get_tracing_state() is None
        and torch._C._len_torch_dispatch_stack() == 0
        and not (raw.is_cuda and torch.cuda.is_current_stream_capturing())
    )


def _shared(stack: Stack, raw: Tensor, training: bool) -> Tensor:
    """The masked tensor with a gradient, made to be read and passed backward through any number of times."""
    # Checkpointing counts the tensors that a forward pass saves, and must not count those made once a step.
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x, lambda x: x):
        source = raw.view_as(raw)
        target = stack._through(source, training)
    if target is source or not target.requires_grad:
        return raw if target is source else target
    made: Tensor = _Shared.apply(raw, _Holder(stack, source, target))  # type: ignore[no-untyped-call]
    return made


class _Holder:
    """Keeps tensors from autograd's sight: as arguments of a Function they would become its inputs."""

    def __init__(self, stack: Stack, source: Tensor, target: Tensor) -> None:
        self.stack, self.source, self.target = stack, source, target


class _Shared(torch.autograd.Function):
    """A transformed parameter whose own small graph outlives a backward pass.

    Two losses may read one masked tensor and be differentiated one after the other, as they could read one
    parameter; torch would free the transform's graph after the first.
    """

    @staticmethod
    def forward(ctx: Any, raw: Tensor, holder: _Holder) -> Tensor:
        """The transformed tensor, without its graph."""
        ctx.holder = holder
        return holder.target.detach()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None]:
        """The parameter's gradient, through the graph that is kept."""
        holder = ctx.holder
        holder.stack.forget()
        # Of an embedding with few rows read, which torch.where would not take.
        rows = gradient.sparse_dim() if gradient.is_sparse else 0
        gradient = gradient.to_dense() if rows else gradient
        # Through `source` to the parameter, so that second derivatives are right as well.
        (found,) = torch.autograd.grad(
            holder.target,
            holder.source,
            gradient,
            retain_graph=True,
            create_graph=torch.is_grad_enabled(),
            allow_unused=True,
        )
        return found.to_sparse(rows) if rows and found is not None else found, None
