"""Rays in, pixels out: box intersection, occupancy, march and compositing."""

from gridreg.ops import RayMarchResult, chosen_backend, use_backend
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.ensemble import Ensemble
from gridreg.rendering.model import Model
from gridreg.rendering.occupancy import OccupancyGrid, visual_hull
from gridreg.rendering.rays import Rays, box_intersection, camera_rays, pixel_rays
from gridreg.rendering.render import (
    Field,
    MarchSettings,
    Rendered,
    SampleHook,
    composite,
    render_rays,
)
from gridreg.rendering.surroundings import CONTRACTED, JoinedSurroundings, Surroundings, contract

__all__ = [
    "CONTRACTED",
    "Camera",
    "Ensemble",
    "Field",
    "JoinedSurroundings",
    "Lens",
    "MarchSettings",
    "Model",
    "RayMarchResult",
    "OccupancyGrid",
    "Rays",
    "Rendered",
    "SampleHook",
    "Surroundings",
    "box_intersection",
    "camera_rays",
    "chosen_backend",
    "composite",
    "contract",
    "pixel_rays",
    "render_rays",
    "use_backend",
    "visual_hull",
]
