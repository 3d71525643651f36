"""Scoring a field on views it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg.rendering import Model, Rendered
from gridreg.scenes import Views
from gridreg.training.metrics import image_metrics, psnr

Metrics = Callable[[Tensor, Tensor], dict[str, float]]


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


def render_views(model: Model, views: Views) -> Iterator[Rendered]:
    """Images of a field from the cameras of views, one after the other."""
    for camera in views.cameras:
        rendered = model.render(camera)
        assert rendered is not None
        yield rendered


def score_views(
    model: Model, views: Views, each: Callable[[Scored], None] | None = None, metrics: Metrics = image_metrics
) -> list[Scored]:
    """Render and score every view.

    Args:
        model: the field, in eval mode.
        views: with their targets, composited on the model's background.
        each: is told as soon as one is done.
        metrics: image and target ``(H, W, 3)`` to figures by name.
    """
    scored = []
    targets = views.composited(model.background)
    for name, rendered, target in zip(views.names, render_views(model, views), targets, strict=True):
        one = Scored(name, rendered, target, metrics(rendered.colour, target))
        scored.append(one)
        if each is not None:
            each(one)
    return scored


def mean_psnr_of(model: Model, views: Views, stride: int = 1) -> float:
    """Mean PSNR (dB) over every ``stride``-th view, for a look on the way."""
    chosen = slice(None, None, stride)
    some = Views(
        views.pixels[chosen],
        views.poses[chosen],
        views.intrinsics[chosen],
        views.names[chosen],
        views.ids[chosen],
    )
    values = [
        psnr(image.colour, target)
        for image, target in zip(render_views(model, some), some.composited(model.background), strict=True)
    ]
    return float(torch.tensor(values, dtype=torch.float64).mean())
