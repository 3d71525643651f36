"""The parts of a handle that a trainer asks for: losses, samples, backgrounds and optimizer groups."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from gridreg.attach._attachment import Attachment
from gridreg.attach._binding import Binding
from gridreg.attach._slots import masked_parameter
from gridreg.base import LocalTerm, Regularizer
from gridreg.errors import InputError

if TYPE_CHECKING:
    from gridreg.samples import RaySamples


class HandleParts:
    """Base of `Handle`: each method does nothing unless a regularizer overrides its counterpart.

    Attributes:
        terms: weighted, detached parts of the last `loss`, by name; they sum to its value.
    """

    def __init__(self, attachment: Attachment, skipped: Sequence[Regularizer] = ()) -> None:
        self.terms: dict[str, Tensor] = {}
        self._attachment, self._skipped = attachment, tuple(skipped)

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
        for binding in self._bindings(Regularizer.on_samples):
            samples = binding.regularizer.on_samples(samples, binding.context)
        return samples

    def background(
        self, count: int, generator: torch.Generator, default: Tensor | None = None
    ) -> Tensor | None:
        """Background colours `(count, 3)` behind training rays and their targets, or the default."""
        for binding in self._bindings(Regularizer.background):
            default = binding.regularizer.background(count, generator, default, binding.context)
        return default

    def near_far(self, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Interval of the training rays, world units, shapes `(R,)`."""
        for binding in self._bindings(Regularizer.near_far):
            near, far = binding.regularizer.near_far(near, far, binding.context)
        return near, far

    def parameter_groups(self, groups: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Parameter groups for an optimizer, split or changed; ask whenever one is made.

        Groups may hold what the field reads (``{"params": self.density_line}``, TensoRF's
        `get_optparam_groups`): masked tensors are replaced by their parameters. A single tensor is a list of one.
        """
        mapped = [{**group, "params": _parameters(group["params"])} for group in groups]
        if any(a["params"] is not b["params"] for a, b in zip(mapped, groups, strict=True)):
            groups = mapped
        for binding in self._bindings(Regularizer.parameter_groups):
            groups = binding.regularizer.parameter_groups(groups, binding.grids, binding.context)
        return groups

    def update_groups(self, groups: list[dict[str, Any]]) -> None:
        """Update what schedules drive in an optimizer's `param_groups`, in place; ask at each step."""
        for binding in self._bindings():
            binding.regularizer.update_groups(groups, binding.grids, binding.context)

    def _bindings(self, *methods: Callable[..., object]) -> list[Binding]:
        """Bindings whose regularizers override one of these methods, noted as asked; all without any."""
        bindings = self._live.bindings
        if not methods:
            return bindings
        found = [binding for binding in bindings if binding.overrides(*methods)]
        for binding in found:
            binding.asked = True
        return found

    @property
    def _live(self) -> Attachment:
        """The attachment; refused once the handle was removed."""
        if self._attachment.removed:
            raise InputError("handle: it was removed; call gridreg.apply again for a new one")
        return self._attachment


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


def _parameters(found: Any) -> Any:
    """The tensors of an optimizer's group as a list, masked ones replaced by their parameters."""
    if isinstance(found, Tensor):
        found = [found]
    entries = list(found)
    named = [entry if isinstance(entry, tuple) else (None, entry) for entry in entries]
    if isinstance(found, (list, tuple)) and not any(
        masked_parameter(tensor) is not None for _, tensor in named
    ):
        return found
    raw = [(name, tensor if (own := masked_parameter(tensor)) is None else own) for name, tensor in named]
    return [tensor if name is None else (name, tensor) for name, tensor in raw]
