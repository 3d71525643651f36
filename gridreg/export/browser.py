"""The viewer's side of viser: a server, the cameras of browsers, training cameras to look at."""

from __future__ import annotations

import importlib.util
import math
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]
from torch import Tensor

from gridreg.errors import InputError
from gridreg.export._admission import Admission
from gridreg.export.cameras import Orbit
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import Views
from gridreg.training.images import to_uint8

# The browser's cameras look along +z with y down (OpenCV).
_FLIP = np.diag([1.0, -1.0, -1.0])
_MOST_FRUSTUMS = 100


@contextmanager
def quiet_console() -> Iterator[None]:
    """Keep viser from printing its own banners."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def check_address(host: str, port: int) -> int:
    """The port to listen on (0: a free one), if a viewer could listen there now.

    Raises:
        InputError: without viser, if the port is taken, or if the host is none of this machine's.
    """
    if importlib.util.find_spec("viser") is None:
        raise InputError("viewer: viser is not installed, expected: pip install 'gridreg[viewer]'")
    if not 0 <= port <= 65535:
        raise InputError(f"port={port}: expected a number from 0 to 65535")
    # viser would silently take the next free port.
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        try:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(
                f"viewer: cannot listen on {host}:{port}: {reason}; choose another port"
            ) from error


def start_server(host: str, port: int, admission: Admission | None = None) -> Any:
    """Return a ``viser.ViserServer`` on exactly this port (0: any free one).

    Args:
        host, port: to listen on.
        admission: who may talk to it; None: as `Admission` has it for the host.

    Raises:
        InputError: as `check_address`.
    """
    port = check_address(host, port)
    import viser

    admission = Admission(host) if admission is None else admission
    with quiet_console(), admission.at_the_door():
        server = viser.ViserServer(host=host, port=port, label=admission.title, verbose=False)
    admission.server = server._websock_server
    if server.get_port() != port:
        server.stop()
        raise InputError(f"viewer: port {port} was taken meanwhile; choose another port")
    server.gui.configure_theme(dark_mode=False, show_logo=False, show_share_button=False)
    # A page could ask for a public address of this server; nobody here has agreed to that.
    setattr(server, "request_share_url", lambda *_, **__: None)  # noqa: B010
    return server


def image_shape(client: Any, size: int) -> tuple[int, int]:
    """Height and width at rest of a client's image: no more pixels than its window has."""
    height, width = max(1, client.camera.image_height), max(1, client.camera.image_width)
    factor = min(1.0, size / max(height, width))
    return max(1, round(height * factor)), max(1, round(width * factor))


def camera_of(client: Any, shape: tuple[int, int], width: int) -> Camera:
    """The camera of a browser's window, for an image of a width."""
    camera = client.camera
    height = max(1, round(shape[0] * width / shape[1]))
    w, x, y, z = (float(v) for v in camera.wxyz)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() @ _FLIP
    pose[:3, 3] = camera.position
    focal = shape[0] / 2 / math.tan(float(camera.fov) / 2)
    lens = Lens((focal * width / shape[1], focal * height / shape[0], width / 2, height / 2), height, width)
    return Camera(torch.from_numpy(pose).float(), lens)


def add_frustums(
    server: Any, views: Views, background: Tensor, depth: float, clicked: Callable[[Any, int], None]
) -> dict[int, Any]:
    """The cameras of views with their images ``depth`` world units before them, by number.

    Args:
        server: a ``viser.ViserServer``.
        views: the cameras; of more than a hundred not all are shown.
        background: ``(3,)`` behind the images.
        depth: world units.
        clicked: called with the ``viser.ClientHandle`` and the number of the view that was clicked.
    """
    found = {}
    stride = max(1, math.ceil(len(views) / _MOST_FRUSTUMS))
    for i in range(0, len(views), stride):
        small = Image.fromarray(to_uint8(views.over(i, background)))
        small.thumbnail((128, 128))
        pose = views.poses[i].double().cpu().numpy()
        x, y, z, w = Rotation.from_matrix(pose[:3, :3] @ _FLIP).as_quat()
        half = views.height / 2 / float(views.intrinsics[i, 1])
        aspect = views.width / views.height
        # viser scales a frustum by its volume.
        scale = depth * (half * half * aspect / 3) ** (1 / 3)
        frustum = server.scene.add_camera_frustum(
            f"/cameras/{views.names[i]}",
            fov=2 * math.atan(half),
            aspect=aspect,
            scale=scale,
            thickness=0.03 * depth,
            image=np.asarray(small),
            wxyz=(w, x, y, z),
            position=pose[:3, 3],
        )
        frustum.on_click(partial(_clicked, clicked, i))
        found[i] = frustum
    return found


def place_camera(server: Any, orbit: Orbit, fraction: float, angle: float) -> None:
    """Set the first camera of every browser: on an orbit, a fraction of its radius away, the angle of view in rad."""
    server.scene.set_up_direction(tuple(float(v) for v in orbit.up))
    camera, place = server.initial_camera, orbit.pose(0.0).double().numpy()[:3, 3]
    camera.position = orbit.centre + fraction * (place - orbit.centre)
    camera.look_at, camera.up, camera.fov = orbit.centre, orbit.up, angle


def _clicked(clicked: Callable[[Any, int], None], number: int, event: Any) -> None:
    clicked(event.client, number)


def go_to(client: Any, pose: Tensor) -> None:
    """Move a browser's camera to a camera-to-world pose ``(4, 4)``, turned to the scene's middle distance."""
    place = pose.double().cpu().numpy()
    with client.atomic():
        client.camera.position = place[:3, 3]
        client.camera.look_at = place[:3, 3] - np.linalg.norm(place[:3, 3]) * place[:3, 2]


def fit_upright(client: Any, angle: float) -> None:
    """On a window that is higher than wide, such as a telephone's, give its width the angle, radians."""
    height, width = client.camera.image_height, client.camera.image_width
    if height > width > 0:
        client.camera.fov = 2 * math.atan(math.tan(angle / 2) * height / width)
