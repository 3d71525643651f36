"""Scenes: posed images from a folder, selected by a named protocol."""

from __future__ import annotations

from gridreg.scenes.load import load_scene
from gridreg.scenes.protocols import PROTOCOLS, Protocol, get_protocol
from gridreg.scenes.views import Scene, Views, background_colour

__all__ = ["PROTOCOLS", "Protocol", "Scene", "Views", "background_colour", "get_protocol", "load_scene"]
