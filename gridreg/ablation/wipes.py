"""Renders for the slider of a report: the same view by every composition, small enough to sit in one file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from gridreg.ablation.comparison import Section
from gridreg.ablation.records import RunResult
from gridreg.export.html import encode, open_image, spread_views, target_beside

VIEWS_PER_SCENE = 4


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
    found: list[dict[str, list[dict[str, Any]]]] = [{s: [] for s in section.scenes} for section in sections]
    places = []
    for section, own in zip(sections, found, strict=True):
        for scene, entries in own.items():
            runs = _runs_of(section, scene)
            places.append((entries, scene, runs, _views_of(runs.values())))
    used = 0
    # One of every scene, then another of every scene.
    for turn in range(VIEWS_PER_SCENE):
        for entries, scene, runs, views in places:
            images = _images(runs, views[turn]) if turn < len(views) else []
            size = sum(len(image["src"]) for image in images)
            if len(images) > 1 and used + size <= budget:
                used += size
                seeds = ", ".join(map(str, sorted({run.spec.seed for run in runs.values()})))
                entries.append({"scene": scene, "view": views[turn], "seed": seeds, "images": images})
    return [[entry for entries in own.values() for entry in entries] for own in found]


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
    own = {row.name: [run for run in row.finished if run.spec.scene_name == scene] for row in section.rows}
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
    return spread_views(set.intersection(*known), VIEWS_PER_SCENE) if known else []


def _images(runs: Mapping[str, RunResult], view: str) -> list[dict[str, Any]]:
    images: list[dict[str, Any]] = []
    for name, run in runs.items():
        render = open_image(run.images.get(view, run.folder / "test" / f"{view}.png"))
        if render is None:
            continue
        if not images:
            own, compared = run.images.get(f"target:{view}"), run.folder / "test" / f"{view}_compare.png"
            target = target_beside(compared, render) if own is None else open_image(own)
            images += [] if target is None else [{"name": "target", "psnr": None, "src": encode(target)}]
        psnr = float((run.metrics or {})["images"][view].get("psnr", "nan"))
        images.append({"name": name, "psnr": psnr if math.isfinite(psnr) else None, "src": encode(render)})
    return images
