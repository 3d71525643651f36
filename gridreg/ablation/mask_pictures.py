"""How masks open: a picture of channels over iterations for each site."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

from gridreg.ablation.curves import Histories
from gridreg.ablation.records import RunResult
from gridreg.training.images import ImageArray, coloured

__all__ = ["mask_schedules"]


def mask_schedules(runs: Sequence[RunResult], histories: Histories) -> str:
    """The masks over the iterations, one picture for each site; compositions with equal masks share one."""
    groups: dict[str, tuple[list[str], dict[str, tuple[list[int], list[list[float]]]]]] = {}
    seen: set[str] = set()
    for run in runs:
        if run.spec.label in seen or run.status != "done":
            continue
        masks = _masks_of(histories(run))
        if masks:
            seen.add(run.spec.label)
            groups.setdefault(json.dumps(masks), ([], masks))[0].append(run.spec.label)
    if not groups:
        return ""
    parts = []
    for labels, masks in groups.values():
        pictures = "".join(_mask_picture(site, steps, rows) for site, (steps, rows) in masks.items())
        names = "".join(f"<li>{_text(label)}</li>" for label in labels)
        parts.append(
            f'<div class="masks"><ul class="names">{names}</ul><div class="sites">{pictures}</div></div>'
        )
    scale = _data_uri(coloured(np.linspace(0, 1, 64)[None], 0, 1, "cividis"))
    legend = (
        f'<p class="note scale">closed 0 <img src="{scale}" alt="colour scale from dark to light"> 1 open</p>'
    )
    return legend + "".join(parts)


def _masks_of(rows: Sequence[Mapping[str, object]]) -> dict[str, tuple[list[int], list[list[float]]]]:
    found: dict[str, tuple[list[int], list[list[float]]]] = {}
    for row in rows:
        masks = row.get("masks")
        for site, mask in masks.items() if isinstance(masks, Mapping) else ():
            steps, values = found.setdefault(str(site), ([], []))
            steps.append(int(str(row["step"])))
            values.append([float(value) for value in mask])
    return found


def _mask_picture(site: str, steps: Sequence[int], rows: Sequence[Sequence[float]]) -> str:
    channels = max(len(row) for row in rows)
    values = np.zeros((len(rows), channels))
    for line, row in zip(values, rows, strict=True):
        line[: len(row)] = row
    # Iterations to the right, channels upwards.
    source = _data_uri(coloured(values.T[::-1], 0, 1, "cividis"))
    end = f"{steps[-1]:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return (
        f'<figure class="mask"><figcaption><b>{_text(site)}</b> {channels} channels</figcaption>'
        f'<img src="{source}" alt="{_text(f"mask of {site}: channels upwards, iterations to the right")}">'
        f'<p class="x-label"><span>0</span><span>iteration</span><span>{end}</span></p></figure>'
    )


def _data_uri(picture: ImageArray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _text(text: str) -> str:
    return html.escape(text, quote=True)
