"""The handle of an applied composition: step, losses, hooks, saving, suspending and removing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from html import escape
from types import TracebackType
from typing import Any

from torch import Tensor, nn

from gridreg.attach._binding import Binding, site_label
from gridreg.attach._parts import HandleParts
from gridreg.base import Regularizer
from gridreg.errors import InputError
from gridreg.schedules import Schedule, drawing_axes


class Handle(HandleParts):
    """Sets the step, gives the loss, and takes everything off again; returned by `apply`.

    Keep it: when it is dropped, everything comes off the field.

    Attributes:
        terms: weighted, detached parts of the last `loss`, by name; they sum to its value.
    """

    @property
    def regularizers(self) -> tuple[Regularizer, ...]:
        """The regularizers, in the order of `apply`."""
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
        attachment = self._live
        if isinstance(step, bool) or not hasattr(step, "__index__") or step < 0:
            raise InputError(f"step={step!r}: expected a number of iterations from 0")
        attachment.clock.step = int(step)
        attachment.refresh()

    # --- suspending and removing -----------------------------------------------------------------

    @contextmanager
    def suspended(self) -> Iterator[Handle]:
        """The field as if nothing were attached, by this handle or any other: for surgery such as resampling.

        That holds for the field, what it holds, what holds it and what it shares modules with. Parameters, lists and
        submodules may be replaced; on leaving, everything is attached again, by name.

        Raises:
            InputError: on leaving, a site is no longer there; what else can be attached again is.
        """
        with self._live.suspended():
            yield self

    def suspends(self, method: str) -> Handle:
        """Run a method of the field that somebody else calls inside `suspended`, from now on until `remove`.

        Args:
            method: dotted path from the field, such as "encoder.upsample_grid" (TensoRF's `upsample_volume_grid`,
                a callback of nerfstudio). Whoever keeps the bound method must fetch it after this call.

        Returns:
            The handle itself.

        Raises:
            InputError: there is no such method; near names are listed.
        """
        self._live.suspends(method)
        return self

    @contextmanager
    def cached(self) -> Iterator[Handle]:
        """Inside, reads without gradients compute no transform twice: for rendering many chunks of an image.

        Reads with gradients never do: a parameter is transformed once between two steps or backward passes.
        """
        stacks = self._live.stacks()
        for stack in stacks:
            stack.forget()
            stack.keep += 1
        try:
            yield self
        finally:
            for stack in stacks:
                stack.keep -= 1
                stack.forget()

    def follow(self, copy: nn.Module) -> Handle:
        """Let a copy of the field (an `AveragedModel`, an EMA) have the masks of each step, as the field has them.

        Raises:
            InputError: the copy lacks a site of the field, or has other channels there.
        """
        self._live.follow(copy)
        return self

    def bake(self) -> None:
        """Write what the field reads in eval mode into its parameters, then remove the handle.

        For export, and at the end of a run whose masks are not fully open: outputs stay bit for bit as they are.

        Raises:
            InputError: an output or input of a module is transformed, which no parameter can hold.
        """
        self._live.bake()

    def remove(self) -> None:
        """Take everything off: the field is what it would be without.

        Raises:
            InputError: removed before.
        """
        self._live.remove()

    def __enter__(self) -> Handle:
        _ = self._live  # refuses a handle that was removed
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._attachment.removed:
            self.remove()

    # --- saving and telling ----------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """The step, the random state and what the regularizers remember: numbers, text and tensors."""
        attachment = self._live
        clock = attachment.clock
        return {
            "step": clock.step,
            "total_steps": clock.total_steps,
            "regularizers": attachment.names(),
            "generator": clock.generator.get_state(),
            "state": attachment.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`, with the same regularizers on a field of the same sizes.

        Raises:
            InputError: the state is of other regularizers, another run length, or other tensors.
        """
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
        """One number per regularizer for curves: the open fraction of a mask, the weight of a penalty."""
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

    def plot(self) -> Any:
        """Draw what follows the step, a panel each: masks whose channels are known, and schedules of numbers.

        Returns:
            matplotlib's figure.

        Raises:
            InputError: matplotlib is not installed, or nothing follows the step.
        """
        panels: list[tuple[str, Callable[[Any], Any]]] = []
        for binding in self._bindings():
            regularizer, place = binding.regularizer, binding.slots[0][0].place if binding.slots else None
            draw = getattr(regularizer, "plot", None)
            if draw is not None and place is not None and place.channels:
                shown = place.channels if place.octaves is None else place.octaves
                panels.append((binding.name, partial(draw, shown, self.total_steps)))
            for entry in fields(regularizer):
                value = getattr(regularizer, entry.name)
                if isinstance(value, Schedule) and draw is None:
                    panels.append((f"{binding.name}: {entry.name}", partial(value.plot, self.total_steps)))
        if not panels:
            raise InputError("plot: nothing here follows the step; expected a mask or a schedule")
        figure = drawing_axes().figure
        figure.clear()
        figure.set_size_inches(7, 2 * len(panels))
        for (title, panel), axes in zip(
            panels, figure.subplots(len(panels), squeeze=False)[:, 0], strict=True
        ):
            panel(axes).set_title(title, fontsize="medium")
        return figure

    def __repr__(self) -> str:
        attachment = self._attachment
        if attachment.removed:
            return "Handle(removed)"
        return f"Handle({len(attachment.bindings)} regularizers on {self._title})"

    def __str__(self) -> str:
        """A table: regularizer, site, channels, value now, and whether it has acted yet."""
        if self._attachment.removed:
            return repr(self)
        return f"gridreg on {self._title}\n{_table(_HEAD, self._rows())}"

    def _repr_html_(self) -> str:
        """The table as notebooks show it."""
        if self._attachment.removed:
            return _html_table(repr(self), (), ())
        return _html_table(f"gridreg on {self._title}", _HEAD, self._rows())

    def _rows(self) -> list[tuple[str, ...]]:
        skipped = [
            (type(r).__name__, site_label(site), "-", "-", "skipped: no such site")
            for r in self._skipped
            for site in r.sites()
        ]
        return [*map(_cells, self._bindings()), *skipped]

    @property
    def _title(self) -> str:
        clock = self._attachment.clock
        return f"{type(self._attachment.field).__name__}, step {clock.step} of {clock.total_steps}"


_HEAD = ("regularizer", "site", "channels", "value now", "acted")


def _cells(binding: Binding) -> tuple[str, ...]:
    """A regularizer's line in the table."""
    sizes = [match.place.channels for match, _ in binding.slots]
    counts = sorted({"?" if size is None else str(size) for size in sizes})
    channels = (f"{len(sizes)} x " if len(sizes) > 1 else "") + ", ".join(counts)
    value = "?" if math.isnan(binding.value()) else f"{binding.value():.4g}"
    name = type(binding.regularizer).__name__
    return name, binding.label or "samples", channels or "-", value, binding.idle or "yes"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns as wide as their cells, the head underlined.

    >>> print(_table(("site", "value"), [("density", "0.5")]))
    site     value
    -------  -----
    density  0.5
    """
    lines = [list(head), *map(list, rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    lines.insert(1, ["-" * width for width in widths])
    texts = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
    return "\n".join(text.rstrip() for text in texts)


def _html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same as a small HTML table with a caption, for notebooks.

    >>> _html_table("t", ("a",), [("<1>",)])
    '<table><caption>t</caption><tr><th>a</th></tr><tr><td>&lt;1&gt;</td></tr></table>'
    """
    lines = ["".join(f"<th>{escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
