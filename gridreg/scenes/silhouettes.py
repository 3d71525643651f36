"""Silhouettes of opaque images on one colour: what is paper, what is the object, and what is undecided."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["silhouettes"]

# Least deviations of a colour (0 to 1, largest of the channels) from the paper's that are no noise, and that are
# matter.
_NOISE, _MATTER = 2 / 255, 0.1


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
