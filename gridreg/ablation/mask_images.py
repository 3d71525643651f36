"""Schedules of masks: an image of channels over iterations for each site."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from gridreg.ablation.charts import Histories
from gridreg.ablation.records import RunResult
from gridreg.export.html import data_uri
from gridreg.training.images import coloured


def mask_schedules(runs: Sequence[RunResult], histories: Histories) -> list[dict[str, Any]]:
    """The masks over the iterations; compositions with equal masks stand together.

    Returns:
        For each group its ``labels`` and ``sites``, each with ``site``, ``channels``, the last ``step``, and ``src``:
        an image as data URI, iterations to the right, channels upwards.
    """
    groups: dict[str, list[str]] = {}
    for run in runs:
        if run.status == "done" and not any(run.spec.label in labels for labels in groups.values()):
            masks: dict[str, tuple[list[int], list[list[float]]]] = {}
            for row in histories(run):
                own = row.get("masks")
                for site, mask in own.items() if isinstance(own, Mapping) else ():
                    steps, values = masks.setdefault(str(site), ([], []))
                    steps.append(int(str(row["step"])))
                    values.append([float(value) for value in mask])
            if masks:
                groups.setdefault(json.dumps(masks), []).append(run.spec.label)
    return [
        {"labels": labels, "sites": [_site(site, *found) for site, found in json.loads(masks).items()]}
        for masks, labels in groups.items()
    ]


def _site(site: str, steps: Sequence[int], rows: Sequence[Sequence[float]]) -> dict[str, Any]:
    channels = max(len(row) for row in rows)
    values = np.zeros((channels, len(rows)))
    for column, row in enumerate(rows):
        values[: len(row), column] = row
    source = data_uri(Image.fromarray(coloured(values[::-1], 0, 1, "cividis")))
    return {"site": site, "channels": channels, "step": steps[-1], "src": source}


def colour_scale() -> str:
    """The colours of the masks from 0 to 1, as data URI."""
    return data_uri(Image.fromarray(coloured(np.linspace(0, 1, 64)[None], 0, 1, "cividis")))
