"""The photograph that would help an ensemble most: from where its members are furthest apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gridreg.errors import InputError
from gridreg.export.cameras import orbit_of_views
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model
from gridreg.scenes import Views


@dataclass(frozen=True)
class NextView:
    """A camera to photograph from next; printed, it says where to stand.

    Args:
        camera: at the median distance of the photographs, looking where they look.
        elevation: degrees above the horizon.
        nearest: name of the nearest photograph.
        turn: degrees to go from there around the object, to the right as seen from its camera.
        deviation: of the members there, root mean square over the image.
        usual: likewise, in the median of all candidates.
    """

    camera: Camera
    elevation: float
    nearest: str
    turn: float
    deviation: float
    usual: float

    def __str__(self) -> str:
        side = "right" if self.turn >= 0 else "left"
        height = "above" if self.elevation >= 0 else "below"
        place = f"{abs(self.turn):.0f} degrees to the {side} of {self.nearest}"
        return (
            f"photograph here next: {place}, {abs(self.elevation):.0f} degrees {height} the horizon; "
            f"members differ there by {self.deviation:.3f}, usually by {self.usual:.3f}"
        )


def next_view(model: Model, views: Views, *, candidates: int = 48, width: int = 48) -> NextView:
    """Return, of candidates on a sphere around the object, the camera from which members are furthest apart.

    Candidates are evenly spread over the elevations of the photographs and 20 degrees more each way, from 5 to 80.

    Args:
        model: an ensemble.
        views: what it was trained on.
        candidates: how many.
        width: of the images that are compared, pixels.

    Raises:
        InputError: for what is no ensemble, a forward-facing scene, or fewer than two candidates.
    """
    if model.warp is not None or candidates < 2:
        raise InputError(
            "next view: expected an ensemble of a scene with cameras around it, and two candidates"
        )
    orbit = orbit_of_views(views, model.field.bounds)
    lens = Lens.from_tensor(views.intrinsics[0], views.height, views.width).resized(width)
    lowest, highest = orbit.elevations
    # Objects stand on something: not below the horizon, unless a photograph is.
    reach = max(lowest - 20, min(lowest, 5.0), -80.0), min(highest + 20, 80.0)
    low, high = (math.sin(math.radians(elevation)) for elevation in reach)
    found = []
    for k in range(candidates):
        # A spiral with the golden angle.
        elevation = math.degrees(math.asin(low + (high - low) * (k + 0.5) / candidates))
        azimuth = 180 * (3 - math.sqrt(5)) * k
        camera = Camera(orbit.pose(azimuth, elevation), lens)
        rendered = model.render(camera, deviation=True)
        assert rendered is not None
        assert rendered.deviation is not None
        found.append((float(rendered.deviation.square().mean().sqrt()), elevation, camera))
    deviation, elevation, camera = max(found, key=lambda each: each[0])
    away = views.poses[:, :3, 3].double().cpu().numpy() - orbit.centre
    there = camera.pose[:3, 3].double().numpy() - orbit.centre
    nearest = int((away @ there / np.linalg.norm(away, axis=1)).argmax())
    # Around the axis, counterclockwise from above, which is to the right for who looks at the object.
    one, other = (v - (v @ orbit.up) * orbit.up for v in (away[nearest], there))
    turn = math.degrees(math.atan2(float(np.cross(one, other) @ orbit.up), float(one @ other)))
    usual = float(np.median([each[0] for each in found]))
    return NextView(camera, elevation, views.names[nearest], turn, deviation, usual)
