"""Images of renders: colour, depth with a colour bar, opacity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.rendering import Rendered
from gridreg.training.images import (
    DEPTH_COLOURS,
    ImageArray,
    coloured,
    depth_limits,
    fading_into_white,
    scale_bar,
    to_uint8,
)

MODES = ("rgb", "depth", "opacity", "deviation")
"""Quantities of a render that an image can show."""

DepthRange = tuple[float, float]

MAX_DEVIATION = 0.2
"""Upper end of the scale of deviations; fixed, so that images compare."""

# Depths of rays that hit next to nothing are noise.
_SEEN = 0.05
# World units; beyond what a field holds, within what the viewer's depth images can say.
_FAR = 150.0


def check_mode(mode: str) -> None:
    """Refuse a mode that is not in `MODES`.

    Raises:
        InputError: naming the modes.
    """
    if mode not in MODES:
        raise InputError(f"mode: found {mode!r}, expected one of {', '.join(MODES)}")


def depth_range(renders: Sequence[Rendered]) -> DepthRange:
    """Near and far of what is seen: the 1st and 99th percentile of the depths of pixels that hit something.

    Returns:
        Distances from the camera in world units; (0, 1) if nothing is seen.
    """
    depths = [(r.depth / r.opacity.clamp(min=_SEEN))[r.opacity > 0.5] for r in renders]
    return depth_limits(torch.cat([d.reshape(-1) for d in depths]) if depths else torch.zeros(0))


def to_image(rendered: Rendered, mode: str, depths: DepthRange | None = None) -> ImageArray:
    """One mode of a render as an image.

    Depth is the mean distance of what a pixel hits, from near (dark blue) to far (dark red), blended into
    white where little is hit; opacity is grey, white for 1. The deviation of an ensemble's members goes from black
    for 0 to light yellow for `MAX_DEVIATION`.

    Args:
        rendered: colour ``(H, W, 3)``, opacity and depth ``(H, W)``.
        mode: one of `MODES`.
        depths: near and far end of the colours, world units; None: of this render.

    Returns:
        ``(H, W, 3)`` uint8.

    Raises:
        InputError: for an unknown mode.
    """
    check_mode(mode)
    if mode == "rgb":
        return to_uint8(rendered.colour)
    if mode == "opacity":
        return to_uint8(rendered.opacity[..., None].expand(*rendered.opacity.shape, 3))
    if mode == "deviation":
        if rendered.deviation is None:
            raise InputError("deviation: found a render without it, expected one of an ensemble")
        return coloured(rendered.deviation.double().cpu().numpy(), 0.0, MAX_DEVIATION)
    near, far = depth_range([rendered]) if depths is None else depths
    mean = rendered.depth / rendered.opacity.clamp(min=_SEEN)
    colours = coloured(mean.detach().double().cpu().numpy(), near, far, DEPTH_COLOURS)
    return fading_into_white(colours, rendered.opacity)


def colour_bar(height: int, depths: DepthRange) -> ImageArray:
    """The scale of depth images ``(height, 64, 3)`` uint8: near below, far above, in world units."""
    return scale_bar(height, *depths, DEPTH_COLOURS)


def z_depth(rendered: Rendered, intrinsics: tuple[float, float, float, float]) -> NDArray[np.float32]:
    """Mean depth along the optical axis, as depth buffers have it, far away where less than half is hit.

    Args:
        rendered: opacity and depth ``(H, W)``.
        intrinsics: fx, fy, cx, cy in pixels.

    Returns:
        ``(H, W)`` world units.
    """
    fx, fy, cx, cy = intrinsics
    height, width = rendered.depth.shape
    x = (torch.arange(width) + 0.5 - cx) / fx
    y = (torch.arange(height) + 0.5 - cy) / fy
    slant = torch.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    opacity = rendered.opacity.cpu()
    mean = rendered.depth.cpu() / opacity.clamp(min=1e-6) / slant
    found: NDArray[np.float32] = mean.masked_fill(opacity <= 0.5, _FAR).numpy()
    return found
