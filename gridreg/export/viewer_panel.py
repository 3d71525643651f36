"""The controls of the viewer: what to show, at which step of the masks, with which of them, how large."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gridreg.export.images import MODES
from gridreg.export.preview import Preview
from gridreg.training.images import ImageArray

# Longer edge of an image, pixels.
_SMALLEST, _LARGEST = 64, 1600
# Characters that stay on one line of the panel.
_LABEL = 18


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
        preview: names the masks, one switch for each, has the steps of the slider, and says what may be shown.
        changed: called whenever the look has changed.
        snapshot: called with the ``viser.ClientHandle`` that asked for an image.
        size: longer edge of the image at rest, pixels.
        pausable: whether there is a button to pause the training.
    """

    def __init__(
        self,
        server: Any,
        preview: Preview,
        changed: Callable[[], None],
        snapshot: Callable[[Any], None],
        size: int,
        *,
        pausable: bool = False,
    ) -> None:
        self._server, self._changed = server, changed
        self.paused = False
        self._pinned, self._reached = False, preview.step
        self._status = server.gui.add_markdown("waiting for the first image")
        self._mode = server.gui.add_dropdown("Show", preview.modes, initial_value=MODES[0])
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
        if preview.masks:
            self._add_masks(server, preview.masks, (preview.step, preview.total_steps))
        self.cameras = server.gui.add_checkbox("Training cameras", True)
        button = server.gui.add_button("Snapshot", hint="saves this image at full resolution")
        button.on_click(lambda event: snapshot(event.client))
        if pausable:
            self._pause = server.gui.add_button("Pause", hint="the training waits, its clock stands still")
            self._pause.on_click(lambda _: self._turn())
        self._chart: Any = None
        self._compared: Any = None
        for control in (self._mode, self._size, *self._switches.values()):
            control.on_update(lambda _: changed())

    def _add_masks(self, server: Any, masks: Sequence[str], steps: tuple[int, int]) -> None:
        now, total = steps
        total = max(now, total, 1)
        # Folded: on a telephone it would cover what is to be seen.
        with server.gui.add_folder("Masks", expand_by_default=False):
            self._step = server.gui.add_slider("At step", min=0, max=total, step=1, initial_value=now)
            self._step.on_update(self._step_moved)
            back = server.gui.add_button("As trained", hint="masks at the step that the field has reached")
            back.on_click(lambda _: self._let_go())
            for name, label in zip(masks, short_labels(masks), strict=True):
                self._switches[name] = server.gui.add_checkbox(label, True, hint=name)

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

    def _turn(self) -> None:
        self.paused = not self.paused
        self._pause.label = "Go on" if self.paused else "Pause"

    def curve(self, steps: Sequence[float], values: Sequence[float]) -> None:
        """Draw a curve of values, dB, by iteration; the one before goes."""
        if len(steps) < 2:
            return
        data = (np.asarray(steps, np.float64), np.asarray(values, np.float64))
        if self._chart is not None:
            self._chart.data = data
            return
        series = ({"label": "iteration"}, {"label": "PSNR, dB", "stroke": "#3f51b5", "width": 2})
        scales = {"x": {"time": False}, "y": {"auto": True}}
        with self._server.gui.add_folder("Curve", expand_by_default=False):
            self._chart = self._server.gui.add_uplot(data, series, scales=scales, aspect=2.0)

    def compare(self, pixels: ImageArray, text: str) -> None:
        """Show a render beside its photograph, with a line of text below."""
        if self._compared is None:
            gui, order = self._server.gui, self._status.order
            self._compared = (
                gui.add_image(pixels, order=order + 0.1),
                gui.add_markdown(text, order=order + 0.2),
            )
        else:
            self._compared[0].image, self._compared[1].content = pixels, text

    def say(self, text: str) -> None:
        """Text above the controls."""
        if self._status.content != text:
            self._status.content = text


def short_labels(names: Sequence[str]) -> list[str]:
    """Labels for names such as ``FrequencyMask(appearance)`` that fit on one line: their sites where these differ.

    Example:
        >>> short_labels(["FrequencyMask(density)", "FrequencyMask(appearance)"]), short_labels(["A(x)", "B(x)"])
        (['density', 'appearance'], ['A(x)', 'B(x)'])
    """
    sites = [name.partition("(")[2].rstrip(")") or name for name in names]
    labels = sites if len(set(sites)) == len(sites) else names
    return [label if len(label) <= _LABEL else f"{label[: _LABEL - 1]}…" for label in labels]
