"""The built-in scene: a lighthouse on a floating island, with exact depth and geometry.

It is what runs without any data at hand. It is no published benchmark, and no table may list it as one.
"""

from __future__ import annotations

from gridreg.scenes.builtin.lighthouse import BOUNDS
from gridreg.scenes.builtin.photographs import builtin_photographs, photograph_mesh
from gridreg.scenes.builtin.surface import builtin_mesh, builtin_signed_distance, builtin_surface
from gridreg.scenes.builtin.write import builtin_depth, builtin_scene

__all__ = [
    "BOUNDS",
    "builtin_depth",
    "builtin_mesh",
    "builtin_photographs",
    "builtin_scene",
    "builtin_signed_distance",
    "builtin_surface",
    "photograph_mesh",
]
