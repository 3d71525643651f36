"""Memory that kernels use between launches and nobody keeps.

Fresh memory comes from the system page by page; for the megabytes of a backward pass that costs as much as the pass.
"""

from __future__ import annotations

import math
import threading

import torch
from torch import Tensor

_local = threading.local()


def workspace(name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """A contiguous tensor of undefined content that is this thread's own until it asks for the same name again.

    Example:
        >>> workspace("doctest", 2, 3).shape, workspace("doctest", 4).data_ptr() == workspace("doctest", 1).data_ptr()
        (torch.Size([2, 3]), True)
    """
    kept: dict[tuple[str, torch.dtype], Tensor] = _local.__dict__.setdefault("kept", {})
    count = math.prod(shape)
    buffer = kept.get((name, dtype))
    if buffer is None or buffer.numel() < count:
        # A little more than asked for: the number of samples changes from step to step.
        buffer = kept[(name, dtype)] = torch.empty(count + count // 4, dtype=dtype)
    return buffer[:count].view(shape)
