"""A field's modules and parameters as they were when something was attached, to notice what was replaced."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import is_
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gridreg.attach._binding import Binding
from gridreg.attach._slots import Slot


class MaskedTensor(NamedTuple):
    """A parameter or buffer that a slot transforms."""

    raw: Tensor
    slot: Slot


class Snapshot:
    """The state that `Handle.step` compares the field with: cheap, because it does so at every step.

    Attributes:
        tensors: parameters and buffers that slots transform, by regularizer and name.
    """

    def __init__(self, modules: Iterable[nn.Module], bindings: Sequence[Binding]) -> None:
        self._held: list[tuple[dict[str, Any], list[Any]]] = []
        for module in modules:
            for held in (module._modules, module._parameters):
                self._held.append((held, list(held.values())))
        self.tensors: dict[tuple[str, str], MaskedTensor] = {}
        self._shapes: list[tuple[Mapping[str, Tensor | None], str, torch.Size]] = []
        for binding in bindings:
            pairs = [(match, None) for match in binding.matches] + list(binding.slots)
            for match, slot in pairs:
                for tensors in (match.module._parameters, match.module._buffers):
                    raw = tensors.get(match.attribute)
                    if raw is not None and match.place.kind == "parameters":
                        self._shapes.append((tensors, match.attribute, raw.shape))
                        if slot is not None:
                            self.tensors[binding.name, match.place.name] = MaskedTensor(raw, slot)

    def holds(self) -> bool:
        """Whether the field still has the same modules and parameters, of the same shapes where it matters."""
        return all(
            len(now) == len(then) and all(map(is_, now.values(), then)) for now, then in self._held
        ) and all(
            (raw := tensors.get(name)) is not None and raw.shape == shape
            for tensors, name, shape in self._shapes
        )

    @property
    def masked(self) -> dict[tuple[str, str], tuple[Tensor, bytes | None]]:
        """Tensors whose values are transformed now, with the bytes that tell their closed channels."""
        return {
            key: (raw, slot.closed)
            for key, (raw, slot) in self.tensors.items()
            if slot.active and not getattr(slot.regularizer, "detach", False)
        }
