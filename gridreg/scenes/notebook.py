"""HTML of scenes and runs for notebooks: a title, a line of facts, and small images."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable
from itertools import islice

import numpy as np
from PIL import Image
from torch import Tensor

__all__ = ["card", "thumbnails"]

_EDGE, _MOST = 96, 12


def card(title: str, facts: str, images: Iterable[bytes] = ()) -> str:
    """HTML with a title, a line under it, and images, PNG or JPEG bytes, in a row that wraps."""
    shown = "".join(
        f'<img alt="" style="margin:2px" src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        for data in images
    )
    return f"<div><b>{html.escape(title)}</b><br>{html.escape(facts)}<br>{shown}</div>"


def thumbnails(images: Iterable[Tensor]) -> list[bytes]:
    """The first images ``(H, W, 3)`` in [0, 1], small, as PNG."""
    found = []
    for image in islice(images, _MOST):
        small = Image.fromarray(np.asarray((image.clamp(0, 1) * 255).round().byte().cpu()))
        small.thumbnail((_EDGE, _EDGE))
        file = io.BytesIO()
        small.save(file, "PNG")
        found.append(file.getvalue())
    return found
