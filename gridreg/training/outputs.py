"""Images that a scored run leaves: renders beside targets, error maps, depth."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gridreg.errors import InputError
from gridreg.training.evaluate import Scored
from gridreg.training.images import (
    DEPTH_COLOURS,
    ImageArray,
    coloured,
    depth_limits,
    fading_into_white,
    labelled,
    row,
    save_png,
    scale_bar,
    thumbnail,
    to_uint8,
)

MAX_ERROR = 0.5
"""Upper end of the error maps' scale; fixed, so that images of different runs compare."""


def error_map(image: Tensor, target: Tensor, max_error: float = MAX_ERROR) -> ImageArray:
    """The error of each pixel, root mean square over the channels, as a colour from black to light yellow.

    Args:
        image: ``(H, W, 3)`` in [0, 1].
        target: the same shape.
        max_error: the error that gets the last colour.

    Raises:
        InputError: if the shapes differ.
    """
    return coloured(_error(image, target), 0.0, max_error)


def comparison(
    image: Tensor, target: Tensor, *, metrics: Mapping[str, float] | None = None, max_error: float = MAX_ERROR
) -> ImageArray:
    """Target, render and error map side by side, with labels and the error's scale.

    Small images are enlarged by whole pixels, so that the labels are readable.

    Args:
        image: the render, ``(H, W, 3)`` in [0, 1].
        target: the same shape.
        metrics: of this image, for the label; ``psnr`` and ``ssim_gaussian`` are shown.
        max_error: upper end of the error's scale.

    Raises:
        InputError: if the shapes differ or are not ``(H, W, 3)``.
    """
    zoom = max(1, math.ceil(200 / max(image.shape[:2])))
    size = zoom * max(image.shape[:2])
    label = "render"
    if metrics and "psnr" in metrics:
        label += f"  {metrics['psnr']:.2f} dB"
    if metrics and "ssim_gaussian" in metrics:
        label += f"  SSIM {metrics['ssim_gaussian']:.3f}"
    error = thumbnail(error_map(image, target, max_error), size)
    return row(
        [
            labelled(thumbnail(to_uint8(target), size), "target"),
            labelled(thumbnail(to_uint8(image), size), label),
            labelled(error, "error (RMS of channels)"),
            labelled(scale_bar(error.shape[0], 0.0, max_error), ""),
        ]
    )


def depth_image(depth: Tensor, opacity: Tensor) -> ImageArray:
    """The mean distance of what each pixel hits, bright is near, with its scale in world units.

    The scale reaches from the 1st to the 99th percentile of the pixels with an opacity over 0.5; the others
    fade into white.

    Args:
        depth: ``(H, W)`` weighted sum of distances along the ray (0 where nothing is hit).
        opacity: ``(H, W)`` in [0, 1].

    Raises:
        InputError: if the shapes differ.
    """
    if depth.shape != opacity.shape or depth.ndim != 2:
        raise InputError(
            f"depth, opacity: {tuple(depth.shape)}, {tuple(opacity.shape)}; expected (H, W) both"
        )
    share = opacity.detach().double().nan_to_num(0).clamp(0, 1).cpu()
    distance = depth.detach().double().nan_to_num(0).cpu() / share.clamp(min=1e-6)
    near, far = depth_limits(distance[share > 0.5])
    image = fading_into_white(coloured(distance.numpy(), near, far, DEPTH_COLOURS), share)
    zoom = max(1, math.ceil(200 / max(share.shape)))
    body = thumbnail(image, zoom * max(share.shape))
    return row([body, scale_bar(body.shape[0], near, far, DEPTH_COLOURS, "depth")])


def save_view(
    folder: str | os.PathLike[str],
    name: str,
    image: Tensor,
    target: Tensor,
    *,
    depth: Tensor | None = None,
    opacity: Tensor | None = None,
    metrics: Mapping[str, float] | None = None,
) -> None:
    """Write one scored view: ``NAME.png`` (the render alone), ``NAME_compare.png`` and ``NAME_depth.png``.

    Args:
        folder: where to; must exist.
        name: of the view, fit for a file name.
        image: the render, ``(H, W, 3)`` in [0, 1].
        target: the same shape, on the same background.
        depth: ``(H, W)``, see ``depth_image``; without it and ``opacity`` there is no depth image.
        opacity: ``(H, W)``.
        metrics: of this view, for the label.

    Raises:
        InputError: if the shapes do not fit, or the place is not writable.
    """
    place = Path(folder)
    save_png(place / f"{name}.png", to_uint8(image))
    save_png(place / f"{name}_compare.png", comparison(image, target, metrics=metrics))
    if depth is not None and opacity is not None:
        save_png(place / f"{name}_depth.png", depth_image(depth, opacity))


def save_scored(folder: str | os.PathLike[str], view: Scored) -> None:
    """``save_view`` of a view that `gridreg.training.evaluate.score_views` has scored.

    Raises:
        InputError: if the place is not writable.
    """
    image = view.rendered
    save_view(
        folder,
        view.name,
        image.colour,
        view.target,
        depth=image.depth,
        opacity=image.opacity,
        metrics=view.metrics,
    )


def save_contact_sheet(
    path: str | os.PathLike[str],
    names: Sequence[str],
    images: Sequence[Tensor],
    targets: Sequence[Tensor],
    *,
    psnrs: Sequence[float] | None = None,
    columns: int = 5,
    size: int = 160,
) -> None:
    """Write one PNG with all views small: target and render side by side, name and PSNR above.

    Args:
        path: the PNG.
        names: of the views, ``V`` of them.
        images: the renders, ``(H, W, 3)`` each.
        targets: likewise.
        psnrs: of the views, dB.
        columns: pairs in a row.
        size: longer side of a small image, pixels.

    Raises:
        InputError: if there is no view, the numbers differ, or the place is not writable.
    """
    if not names or not len(names) == len(images) == len(targets):
        raise InputError(
            f"names, images, targets: {len(names)}, {len(images)}, {len(targets)}; expected as many of each"
        )
    cells = []
    for index, (name, image, target) in enumerate(zip(names, images, targets, strict=True)):
        pair = row([thumbnail(to_uint8(target), size), thumbnail(to_uint8(image), size)], gap=1)
        cells.append(labelled(pair, f"{name}  {psnrs[index]:.2f} dB" if psnrs is not None else name))
    rows = [row(cells[start : start + columns], gap=8) for start in range(0, len(cells), columns)]
    width = max(image.shape[1] for image in rows)
    padded = [
        np.pad(image, ((0, 8), (0, width - image.shape[1]), (0, 0)), constant_values=255) for image in rows
    ]
    save_png(path, np.concatenate(padded))


def _error(image: Tensor, target: Tensor) -> np.ndarray[Any, np.dtype[np.float64]]:
    if image.shape != target.shape:
        raise InputError(
            f"image, target: {tuple(image.shape)} and {tuple(target.shape)}; expected equal shapes"
        )
    difference = (image.detach().double().clamp(0, 1) - target.detach().double().clamp(0, 1)).cpu()
    error: np.ndarray[Any, np.dtype[np.float64]] = difference.square().mean(-1).sqrt().numpy()
    return error
