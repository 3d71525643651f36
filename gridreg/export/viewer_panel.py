"""The controls of the viewer: what to show, at which step of the masks, with which of them, how large."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from gridreg.export.images import MODES

__all__ = ["Look", "Panel"]

# Longer edge of an image, pixels.
_SMALLEST, _LARGEST = 64, 1600


@dataclass(frozen=True)
class Look:
    """State of the controls.

    Args:
        mode: one of `gridreg.export.images.MODES`.
        size: longer edge of the image at rest, pixels.
        step: of the masks; None: as trained.
        off: names of masks that are taken off.
    """

    mode: str = "rgb"
    size: int = 512
    step: int | None = None
    off: frozenset[str] = frozenset()


class Panel:
    """Controls in the page, shared by all who look.

    Args:
        server: a ``viser.ViserServer``.
        masks: names of the masks, one switch for each.
        steps: step now and steps in all, for the slider; without masks there is none.
        changed: called whenever the look has changed.
        snapshot: called with the ``viser.ClientHandle`` that asked for an image.
        size: longer edge of the image at rest, pixels.
    """

    def __init__(
        self,
        server: Any,
        masks: Sequence[str],
        steps: tuple[int, int],
        changed: Callable[[], None],
        snapshot: Callable[[Any], None],
        size: int,
    ) -> None:
        self._changed = changed
        self._pinned, self._reached = False, steps[0]
        self._status = server.gui.add_markdown("waiting for the first image")
        self._mode = server.gui.add_dropdown("Show", MODES, initial_value=MODES[0])
        self._size = server.gui.add_slider(
            "Resolution",
            min=_SMALLEST,
            max=_LARGEST,
            step=16,
            initial_value=size,
            hint="longer edge at rest, pixels",
        )
        self._step: Any = None
        self._switches: dict[str, Any] = {}
        if masks:
            self._add_masks(server, masks, steps)
        self.cameras = server.gui.add_checkbox("Training cameras", True)
        button = server.gui.add_button("Snapshot", hint="saves this image at full resolution")
        button.on_click(lambda event: snapshot(event.client))
        for control in (self._mode, self._size, *self._switches.values()):
            control.on_update(lambda _: changed())

    def _add_masks(self, server: Any, masks: Sequence[str], steps: tuple[int, int]) -> None:
        now, total = steps
        total = max(now, total, 1)
        with server.gui.add_folder("Masks"):
            self._step = server.gui.add_slider("At step", min=0, max=total, step=1, initial_value=now)
            self._step.on_update(self._step_moved)
            back = server.gui.add_button("As trained", hint="masks at the step that the field has reached")
            back.on_click(lambda _: self._let_go())
            for name in masks:
                self._switches[name] = server.gui.add_checkbox(name, True)

    def _step_moved(self, event: Any) -> None:
        # Setting the slider from here also ends up here, but nobody moved it.
        if event.client is not None:
            self._pinned = True
            self._changed()

    def _let_go(self) -> None:
        self._pinned = False
        self.reached(self._reached)
        self._changed()

    @property
    def look(self) -> Look:
        """State of the controls now, within their ranges."""
        step = int(self._step.value) if self._pinned and self._step is not None else None
        off = frozenset(name for name, switch in self._switches.items() if not switch.value)
        # What a browser says may lie outside of what its controls offer.
        mode = self._mode.value if self._mode.value in MODES else MODES[0]
        if step is not None:
            step = min(max(step, 0), int(self._step.max))
        return Look(mode, min(max(int(self._size.value), _SMALLEST), _LARGEST), step, off)

    def reached(self, step: int) -> None:
        """Move the slider along with training, unless somebody holds it elsewhere."""
        self._reached = step
        if self._step is not None and not self._pinned:
            self._step.value = min(step, self._step.max)

    def say(self, text: str) -> None:
        """Text above the controls."""
        if self._status.content != text:
            self._status.content = text
