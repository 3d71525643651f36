"""Rays in, pixels out: box intersection, occupancy, march and compositing."""

from gridreg.ops import RayMarchResult as RayMarchResult
from gridreg.ops import chosen_backend as chosen_backend
from gridreg.ops import use_backend as use_backend
from gridreg.rendering.cameras import Camera as Camera
from gridreg.rendering.cameras import Lens as Lens
from gridreg.rendering.ensemble import Ensemble as Ensemble
from gridreg.rendering.hull import visual_hull as visual_hull
from gridreg.rendering.model import Model as Model
from gridreg.rendering.occupancy import OccupancyGrid as OccupancyGrid
from gridreg.rendering.rays import Rays as Rays
from gridreg.rendering.rays import box_intersection as box_intersection
from gridreg.rendering.rays import camera_rays as camera_rays
from gridreg.rendering.rays import pixel_rays as pixel_rays
from gridreg.rendering.render import Field as Field
from gridreg.rendering.render import MarchSettings as MarchSettings
from gridreg.rendering.render import Rendered as Rendered
from gridreg.rendering.render import SampleHook as SampleHook
from gridreg.rendering.render import composite as composite
from gridreg.rendering.render import render_rays as render_rays
from gridreg.rendering.surroundings import CONTRACTED as CONTRACTED
from gridreg.rendering.surroundings import JoinedSurroundings as JoinedSurroundings
from gridreg.rendering.surroundings import Surroundings as Surroundings
from gridreg.rendering.surroundings import contract as contract
