"""Silhouettes of opaque images on one colour: what is paper, what is the object, and what is undecided."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gridreg.scenes.pixels import as_floats

__all__ = ["backdrop_of", "is_opaque", "silhouettes", "silhouettes_before"]

# Least deviations of a colour (0 to 1, largest of the channels) from the paper's that are no noise, and that are
# matter.
_NOISE, _MATTER = 2 / 255, 0.1


# Fraction of the edge that is looked at for a backdrop, and of its pixels that must have the colour up to a
# bound.
_FRAME, _AGREEING, _CLOSE = 0.02, 0.9, 0.05


def is_opaque(pixels: Tensor) -> bool:
    """Tell whether images ``(V, H, W, 4)``, float32 or uint8, have no transparent pixel."""
    top = 1 if pixels.is_floating_point() else 255
    return not bool((pixels[..., 3] < top).any())


def backdrop_of(pixels: Tensor) -> Tensor | None:
    """Return the one colour ``(3,)`` that opaque images ``(V, H, W, 4)`` have along their edges, None without one."""
    if not len(pixels) or not is_opaque(pixels):
        return None
    colours = _along_edges(pixels)
    colour = colours.median(dim=0).values
    agreeing = ((colours - colour).abs().amax(dim=-1) < _CLOSE).float().mean()
    return colour if float(agreeing) >= _AGREEING else None


def silhouettes_before(pixels: Tensor, backdrop: Tensor) -> Tensor:
    """Estimate the alpha of opaque images ``(V, H, W, 4)`` before their `backdrop_of`, see `silhouettes`."""
    off = (_along_edges(pixels) - backdrop).abs().amax(dim=-1)
    return silhouettes(as_floats(pixels[..., :3]), backdrop, off[off < _CLOSE])


def _along_edges(pixels: Tensor) -> Tensor:
    """Colours ``(N, 3)`` along the edges of all images."""
    edge = max(1, round(_FRAME * min(pixels.shape[1:3])))
    rgb = pixels[..., :3]
    sides = rgb[:, :edge], rgb[:, -edge:], rgb[:, :, :edge], rgb[:, :, -edge:]
    return as_floats(torch.cat([side.reshape(-1, 3) for side in sides]))


def silhouettes(rgb: Tensor, paper: Tensor, edges: Tensor) -> Tensor:
    """Estimate the alpha of opaque images on one colour.

    Paper is what has its colour, up to the noise along the edges of the images, and is connected to an edge: a white
    spot on the object is not. Matter is what is of another colour, one pixel and more from paper. Mixed pixels of the
    outline, paper seen through a handle, and white spots stay undecided.

    Args:
        rgb: ``(V, H, W, 3)``.
        paper: ``(3,)`` its colour.
        edges: ``(N,)`` deviations of pixels along the edges that show paper.

    Returns:
        ``(V, H, W)``: 0 paper, 1 matter, NaN undecided.

    Example:
        >>> rgb = torch.ones(1, 9, 9, 3)
        >>> rgb[:, 2:7, 2:7] = 0.2
        >>> rgb[:, 4, 4] = 1.0
        >>> silhouettes(rgb, torch.ones(3), torch.zeros(4))[0, 4].tolist()
        [0.0, 0.0, nan, 1.0, nan, 1.0, nan, 0.0, 0.0]
    """
    from scipy import ndimage  # type: ignore[import-untyped]

    off = (rgb - paper).abs().amax(dim=-1).cpu().numpy()
    noise = max(_NOISE, 1.5 * float(np.quantile(edges.cpu().numpy(), 0.99)))
    around = np.ones((3, 3), dtype=bool)
    found = np.full(off.shape, np.nan, dtype=np.float32)
    for alpha, deviation in zip(found, off, strict=True):
        labels, _ = ndimage.label(deviation <= noise)
        sides = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        background = np.isin(labels, sides[sides > 0])
        alpha[(deviation > max(_MATTER, 2 * noise)) & ~ndimage.binary_dilation(background, around)] = 1
        alpha[background] = 0
    return torch.from_numpy(found).to(rgb.device)
