"""Pixels as bytes where these say the same as floats."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["as_bytes", "as_floats"]


def as_floats(pixels: Tensor) -> Tensor:
    """Return pixels as float32: bytes divided by 255, rounded as NumPy does; floats as they are.

    >>> as_floats(torch.tensor([0, 51, 255], dtype=torch.uint8))
    tensor([0.0000, 0.2000, 1.0000])
    """
    if pixels.is_floating_point():
        return pixels
    # By a tensor: other devices multiply by the reciprocal of a number, which rounds otherwise.
    return pixels.float().div_(torch.tensor(255.0, device=pixels.device))


def as_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8] | None:
    """Return an image as bytes from which it comes back bit for bit; None if there are none."""
    levels = np.rint(image * np.float32(255)).astype(np.uint8)
    return levels if np.array_equal(np.divide(levels, 255, dtype=np.float32), image) else None
