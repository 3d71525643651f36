"""Scoring a field on views it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, Rendered, render_image
from gridreg.scenes import Views
from gridreg.training.metrics import image_metrics, psnr

__all__ = ["Scored", "mean_psnr_of", "render_views", "score_views"]


@dataclass(frozen=True)
class Scored:
    """One rendered view beside its target.

    Args:
        name: of the view.
        rendered: colour ``(H, W, 3)``, opacity and depth ``(H, W)``.
        target: ``(H, W, 3)`` on the same background.
        metrics: see `gridreg.training.metrics.image_metrics`.
    """

    name: str
    rendered: Rendered
    target: Tensor
    metrics: dict[str, float]


def render_views(
    field: Any,
    views: Views,
    occupancy: OccupancyGrid,
    march: MarchSettings,
    background: Tensor,
    *,
    warp: Callable[[Rays], Rays] | None = None,
) -> Iterator[Rendered]:
    """Images of a field from the cameras of views, one after the other."""
    for pose, intrinsics in zip(views.poses, views.intrinsics, strict=True):
        yield render_image(
            field,
            pose,
            intrinsics,
            views.height,
            views.width,
            occupancy,
            march,
            background=background,
            warp=warp,
        )


def score_views(
    field: Any,
    views: Views,
    occupancy: OccupancyGrid,
    march: MarchSettings,
    background: Tensor,
    each: Callable[[Scored], None] | None = None,
    *,
    warp: Callable[[Rays], Rays] | None = None,
) -> list[Scored]:
    """Render and score every view; ``each`` is told as soon as one is done."""
    scored = []
    targets = views.composited(background)
    images = render_views(field, views, occupancy, march, background, warp=warp)
    for name, rendered, target in zip(views.names, images, targets, strict=True):
        one = Scored(name, rendered, target, image_metrics(rendered.colour, target))
        scored.append(one)
        if each is not None:
            each(one)
    return scored


def mean_psnr_of(
    field: Any,
    views: Views,
    occupancy: OccupancyGrid,
    march: MarchSettings,
    background: Tensor,
    stride: int = 1,
    *,
    warp: Callable[[Rays], Rays] | None = None,
) -> float:
    """Mean PSNR (dB) over every ``stride``-th view, for a look on the way."""
    chosen = slice(None, None, stride)
    some = Views(
        views.rgba[chosen],
        views.poses[chosen],
        views.intrinsics[chosen],
        views.names[chosen],
        views.ids[chosen],
    )
    targets = some.composited(background)
    images = render_views(field, some, occupancy, march, background, warp=warp)
    values = [psnr(p.colour, t) for p, t in zip(images, targets, strict=True)]
    return float(torch.tensor(values, dtype=torch.float64).mean())
