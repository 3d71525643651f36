"""Course of a run: a history of values and masks, kept as JSON lines and drawn as curves.

Nothing here needs a display: figures are drawn by matplotlib's Agg backend, without its global state.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gridreg.errors import InputError
from gridreg.scenes.files import read_text
from gridreg.training.files import write_text, writing
from gridreg.training.metrics import json_ready

Row = dict[str, Any]


class History:
    """Rows of values by step, ready for JSON lines.

    A row is ``{"step": n, name: value, ...}``, and where masks were recorded also ``"masks": {site:
    [...]}``. The values of single batches scatter, so ``record`` keeps their mean over ``every`` steps.

    Args:
        every: steps from one row of ``record`` to the next.

    Example:
        >>> history = History(every=2)
        >>> for step in range(1, 5):
        ...     history.record(step, {"psnr": 10.0 + step})
        >>> history.add(4, {"test_psnr": 21.0})
        >>> history.rows
        [{'step': 2, 'psnr': 11.5}, {'step': 4, 'psnr': 13.5}, {'step': 4, 'test_psnr': 21.0}]
    """

    def __init__(self, every: int = 1) -> None:
        if every < 1:
            raise InputError(f"every: found {every}, expected a number of steps from 1")
        self.every = every
        self.rows: list[Row] = []
        self._sums: dict[str, list[float]] = {}

    def record(self, step: int, values: Mapping[str, float]) -> None:
        """Add the values of one step; at every ``every``-th step their means become a row."""
        for name, value in values.items():
            total = self._sums.setdefault(name, [0.0, 0])
            total[0] += float(value)
            total[1] += 1
        if step % self.every == 0:
            self.add(step, {name: total / count for name, (total, count) in self._sums.items()})
            self._sums = {}

    def add(
        self,
        step: int,
        values: Mapping[str, float] | None = None,
        *,
        masks: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        """Add a row as it is: the score of the test views, say, or the masks ``(channels,)`` by site."""
        row: Row = {"step": int(step)}
        row.update({name: float(value) for name, value in (values or {}).items()})
        if masks:
            row["masks"] = {site: [float(value) for value in mask] for site, mask in masks.items()}
        self.rows.append(row)

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed run needs to go on with the same rows, as plain data."""
        return {"every": self.every, "rows": self.rows, "sums": self._sums}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from ``state_dict``."""
        self.every = state["every"]
        self.rows = [dict(row) for row in state["rows"]]
        self._sums = {name: list(total) for name, total in state["sums"].items()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as JSON lines, whole or not at all; infinities and NaN become text.

        Raises:
            InputError: if the place is not writable or the disk is full.
        """
        lines = [json.dumps(json_ready(row)) for row in self.rows]
        write_text(path, "".join(line + "\n" for line in lines))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> History:
        """Read what ``save`` wrote.

        Raises:
            InputError: if the file cannot be read or a line is not such a row; names the line.
        """
        history = cls()
        lines = read_text(path, "history").splitlines()
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
                values = {k: float(v) for k, v in row.items() if k not in ("step", "masks")}
                history.add(row["step"], values, masks=row.get("masks"))
            except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                raise InputError(f"{os.fspath(path)}:{number}: not a row of a history") from error
        return history


def draw_curves(
    rows: Sequence[Row], path: str | os.PathLike[str], *, title: str = "", events: Sequence[int] = ()
) -> None:
    """Draw the PSNR over the iterations, and below it the loss and its parts, as one PNG.

    Every value whose name contains ``psnr`` goes to the upper axes (dB), all others to the lower ones
    (logarithmic, so zeros and negative values are left out).

    Args:
        rows: as in ``History.rows``; may be empty.
        path: the PNG.
        title: above the image, such as scene and protocol.
        events: iterations to mark by a line, such as resamplings.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    names = dict.fromkeys(name for row in rows for name in row if name not in ("step", "masks", "seconds"))
    figure = Figure(figsize=(8, 7), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for name in names:
        _draw_series(upper if "psnr" in name else lower, name, rows)
    upper.set_ylabel("PSNR (dB)")
    lower.set_ylabel("loss and its weighted parts")
    lower.set_xlabel("iteration")
    lower.set_yscale("log")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
        for step in events:
            axes.axvline(step, color="0.6", linewidth=0.8, linestyle=":")
        if axes.lines and axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    upper.set_title(_verbatim(title), fontsize=10)
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def draw_masks(rows: Sequence[Row], path: str | os.PathLike[str], *, title: str = "") -> None:
    """Draw each site's mask over time as an image, iteration to the right and channel upwards, as one PNG.

    Args:
        rows: as in ``History.rows``; those without masks are passed over.
        path: the PNG.
        title: above the image.

    Raises:
        InputError: if no row has a mask, or the place is not writable.
    """
    sites = dict.fromkeys(site for row in rows for site in row.get("masks", {}))
    if not sites:
        raise InputError("rows: no row has a mask; expected at least one")
    figure = Figure(figsize=(8, 1.2 + 1.6 * len(sites)), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(len(sites), 1, sharex=True))
    for site, axes in zip(sites, all_axes, strict=True):
        known = [row for row in rows if site in row.get("masks", {})]
        mask = np.full((len(known), max(len(row["masks"][site]) for row in known)), np.nan)
        for line, row in zip(mask, known, strict=True):
            line[: len(row["masks"][site])] = row["masks"][site]
        # Each column of the image reaches from one recorded step to the next.
        steps = np.array([row["step"] for row in known], dtype=float)
        last = steps[-1] + (steps[-1] - steps[-2] if len(steps) > 1 else 1)
        edges = np.append(steps, last)
        image = axes.pcolormesh(edges, np.arange(mask.shape[1] + 1), mask.T, vmin=0, vmax=1, cmap="viridis")
        axes.set_ylabel(f"{_verbatim(site)}\nchannel", fontsize=8)
    all_axes[-1].set_xlabel("iteration")
    all_axes[0].set_title(_verbatim(title), fontsize=10)
    figure.colorbar(image, ax=list(all_axes), label="mask")
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_series(axes: Axes, name: str, rows: Sequence[Row]) -> None:
    steps = np.array([row["step"] for row in rows if name in row], dtype=float)
    values = np.array([row[name] for row in rows if name in row], dtype=float)
    values[~np.isfinite(values)] = np.nan
    if "psnr" not in name:
        values[values <= 0] = np.nan
    if np.isnan(values).all():
        return
    width = len(values) // 50
    if width < 2:
        axes.plot(steps, values, marker="o" if len(values) < 30 else "", markersize=3, label=_verbatim(name))
        return
    (raw,) = axes.plot(steps, values, linewidth=0.6, alpha=0.35)
    smooth = np.convolve(values, np.full(width, 1 / width), mode="valid")
    middle = np.convolve(steps, np.full(width, 1 / width), mode="valid")
    axes.plot(middle, smooth, linewidth=1.6, color=raw.get_color(), label=_verbatim(name))


def _verbatim(text: str) -> str:
    """Text that matplotlib takes as it is, also where a dollar would begin a formula."""
    return text.replace("$", r"\$")
