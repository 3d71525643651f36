"""Renders for the slider of a report: the same view by every composition, small enough to sit in one file."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gridreg.ablation.comparison import Section
from gridreg.ablation.records import RunResult

__all__ = ["LONGEST_SIDE", "VIEWS_PER_SCENE", "encode", "wipe_data"]

LONGEST_SIDE = 400
VIEWS_PER_SCENE = 4

_QUALITY = 88
_TARGET = "target"
# Above the pictures in NAME_compare.png stand their names.
_STRIP = 20


@dataclass(frozen=True)
class _Candidate:
    section: int
    scene: str
    view: str
    runs: dict[str, RunResult]


def wipe_data(sections: Sequence[Section], budget: int) -> list[list[dict[str, Any]]]:
    """Pictures for the slider, by section, as plain data.

    Of every scene one view after the other, evenly spread over the test views, until the budget is used up. All rows
    show the same seed where they have one in common.

    Args:
        sections: tables.
        budget: of all pictures together, bytes of the page.

    Returns:
        For each section a list of ``{"scene", "view", "seed", "images": [{"name", "psnr", "src"}]}``; the target is the
        first image. A picture that cannot be read is left out.
    """
    data: list[list[dict[str, Any]]] = [[] for _ in sections]
    used = 0
    for candidate in _candidates(sections):
        images = _images(candidate)
        size = sum(len(image["src"]) for image in images)
        if len(images) < 2 or used + size > budget:
            continue
        used += size
        seeds = sorted({run.spec.seed for run in candidate.runs.values()})
        entry = {
            "scene": candidate.scene,
            "view": candidate.view,
            "seed": ", ".join(map(str, seeds)),
            "images": images,
        }
        data[candidate.section].append(entry)
    order = [{scene: index for index, scene in enumerate(section.scenes)} for section in sections]
    for entries, places in zip(data, order, strict=True):
        entries.sort(key=lambda entry: places[entry["scene"]])
    return data


def _candidates(sections: Sequence[Section]) -> Iterator[_Candidate]:
    """Views in the order of their claim to space: one of every scene, then another of every scene."""
    chosen: list[list[_Candidate]] = []
    for number, section in enumerate(sections):
        for scene in section.scenes:
            runs = _runs_of(section, scene)
            known = [set((run.metrics or {}).get("images", {})) for run in runs.values()]
            views = sorted(set.intersection(*known), key=_natural) if known else []
            spread = np.linspace(0, len(views) - 1, min(VIEWS_PER_SCENE, len(views))).round().astype(int)
            chosen.append([_Candidate(number, scene, views[index], runs) for index in spread.tolist()])
    for turn in range(VIEWS_PER_SCENE):
        for candidates in chosen:
            if turn < len(candidates):
                yield candidates[turn]


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


def _images(candidate: _Candidate) -> list[dict[str, Any]]:
    images: list[dict[str, Any]] = []
    for name, run in candidate.runs.items():
        render = _opened(run.folder / "test" / f"{candidate.view}.png")
        if render is None:
            continue
        if not images:
            target = _target(run.folder / "test" / f"{candidate.view}_compare.png", render)
            if target is not None:
                images.append({"name": _TARGET, "psnr": None, "src": encode(target)})
        psnr = float((run.metrics or {})["images"][candidate.view].get("psnr", "nan"))
        images.append({"name": name, "psnr": psnr if math.isfinite(psnr) else None, "src": encode(render)})
    return images


def _target(path: Path, render: Image.Image) -> Image.Image | None:
    """The target, which stands at the left of the comparison, enlarged by whole pixels."""
    comparison = _opened(path)
    if comparison is None:
        return None
    zoom = (comparison.height - _STRIP) // render.height
    if zoom < 1 or comparison.width < zoom * render.width:
        return None
    whole = comparison.crop((0, _STRIP, zoom * render.width, _STRIP + zoom * render.height))
    return whole.resize(render.size, Image.Resampling.BOX)


def _opened(path: Path) -> Image.Image | None:
    try:
        with Image.open(path) as image:
            converted: Image.Image = image.convert("RGB")
            return converted
    except (OSError, UnidentifiedImageError):
        return None


def encode(image: Image.Image) -> str:
    """A picture as data URI, at most `LONGEST_SIDE` pixels: PNG, or JPEG without colour subsampling if smaller.

    >>> encode(Image.new("RGB", (4, 4)))[:22]
    'data:image/png;base64,'
    """
    scale = LONGEST_SIDE / max(image.size)
    if scale < 1:
        size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        image = image.resize(size, Image.Resampling.BOX, reducing_gap=None)
    found = []
    for kind, options in (("png", {"optimize": True}), ("jpeg", {"quality": _QUALITY, "subsampling": 0})):
        buffer = io.BytesIO()
        image.save(buffer, format=kind, **options)  # type: ignore[arg-type]
        found.append((len(buffer.getvalue()), kind, buffer.getvalue()))
    _, kind, content = min(found)
    return f"data:image/{kind};base64," + base64.b64encode(content).decode()


def _natural(name: str) -> tuple[int, str]:
    """Order by the number in a name: r_8 comes before r_16."""
    digits = "".join(character for character in name if character.isdigit())
    return (int(digits or 0), name)
