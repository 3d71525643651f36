"""Pieces of pages that need nothing beside them: templates, and images as data URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import decoding

LONGEST_SIDE = 400
"""Of an image in a page, pixels."""

_QUALITY = 88
# Above the images in NAME_compare.png stand their names.
_STRIP = 20


@cache
def page_environment(package: str) -> Environment:
    """Templates in the folder ``page`` of a package, and behind them those of this one; in HTML, text is escaped."""
    return Environment(
        loader=ChoiceLoader(
            [PackageLoader(name, "page") for name in dict.fromkeys([package, "gridreg.export"])]
        ),
        autoescape=lambda name: name is not None and name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def spread_views(names: Iterable[str], count: int) -> list[str]:
    """At most so many of some views, evenly spread, by the number in the name: r_8 comes before r_16."""
    order = {name: int("".join(filter(str.isdecimal, name)) or 0) for name in names}
    views = sorted(order, key=lambda name: (order[name], name))
    chosen = np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)
    return [views[index] for index in chosen.tolist()]


def open_image(path: Path) -> Image.Image | None:
    """An image, without alpha; None if it cannot be read."""
    try:
        with decoding.open_image(path) as image:
            converted: Image.Image = image.convert("RGB")
            return converted
    except InputError:
        return None


def target_beside(comparison: Path, render: Image.Image) -> Image.Image | None:
    """The target, at the left of ``NAME_compare.png``, enlarged by whole pixels; None if it is not there."""
    found = open_image(comparison)
    if found is None:
        return None
    zoom = (found.height - _STRIP) // render.height
    if zoom < 1 or found.width < zoom * render.width:
        return None
    whole = found.crop((0, _STRIP, zoom * render.width, _STRIP + zoom * render.height))
    return whole.resize(render.size, Image.Resampling.BOX)


def encode(image: Image.Image) -> str:
    """An image as data URI, at most `LONGEST_SIDE` pixels: PNG, or JPEG without colour subsampling if smaller.

    >>> encode(Image.new("RGB", (4, 4)))[:22]
    'data:image/png;base64,'
    """
    if max(image.size) > LONGEST_SIDE:
        scale = LONGEST_SIDE / max(image.size)
        size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        image = image.resize(size, Image.Resampling.BOX, reducing_gap=None)
    return min(data_uri(image, "png"), data_uri(image, "jpeg"), key=len)


def data_uri(image: Image.Image, kind: str = "png") -> str:
    """An image as data URI, in the format ``png`` or ``jpeg``."""
    buffer = io.BytesIO()
    options: dict[str, Any] = {"optimize": True} if kind == "png" else {"quality": _QUALITY, "subsampling": 0}
    image.save(buffer, format=kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode()
