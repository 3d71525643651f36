"""Images that a scored run leaves: renders beside targets, error maps, depth."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

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

# Of the contact sheet: pairs in a row, and the longer side of a small image, pixels.
_COLUMNS, _SMALL = 5, 160


def error_map(image: Tensor, target: Tensor) -> ImageArray:
    """The error of each pixel, root mean square over the channels, as a colour from black to light yellow.

    Args:
        image: ``(H, W, 3)`` in [0, 1].
        target: the same shape.

    Raises:
        InputError: if the shapes differ.
    """
    if image.shape != target.shape:
        raise InputError(
            f"image, target: {tuple(image.shape)} and {tuple(target.shape)}; expected equal shapes"
        )
    difference = (image.detach().double().clamp(0, 1) - target.detach().double().clamp(0, 1)).cpu()
    return coloured(difference.square().mean(-1).sqrt().numpy(), 0.0, MAX_ERROR)


def comparison(image: Tensor, target: Tensor, metrics: Mapping[str, float]) -> ImageArray:
    """Target, render and error map side by side, with labels and the error's scale.

    Small images are enlarged by whole pixels, so that the labels are readable.

    Args:
        image: the render, ``(H, W, 3)`` in [0, 1].
        target: the same shape.
        metrics: of this image, for the label; ``psnr`` and ``ssim_gaussian`` are shown.

    Raises:
        InputError: if the shapes differ or are not ``(H, W, 3)``.
    """
    zoom = max(1, math.ceil(200 / max(image.shape[:2])))
    size = zoom * max(image.shape[:2])
    label = "render"
    if "psnr" in metrics:
        label += f"  {metrics['psnr']:.2f} dB"
    if "ssim_gaussian" in metrics:
        label += f"  SSIM {metrics['ssim_gaussian']:.3f}"
    error = thumbnail(error_map(image, target), size)
    return row(
        [
            labelled(thumbnail(to_uint8(target), size), "target"),
            labelled(thumbnail(to_uint8(image), size), label),
            labelled(error, "error (RMS of channels)"),
            labelled(scale_bar(error.shape[0], 0.0, MAX_ERROR), ""),
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


def save_scored(folder: str | os.PathLike[str], view: Scored) -> None:
    """Write a scored view: ``NAME.png`` (the render alone), ``NAME_compare.png`` and ``NAME_depth.png``.

    Raises:
        InputError: if the place is not writable.
    """
    image, place = view.rendered, Path(folder)
    save_png(place / f"{view.name}.png", to_uint8(image.colour))
    save_png(place / f"{view.name}_compare.png", comparison(image.colour, view.target, view.metrics))
    save_png(place / f"{view.name}_depth.png", depth_image(image.depth, image.opacity))


def save_contact_sheet(path: str | os.PathLike[str], views: Sequence[Scored]) -> None:
    """Write one PNG with all views small: target and render side by side, name and PSNR above.

    Raises:
        InputError: if the place is not writable.
    """
    cells = []
    for view in views:
        pair = [thumbnail(to_uint8(image), _SMALL) for image in (view.target, view.rendered.colour)]
        cells.append(labelled(row(pair, gap=1), f"{view.name}  {view.metrics['psnr']:.2f} dB"))
    rows = [row(cells[start : start + _COLUMNS], gap=8) for start in range(0, len(cells), _COLUMNS)]
    width = max(image.shape[1] for image in rows)
    padded = [
        np.pad(image, ((0, 8), (0, width - image.shape[1]), (0, 0)), constant_values=255) for image in rows
    ]
    save_png(path, np.concatenate(padded))
