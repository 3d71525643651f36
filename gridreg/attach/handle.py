"""The handle of an applied composition: step, losses, hooks, saving, suspending and removing."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary, ref

import torch
from torch import Tensor, nn

from gridreg.attach._binding import Attachment, Binding
from gridreg.attach._table import table
from gridreg.base import LocalTerm, Regularizer
from gridreg.errors import InputError

if TYPE_CHECKING:
    from gridreg.samples import RaySamples

__all__ = ["Handle"]

# Weak both ways: a handle holds its field, so a strong handle here would keep the field alive for ever.
_HANDLES: WeakKeyDictionary[nn.Module, list[ref[Handle]]] = WeakKeyDictionary()


class Handle:
    """What `apply` returns: sets the step, gives the loss, and takes everything off again.

    Attributes:
        terms: weighted, detached parts of the last `loss`, by name; they sum to its value.
    """

    def __init__(self, attachment: Attachment) -> None:
        self.terms: dict[str, Tensor] = {}
        self._attachment = attachment
        self._removed = False
        _HANDLES.setdefault(attachment.field, []).append(ref(self))

    @property
    def regularizers(self) -> tuple[Regularizer, ...]:
        """What is applied, in order."""
        return tuple(binding.regularizer for binding in self._attachment.bindings)

    @property
    def total_steps(self) -> int:
        """Length of the run, iterations."""
        return self._attachment.clock.total_steps

    @property
    def current_step(self) -> int:
        """The step that was set last, iterations."""
        return self._attachment.clock.step

    def step(self, step: int) -> None:
        """Set the step that every schedule reads, iterations from 0.

        Raises:
            InputError: not a number from 0, or a schedule gives a value out of range at this step.
        """
        self._require_applied()
        if isinstance(step, bool) or not hasattr(step, "__index__") or step < 0:
            raise InputError(f"step={step!r}: expected a number of iterations from 0")
        self._attachment.clock.step = int(step)
        self._attachment.refresh()

    # --- losses ----------------------------------------------------------------------------------

    def loss(self, samples: RaySamples | None = None, *, exclude: Collection[str] = ()) -> Tensor:
        """Weighted sum of all penalties, differentiable; 0 if nothing contributes.

        Args:
            samples: of the batch; may be left out if no penalty reads them.
            exclude: names of penalties to leave out, see `grid_terms`.

        Raises:
            InputError: a penalty needs samples, or an attribute of them, that are not there.
        """
        bindings = self._bindings(Regularizer.penalty, Regularizer.grid_penalty)
        names = [binding.name for binding in bindings]
        unknown = sorted(set(exclude) - set(names))
        if unknown:
            raise InputError(f"exclude={unknown}: expected names of penalties, which are {names}")
        self._attachment.sync()
        self.terms = {}
        total = _zero(self._attachment.field, samples)
        for binding in bindings:
            if binding.name not in exclude:
                part = self._penalty(binding, samples)
                self.terms[binding.name] = part.detach()
                total = total + part
        return total

    def _penalty(self, binding: Binding, samples: RaySamples | None) -> Tensor:
        """Weighted penalty of one regularizer; at weight 0 it is not computed."""
        weight = _weight(binding)
        total = _zero(self._attachment.field, samples)
        if weight != 0 and binding.overrides(Regularizer.penalty):
            if samples is None:
                raise InputError(f"{binding.name}: needs samples; call handle.loss(samples)")
            for attribute in binding.regularizer.needs():
                if getattr(samples, attribute, None) is None:
                    raise InputError(
                        f"{binding.name}: needs samples.{attribute}, found None; "
                        "use a renderer that fills it in, or drop the regularizer"
                    )
            total = total + weight * binding.regularizer.penalty(samples, binding.context)
        if weight != 0 and binding.overrides(Regularizer.grid_penalty):
            total = total + weight * binding.regularizer.grid_penalty(binding.grids, binding.context)
        return total

    def grid_terms(self) -> list[LocalTerm]:
        """Penalties on grids that have a closed form, with their weights now, for a fused optimizer step.

        Pass the names of those that the optimizer took over to `loss(samples, exclude=names)`.
        """
        bindings = self._bindings(Regularizer.local_terms)
        self._attachment.sync()
        terms = []
        for binding in bindings:
            weight = _weight(binding)
            if weight != 0:
                for term in binding.regularizer.local_terms(binding.grids, binding.context):
                    terms.append(replace(term, name=binding.name, scale=term.scale * weight))
        return terms

    # --- hooks for a renderer and a trainer; each is a no-op if no regularizer plays the part ----

    def on_samples(self, samples: RaySamples) -> RaySamples:
        """The samples as compositing and losses are to see them."""
        for binding in self._bindings():
            samples = binding.regularizer.on_samples(samples, binding.context)
        return samples

    def background(
        self, count: int, generator: torch.Generator, default: Tensor | None = None
    ) -> Tensor | None:
        """Background colours `(count, 3)` behind training rays and their targets, or the default."""
        for binding in self._bindings():
            default = binding.regularizer.background(count, generator, default, binding.context)
        return default

    def near_far(self, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Interval of the training rays, world units, shapes `(R,)`."""
        for binding in self._bindings():
            near, far = binding.regularizer.near_far(near, far, binding.context)
        return near, far

    def parameter_groups(self, groups: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Parameter groups for an optimizer, split or changed; ask whenever one is made."""
        for binding in self._bindings():
            groups = binding.regularizer.parameter_groups(groups, binding.grids, binding.context)
        return groups

    def update_groups(self, groups: list[dict[str, Any]]) -> None:
        """Update what schedules drive in an optimizer's `param_groups`, in place; ask at each step."""
        for binding in self._bindings():
            binding.regularizer.update_groups(groups, binding.grids, binding.context)

    # --- suspending and removing -----------------------------------------------------------------

    @contextmanager
    def suspended(self) -> Iterator[Handle]:
        """The field as if nothing were attached, by this handle or another: for surgery such as resampling.

        Parameters, lists and submodules may be replaced; on leaving, everything is attached again, by name.
        """
        self._require_applied()
        handles = [handle for reference in _HANDLES[self._attachment.field] if (handle := reference())]
        for handle in handles:
            handle._attachment.suspend()
        try:
            yield self
        finally:
            for handle in handles:
                if not handle._removed:
                    handle._attachment.resume()

    def remove(self) -> None:
        """Take everything off: the field is what it would be without.

        Raises:
            InputError: removed before.
        """
        self._require_applied()
        self._attachment.detach()
        self._removed = True
        _HANDLES[self._attachment.field].remove(ref(self))

    def __enter__(self) -> Handle:
        self._require_applied()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._removed:
            self.remove()

    # --- saving and telling ----------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """The step, the random state and what the regularizers remember: numbers, text and tensors."""
        self._require_applied()
        clock = self._attachment.clock
        return {
            "step": clock.step,
            "total_steps": clock.total_steps,
            "regularizers": [binding.name for binding in self._attachment.bindings],
            "generator": clock.generator.get_state(),
            "state": self._attachment.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`, with the same regularizers on a field of the same sizes.

        Raises:
            InputError: the state is of other regularizers, another run length, or other tensors.
        """
        self._require_applied()
        own = self.state_dict()
        missing = sorted(set(own) - set(state))
        if missing:
            raise InputError(f"state: lacks {missing}; expected what handle.state_dict() gave")
        for key in ("regularizers", "total_steps"):
            found = list(state[key]) if isinstance(state[key], (list, tuple)) else state[key]
            if found != own[key]:
                raise InputError(f"state: {key} is {found}, expected {own[key]} as applied here")
        self._attachment.sync()
        self._attachment.clock.step = int(state["step"])
        self._attachment.load(state["state"])
        self._attachment.clock.generator.set_state(state["generator"])

    def values(self) -> dict[str, float]:
        """One number per regularizer for curves: the open share of a mask, the weight of a penalty."""
        return {binding.name: binding.value() for binding in self._bindings()}

    def masks(self) -> dict[str, Tensor]:
        """The masks of this step by regularizer name, each ``(channels,)``, for curves; a copy."""
        found = {}
        for binding in self._bindings():
            for _, slot in binding.slots:
                if "mask" in slot.context.state:
                    found[binding.name] = slot.context.state["mask"].clone()
                    break
        return found

    def __repr__(self) -> str:
        """A table: regularizer, site, channels, value now."""
        if self._removed:
            return "Handle(removed)"
        clock = self._attachment.clock
        title = (
            f"gridreg on {type(self._attachment.field).__name__}, step {clock.step} of {clock.total_steps}"
        )
        return (
            title
            + "\n"
            + table(("regularizer", "site", "channels", "value now"), map(_cells, self._bindings()))
        )

    def _bindings(self, *methods: Callable[..., object]) -> list[Binding]:
        """Rows whose regularizers override one of these methods, all without any."""
        self._require_applied()
        return [
            binding for binding in self._attachment.bindings if not methods or binding.overrides(*methods)
        ]

    def _require_applied(self) -> None:
        if self._removed:
            raise InputError("handle: it was removed; call gridreg.apply again for a new one")


def _weight(binding: Binding) -> float:
    """The weight of a penalty now."""
    try:
        return binding.context.at(getattr(binding.regularizer, "weight", 1.0), "weight", low=0.0)
    except InputError as error:
        raise InputError(f"{binding.name}: {error}") from None


def _zero(field: nn.Module, samples: RaySamples | None) -> Tensor:
    """The scalar 0 where the field computes."""
    first = next(field.parameters(), None) if samples is None else samples.density
    return torch.zeros((), device=None if first is None else first.device)


def _cells(binding: Binding) -> tuple[str, str, str, str]:
    """A regularizer's line in the table."""
    sizes = [match.place.channels for match, _ in binding.slots]
    counts = sorted({"?" if size is None else str(size) for size in sizes})
    channels = (f"{len(sizes)} x " if len(sizes) > 1 else "") + ", ".join(counts)
    value = "?" if math.isnan(binding.value()) else f"{binding.value():.4g}"
    return type(binding.regularizer).__name__, binding.label or "samples", channels or "-", value
