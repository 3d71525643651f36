"""Scenes: posed images from a folder, selected by a named protocol, and a scene that needs no download."""

from __future__ import annotations

from gridreg.scenes.builtin import (
    builtin_depth,
    builtin_mesh,
    builtin_photographs,
    builtin_scene,
    builtin_signed_distance,
    builtin_surface,
    photograph_mesh,
)
from gridreg.scenes.llff import ndc_rays
from gridreg.scenes.load import default_protocol, load_scene
from gridreg.scenes.prepare import Prepared, prepare
from gridreg.scenes.protocols import PROTOCOLS, Protocol, get_protocol
from gridreg.scenes.views import IN_PLACE, Scene, Views, World, background_colour

__all__ = [
    "IN_PLACE",
    "PROTOCOLS",
    "Prepared",
    "Protocol",
    "Scene",
    "Views",
    "World",
    "background_colour",
    "builtin_depth",
    "builtin_mesh",
    "builtin_photographs",
    "builtin_scene",
    "builtin_signed_distance",
    "builtin_surface",
    "default_protocol",
    "get_protocol",
    "load_scene",
    "ndc_rays",
    "photograph_mesh",
    "prepare",
]
