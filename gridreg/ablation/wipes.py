"""Renders for the slider of a report: the same view by every composition, small enough to sit in one file."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gridreg.ablation.comparison import Section
from gridreg.ablation.records import RunResult

__all__ = ["LONGEST_SIDE", "VIEWS_PER_SCENE", "data_uri", "encode", "first_choice", "wipe_data"]

LONGEST_SIDE = 400
VIEWS_PER_SCENE = 4

_QUALITY = 88
# Above the images in NAME_compare.png stand their names.
_STRIP = 20


def wipe_data(sections: Sequence[Section], budget: int) -> list[list[dict[str, Any]]]:
    """Images for the slider, by section, as plain data.

    Of every scene one view after the other, evenly spread over the test views, until the budget is used up. All rows
    show the same seed where they have one in common.

    Args:
        sections: tables.
        budget: of all images together, bytes of the page.

    Returns:
        For each section a list of ``{"scene", "view", "seed", "images": [{"name", "psnr", "src"}]}``; the target is the
        first image. An image that cannot be read is left out.
    """
    places = [(number, scene) for number, section in enumerate(sections) for scene in section.scenes]
    runs = {place: _runs_of(sections[place[0]], place[1]) for place in places}
    views = {place: _views_of(runs[place].values()) for place in places}
    found: dict[tuple[int, str], list[dict[str, Any]]] = {place: [] for place in places}
    used = 0
    # One of every scene, then another of every scene.
    for turn in range(VIEWS_PER_SCENE):
        for place in places:
            if turn >= len(views[place]):
                continue
            view = views[place][turn]
            images = _images(runs[place], view)
            size = sum(len(image["src"]) for image in images)
            if len(images) > 1 and used + size <= budget:
                used += size
                seeds = sorted({run.spec.seed for run in runs[place].values()})
                entry = {
                    "scene": place[1],
                    "view": view,
                    "seed": ", ".join(map(str, seeds)),
                    "images": images,
                }
                found[place].append(entry)
    return [
        [entry for place in places if place[0] == number for entry in found[place]]
        for number in range(len(sections))
    ]


def first_choice(section: Section, data: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """Names of what the slider shows at first: the baseline, and what is best beside it."""
    names = [image["name"] for image in data[0]["images"]]
    baseline = next((row.name for row in section.rows if row.is_baseline and row.name in names), names[0])
    gains = {
        row.name: row.difference.estimate.mean
        for row in section.rows
        if row.name in names and row.difference and row.difference.estimate
    }
    return baseline, max(gains, key=lambda name: gains[name], default=names[-1])


def _runs_of(section: Section, scene: str) -> dict[str, RunResult]:
    """One run of each row, of the seed that most rows have."""
    own = {
        row.name: [run for run in section.results[row.name] if run.spec.scene_name == scene]
        for row in section.rows
    }
    seeds = [run.spec.seed for runs in own.values() for run in runs]
    # The smallest one of those that are equally common.
    favourite = max(sorted(set(seeds)), key=seeds.count, default=0)
    return {
        name: min(runs, key=lambda run: (run.spec.seed != favourite, run.spec.seed))
        for name, runs in own.items()
        if runs
    }


def _views_of(runs: Iterable[RunResult]) -> list[str]:
    """Names of test views that all runs have, evenly spread."""
    known = [set((run.metrics or {}).get("images", {})) for run in runs]
    # By the number in the name: r_8 comes before r_16.
    order = {name: int("".join(filter(str.isdecimal, name)) or 0) for names in known for name in names}
    views = sorted(set.intersection(*known), key=lambda name: (order[name], name)) if known else []
    spread = np.linspace(0, len(views) - 1, min(VIEWS_PER_SCENE, len(views))).round().astype(int)
    return [views[index] for index in spread.tolist()]


def _images(runs: Mapping[str, RunResult], view: str) -> list[dict[str, Any]]:
    images: list[dict[str, Any]] = []
    for name, run in runs.items():
        render = _opened(run.images.get(view, run.folder / "test" / f"{view}.png"))
        if render is None:
            continue
        if not images:
            target = _target(run, view, render)
            if target is not None:
                images.append({"name": "target", "psnr": None, "src": encode(target)})
        psnr = float((run.metrics or {})["images"][view].get("psnr", "nan"))
        images.append({"name": name, "psnr": psnr if math.isfinite(psnr) else None, "src": encode(render)})
    return images


def _target(run: RunResult, view: str, render: Image.Image) -> Image.Image | None:
    """The target, which stands at the left of the comparison, enlarged by whole pixels, where it has no file."""
    if f"target:{view}" in run.images:
        return _opened(run.images[f"target:{view}"])
    comparison = _opened(run.folder / "test" / f"{view}_compare.png")
    if comparison is None:
        return None
    zoom = (comparison.height - _STRIP) // render.height
    if zoom < 1 or comparison.width < zoom * render.width:
        return None
    whole = comparison.crop((0, _STRIP, zoom * render.width, _STRIP + zoom * render.height))
    return whole.resize(render.size, Image.Resampling.BOX)


def _opened(path: Path) -> Image.Image | None:
    try:
        with Image.open(path, formats=["PNG", "JPEG"]) as image:
            converted: Image.Image = image.convert("RGB")
            return converted
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError):
        return None


def encode(image: Image.Image) -> str:
    """An image as data URI, at most `LONGEST_SIDE` pixels: PNG, or JPEG without colour subsampling if smaller.

    >>> encode(Image.new("RGB", (4, 4)))[:22]
    'data:image/png;base64,'
    """
    if max(image.size) > LONGEST_SIDE:
        scale = LONGEST_SIDE / max(image.size)
        size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        image = image.resize(size, Image.Resampling.BOX, reducing_gap=None)
    return min(data_uri(image, "png"), data_uri(image, "jpeg"), key=len)


def data_uri(image: Image.Image, kind: str = "png") -> str:
    """An image as data URI, in the format ``png`` or ``jpeg``."""
    buffer = io.BytesIO()
    options: dict[str, Any] = {"optimize": True} if kind == "png" else {"quality": _QUALITY, "subsampling": 0}
    image.save(buffer, format=kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode()
