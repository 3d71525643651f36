"""Base of all channel masks: ranks of channels, multiplication at a site, closed channels without effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from gridreg.attach.selectors import outputs
from gridreg.attach.sites import Place, SiteLike
from gridreg.base import Clock, Context, Regularizer
from gridreg.errors import InputError
from gridreg.regularizers.mask_functions import channel_ranks
from gridreg.schedules import check_until, drawing_axes, drawn_steps, fixed_end

_ALL = outputs("")


@dataclass(frozen=True)
class Mask(Regularizer):
    """Base of all masks. A subclass says how channels are ranked and what each rank is multiplied by.

    A closed channel has exactly no effect and no gradient, even where its values are infinite or not numbers.

    Args:
        site: where it acts: declared name, `parameters`, `outputs` or `inputs`.
        detach: closed channels keep their values and only lose their gradient.
    """

    site: SiteLike
    detach: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._until() is not None:
            check_until(self._until())

    def _until(self) -> Any:
        return getattr(self, "until", None)

    def ranks(self, place: Place) -> tuple[int, ...]:
        """Rank of each channel, low ranks open first: by octave where known, else by index."""
        return channel_ranks(place.octaves or tuple(range(place.channels or 0)))

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over `count` ranks, shape `(count,)`, at the context's step."""
        return torch.ones(count)

    def end(self, count: int, total_steps: int) -> int | None:
        """Step from which all of `count` ranks are open (that of `until`), None if that never is or cannot be told."""
        return None if self._until() is None else fixed_end(self._until(), total_steps)

    def monotone(self) -> bool:
        """Whether it never opens a higher rank more than a lower one, and never closes again."""
        return True

    def mask(self, context: Context) -> Tensor:
        """The mask over the channels that take part, shape `(channels,)`, float32."""
        if context.place is None:
            raise InputError("context: a mask has one only at a place")
        ranks = self.ranks(context.place)
        if not ranks:
            return torch.ones(0)
        return self.rank_values(max(ranks) + 1, context)[_indices(ranks)]

    def plot(self, channels: int | Sequence[int], total_steps: int, axes: Any = None) -> Any:
        """Draw the mask over a run, iteration to the right and channel upwards; return matplotlib's axes.

        Args:
            channels: how many there are, or the octave of each.
            total_steps: length of the run, iterations.
            axes: to draw on; None: new ones.

        Raises:
            InputError: matplotlib is not installed.
        """
        axes = drawing_axes(axes)
        size = channels if isinstance(channels, int) else len(channels)
        octaves = None if isinstance(channels, int) else tuple(channels)
        context = Context(Clock(total_steps, 0), Place("", _ALL, -1, octaves=octaves, size=size))
        masks = []
        for context.clock.step in (steps := drawn_steps(total_steps)):
            masks.append(self.mask(context))
        image = axes.pcolormesh(
            steps, range(size), torch.stack(masks, 1).numpy(), vmin=0, vmax=1, shading="nearest"
        )
        axes.figure.colorbar(image, ax=axes, label="mask")
        axes.set(xlabel="iteration", ylabel="channel")
        return axes

    def prepare(self, context: Context) -> None:
        """Keep the mask over all channels of the tensor in the state."""
        remember(context, "mask", spread(self.mask(context), context.place))

    def is_identity(self, context: Context) -> bool:
        """Fully open."""
        return bool((context.state["mask"] == 1).all())

    def is_over(self, context: Context) -> bool:
        """Past its end."""
        ranks = () if context.place is None else self.ranks(context.place)
        end = self.end(max(ranks, default=0) + 1, context.total_steps)
        return end is not None and context.step >= end

    def closed_channels(self, context: Context) -> Tensor | None:
        """Channels at which the mask is 0; not told of one grid of a stack."""
        closed: Tensor = context.state["mask"] <= 0
        return None if self.detach or _item(context) is not None else closed

    def transform(self, value: Tensor, context: Context) -> Tensor:
        """Multiply the channels by the mask."""
        mask = broadcast(context, "mask", value)
        if self.detach:
            scaled: Tensor = _ScaledGradient.apply(value, mask)  # type: ignore[no-untyped-call]
            return scaled
        # A product alone would let NaN and infinity through a closed channel.
        return torch.where(mask != 0, value * mask, 0.0)

    def value(self, context: Context) -> float:
        """Open fraction of the channels; 1 if there are none."""
        mask = self.mask(context)
        return float(mask.mean()) if len(mask) else 1.0


class _ScaledGradient(torch.autograd.Function):
    """The identity, with its gradient multiplied by a mask; under torch.func's transforms too."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, mask: Tensor) -> Tensor:
        """A copy of the value."""
        # No view: a network may write into it in place (nn.ReLU(inplace=True)).
        return value.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        """Keep the mask for both modes of differentiation."""
        ctx.save_for_backward(inputs[1])
        ctx.save_for_forward(inputs[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """The gradient times the mask."""
        (mask,) = ctx.saved_tensors
        return torch.where(mask != 0, gradient * mask, 0.0), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        """The tangent times the mask."""
        (mask,) = ctx.saved_tensors
        return torch.where(mask != 0, tangent * mask, 0.0)


@lru_cache(maxsize=256)
def _indices(values: tuple[int, ...]) -> Tensor:
    """Indices as a tensor: made once, because masks are made at every step."""
    return torch.tensor(values)


def spread(values: Tensor, place: Place | None) -> Tensor:
    """Factors of the channels that take part, spread over all channels of the tensor; the others get 1."""
    if place is None or place.selected is None or place.size is None:
        return values
    factors = torch.ones(place.size)
    factors[_indices(place.selected)] = values
    return factors


def remember(context: Context, name: str, value: Tensor) -> None:
    """Put a tensor into the state, in place if there is one of this shape: compiled code holds on to it."""
    known = context.state.get(name)
    if known is not None and known.shape == value.shape:
        known.copy_(value)
    else:
        context.state[name] = value


def broadcast(context: Context, name: str, value: Tensor) -> Tensor:
    """Factors from the state, shaped to multiply `value` along the channel axis of the context's place."""
    factors = context.state[name]
    if factors.device != value.device:
        factors = factors.to(value.device)
        if not value.is_meta and type(value) in (Tensor, nn.Parameter):
            # Not what a tracer made of it, nor without values on the meta device.
            context.state[name] = factors
    dim = -1 if context.place is None else context.place.dim
    if value.shape[dim] != len(factors):
        name = "" if context.place is None else context.place.name
        raise InputError(
            f"{name}: mask of {len(factors)} for {value.shape[dim]} channels; "
            "replace parameters inside handle.suspended(), or call handle.step after it"
        )
    # A copy, so that the next step may write into the state before this one's backward pass.
    factors = _along(factors.to(value.dtype, copy=True), dim, value)
    item = _item(context)
    if item is None or context.place is None or context.place.stack is None:
        return factors
    stack = context.place.stack
    others = torch.arange(value.shape[stack], device=value.device).ne(item)
    return torch.where(_along(others, stack, value), 1, factors)


def _item(context: Context) -> int | None:
    """The one grid of a stack that takes part; None: all do, or there is no stack."""
    item = None if context.place is None or context.place.stack is None else context.place.selector.item
    return item if isinstance(item, int) else None


def _along(factors: Tensor, dim: int, value: Tensor) -> Tensor:
    """A vector, shaped to multiply one axis of `value`."""
    return factors.reshape([-1 if axis == dim % value.ndim else 1 for axis in range(value.ndim)])
