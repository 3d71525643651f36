"""Pictures of renders: colour, depth with a colour bar, opacity."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Rendered

__all__ = ["MODES", "DepthRange", "beside", "check_mode", "colour_bar", "depth_range", "picture", "z_depth"]

MODES = ("rgb", "depth", "opacity")
"""What can be seen of a render."""

DepthRange = tuple[float, float]
Pixels = NDArray[np.uint8]

_COLOURMAP = "turbo"
# Depths of rays that hit next to nothing are noise.
_SEEN = 0.05
# World units; beyond what a field holds, within what the viewer's depth pictures can say.
_FAR = 150.0


def check_mode(mode: str) -> None:
    """Refuse a mode that is not in `MODES`.

    Raises:
        InputError: naming the modes.
    """
    if mode not in MODES:
        raise InputError(f"mode: found {mode!r}, expected one of {', '.join(MODES)}")


def _bytes(values: Tensor) -> Pixels:
    pixels: Pixels = (values.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return pixels


def depth_range(renders: Sequence[Rendered]) -> DepthRange:
    """Near and far of what is seen: the 1st and 99th percentile of the depths of pixels that hit something.

    Returns:
        Distances from the camera in world units; (0, 1) if nothing is seen.
    """
    depths = [(r.depth / r.opacity.clamp(min=_SEEN))[r.opacity > 0.5] for r in renders]
    seen = torch.cat([d.reshape(-1) for d in depths]).double().cpu().numpy() if depths else np.zeros(0)
    if not seen.size:
        return 0.0, 1.0
    near, far = (float(v) for v in np.quantile(seen, [0.01, 0.99]))
    # One flat wall would leave no range to spread colours over.
    margin = max(0.05 * (far - near), 1e-3 * abs(far), 1e-6)
    return near - margin, far + margin


def picture(rendered: Rendered, mode: str, depths: DepthRange | None = None) -> Pixels:
    """One mode of a render as an image.

    Depth is the mean distance of what a pixel hits, from near (dark blue) to far (dark red), blended into
    white where little is hit; opacity is grey, white for 1.

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
        return _bytes(rendered.colour)
    if mode == "opacity":
        return _bytes(rendered.opacity[..., None].expand(*rendered.opacity.shape, 3))
    near, far = depth_range([rendered]) if depths is None else depths
    mean = rendered.depth / rendered.opacity.clamp(min=_SEEN)
    place = ((mean - near) / max(far - near, 1e-9)).clamp(0, 1)
    table = torch.from_numpy(_colours())[(place * 255).round().long().cpu()]
    share = rendered.opacity.clamp(0, 1)[..., None].cpu()
    return _bytes(table * share + (1 - share))


def _colours() -> NDArray[np.float32]:
    """The 256 colours of the depth scale, ``(256, 3)`` in [0, 1]."""
    scale = matplotlib.colormaps[_COLOURMAP](np.linspace(0, 1, 256))
    return np.asarray(scale[:, :3], dtype=np.float32)


def colour_bar(height: int, depths: DepthRange, width: int = 64) -> Pixels:
    """The scale of depth pictures: near below, far above, in world units.

    Args:
        height: pixels.
        depths: near and far, world units.
        width: pixels, the figures included.

    Returns:
        ``(height, width, 3)`` uint8.
    """
    margin = min(8, height // 4)
    scale = np.full((height, width, 3), 255, np.uint8)
    rows = height - 2 * margin
    ramp = (_colours()[np.linspace(255, 0, rows).round().astype(int)] * 255).round().astype(np.uint8)
    scale[margin : margin + rows, 4:16] = ramp[:, None]
    image = Image.fromarray(scale)
    draw = ImageDraw.Draw(image)
    labels = max(2, min(5, rows // 24))
    for share in np.linspace(0, 1, labels):
        y = margin + round((1 - share) * (rows - 1))
        value = depths[0] + share * (depths[1] - depths[0])
        draw.text((20, y), f"{value:.3g}", fill=(0, 0, 0), anchor="lm")
    return np.asarray(image)


def beside(pictures: Sequence[Pixels]) -> Pixels:
    """Pictures side by side; lower ones are filled up with white below.

    Args:
        pictures: at least one, ``(H, W, 3)`` uint8 each.
    """
    height = max(p.shape[0] for p in pictures)
    padded = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0)), constant_values=255) for p in pictures]
    return np.concatenate(padded, axis=1)


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
