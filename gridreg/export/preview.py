"""A private copy of a model, to be looked at with masks at any step while the original is being trained."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import gridreg
from gridreg import Handle, Regularizer
from gridreg.errors import InputError
from gridreg.export.images import MODES
from gridreg.rendering import OccupancyGrid
from gridreg.rendering.model import Model


class Preview:
    """Copies a model; what is set here never touches the original, and later training never touches the copy.

    Make it where the field stands still: in the thread that trains, between two iterations. It costs one copy
    of the parameters, without gradients.

    Args:
        model: to copy; its handle, if any, says which masks act.

    Raises:
        InputError: if the field cannot be copied.
    """

    def __init__(self, model: Model) -> None:
        self._regularizers: dict[str, Regularizer] = {}
        self.step, self.total_steps = 0, 0
        if model.handle is None:
            field = _copied(model.field)
        else:
            handle = model.handle
            self.step, self.total_steps = handle.current_step, handle.total_steps
            named = zip(handle.values(), handle.regularizers, strict=True)
            self._regularizers = {name: r for name, r in named if gridreg.overrides(r, "transform")}
            with handle.suspended():
                field = _copied(model.field)
        grid = model.occupancy
        cells = OccupancyGrid(grid.bounds.clone(), grid.cells.clone())
        around = None if model.surroundings is None else _copied(model.surroundings)
        self._model = replace(model, field=field, occupancy=cells, handle=None, surroundings=around)
        self._attached: Handle | None = None
        self._shown: tuple[int, frozenset[str]] | None = None

    @property
    def masks(self) -> tuple[str, ...]:
        """Names of the regularizers that change what the field looks like, as in the table of the handle."""
        return tuple(self._regularizers)

    @property
    def modes(self) -> tuple[str, ...]:
        """Those of `gridreg.export.images.MODES` that it has: an ensemble alone has a deviation."""
        return MODES if self._model.members else tuple(mode for mode in MODES if mode != "deviation")

    @property
    def warped(self) -> bool:
        """True if rays are mapped before they are marched, see `Model`."""
        return self._model.warp is not None

    def at(
        self, step: int | None = None, off: Collection[str] = (), crop: NDArray[np.float64] | None = None
    ) -> Model:
        """The model as it would be at a step, with some masks taken off, inside a box.

        Args:
            step: iteration from 0; None: the one at which the copy was made.
            off: names out of `masks`; others are ignored.
            crop: ``(2, 3)`` in the field's coordinates: the background is seen where it ends; None: all there is.

        Returns:
            A model, valid until the next call.
        """
        wanted = (self.step if step is None else step, frozenset(off) & frozenset(self._regularizers))
        if self._regularizers and wanted != self._shown:
            if self._attached is not None:
                self._attached.remove()
            acting = [r for name, r in self._regularizers.items() if name not in wanted[1]]
            self._attached = gridreg.apply(self._model.field, *acting, total_steps=self.total_steps)
            self._attached.step(wanted[0])
            self._shown = wanted
        return self._model if crop is None else _cropped(self._model, torch.from_numpy(crop))


class _Cropped:
    """A field whose rays begin and end at a smaller box."""

    def __init__(self, field: Any, bounds: Tensor) -> None:
        self._field, self.bounds = field, bounds

    def __getattr__(self, name: str) -> Any:
        return getattr(self._field, name)


def _cropped(model: Model, box: Tensor) -> Model:
    low, high = model.field.bounds
    low, high = torch.maximum(box[0].to(low), low), torch.minimum(box[1].to(high), high)
    # A box beside the field's holds nothing: it has no volume.
    field = _Cropped(model.field, torch.stack([low, torch.maximum(low, high)]))
    members = tuple(_cropped(member, box) for member in model.members)
    return replace(model, field=field, surroundings=None, members=members)


def _copied(field: Any) -> Any:
    """A deep copy without gradients, in eval mode."""
    memo: dict[int, Any] = {}
    if isinstance(field, nn.Module):
        for parameter in field.parameters():
            # A plain deep copy would take the gradients along, twice the size.
            memo[id(parameter)] = nn.Parameter(parameter.detach().clone(), requires_grad=False)
    try:
        copied = copy.deepcopy(field, memo)
    except (RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"field: {type(field).__name__} cannot be copied for viewing: {reason}") from error
    return copied.eval() if isinstance(copied, nn.Module) else copied
