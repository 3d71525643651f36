"""Looking at a field in a browser, also while it is being trained (viser)."""

from __future__ import annotations

import contextlib
import io
import math
import sys
import threading
import time
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from gridreg.export._admission import Admission
from gridreg.export.browser import add_frustums, camera_of, image_shape, quiet_console, start_server
from gridreg.export.cameras import orbit_of_box, orbit_of_views
from gridreg.export.images import colour_bar, depth_range, to_image, z_depth
from gridreg.export.pace import Pace
from gridreg.export.preview import Preview
from gridreg.export.viewer_crop import CropControls
from gridreg.export.viewer_panel import Look, Panel
from gridreg.rendering import Rendered
from gridreg.rendering.cameras import Camera
from gridreg.rendering.model import Model
from gridreg.scenes import Views, World
from gridreg.training.images import ImageArray

__all__ = ["Viewer"]

# Seconds without movement after which the image is sharpened.
_REST = 0.25


class Viewer:
    """A page with the field in it: orbit camera, training cameras, colour, depth, opacity, masks at any step.

    A thread of its own draws a private copy of the model (`Preview`), so nothing that is set in the page
    changes the field. A trainer gives new copies between two iterations, when one is wanted::

        if viewer.wants_update:
            viewer.update(Model(trainer.field, trainer.occupancy, trainer.march, background, trainer.handle))

    Nothing is copied or drawn while no browser looks.

    Args:
        model: what to show first.
        views: training views, drawn as cameras with their images; they also say where up is.
        host: address to listen on; 127.0.0.1 is reached from this machine alone.
        port: 0: any free one.
        size: longer edge of the image at rest, pixels; can be changed in the page.
        refresh: least time between two copies of a field in training, seconds.
        quiet: do not say on standard error where the page is.

    Raises:
        InputError: without viser, if the port is taken, or if the host is none of this machine's.
    """

    def __init__(
        self,
        model: Model,
        views: Views | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        size: int = 512,
        refresh: float = 2.0,
        quiet: bool = False,
    ) -> None:
        self._preview = Preview(model)
        self._admission = Admission(host)
        self._server = start_server(host, port, self._admission)
        self.host, self.port = host, int(self._server.get_port())
        self._refresh, self._updated = refresh, time.monotonic()
        self._news = threading.Condition()
        self._screens: dict[int, _Screen] = {}
        self._wishes: list[Any] = []
        self._closed = False
        self._pace = Pace()
        steps = (self._preview.step, self._preview.total_steps)
        self._panel = Panel(self._server, self._preview.masks, steps, self._touch, self._wish, size)
        self._stand(model, views)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self._thread = threading.Thread(target=self._run, name="gridreg-viewer", daemon=True)
        self._thread.start()
        reach = "this machine only" if self._admission.local else "the network, with this token"
        if not quiet:
            print(f"viewer: {self.url} (reached from {reach})", file=sys.stderr, flush=True)

    @property
    def url(self) -> str:
        """Address of the page, with its token where one is needed."""
        name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        name = f"[{name}]" if ":" in name else name
        query = f"/?token={self._admission.token}" if self._admission.needs_token else ""
        return f"http://{name}:{self.port}{query}"

    @property
    def wants_update(self) -> bool:
        """True if somebody looks and the copy is old; cheap enough to ask at every iteration."""
        return bool(self._screens) and time.monotonic() - self._updated > self._refresh

    def update(self, model: Model) -> None:
        """Show a new state of the field; it is copied here and now, in the caller's thread.

        Raises:
            InputError: if the field cannot be copied.
        """
        preview = Preview(model)
        with self._news:
            self._preview, self._updated = preview, time.monotonic()
        self._panel.reached(preview.step)
        self._touch()

    def close(self) -> None:
        """Stop drawing and take the page away; a second call does nothing."""
        with self._news:
            if self._closed:
                return
            self._closed = True
            self._news.notify_all()
        self._thread.join()
        with quiet_console():
            self._server.stop()

    def offer_crop(self, path: Path, bounds: Tensor, world: World) -> CropControls:
        """Add controls for a box, which are saved to a file that ``gridreg mesh --crop`` takes."""
        return CropControls(self._server, bounds, world, path)

    @property
    def watched(self) -> bool:
        """True while a browser shows the page."""
        return bool(self._screens)

    def wait(self, *, watched: bool = False) -> None:
        """Stay until Ctrl-C; with ``watched`` only as long as a browser shows the page."""
        with contextlib.suppress(KeyboardInterrupt):
            while self._thread.is_alive() and (self.watched or not watched):
                self._thread.join(timeout=0.5)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what the page tells; in the server's threads

    def _stand(self, model: Model, views: Views | None) -> None:
        """Place the first camera, and the training cameras."""
        bounds: Tensor = model.field.bounds
        seen = views is not None and len(views) > 0
        orbit = orbit_of_views(views, bounds) if seen and views is not None else orbit_of_box(bounds)
        self._server.scene.set_up_direction(tuple(float(v) for v in orbit.up))
        camera = self._server.initial_camera
        # Inside the ring of training cameras, which would stand in the way.
        place = orbit.pose(0.0).double().numpy()[:3, 3]
        camera.position = orbit.centre + (0.8 if seen else 1.0) * (place - orbit.centre)
        camera.look_at, camera.up, camera.fov = orbit.centre, orbit.up, math.radians(50.0)
        self._frustums = self._server.scene.add_frame("/cameras", show_axes=False)
        if seen and views is not None:
            add_frustums(self._server, views, model.background, 0.12 * orbit.radius)
        show = self._panel.cameras
        show.visible = seen
        show.on_update(lambda _: setattr(self._frustums, "visible", bool(show.value)))

    def _connected(self, client: Any) -> None:
        screen = _Screen(client)
        with self._news:
            self._screens[client.client_id] = screen
            self._news.notify_all()

        @client.camera.on_update  # type: ignore[untyped-decorator]
        def _(_: Any) -> None:
            screen.moved = time.monotonic()
            self._touch(screen)

        self._touch(screen)

    def _disconnected(self, client: Any) -> None:
        with self._news:
            self._screens.pop(client.client_id, None)

    def _touch(self, *screens: _Screen) -> None:
        """Have screens (none named: all) drawn anew."""
        with self._news:
            for screen in screens or tuple(self._screens.values()):
                screen.wanted += 1
            self._news.notify_all()

    def _wish(self, client: Any) -> None:
        with self._news:
            if client not in self._wishes:
                self._wishes.append(client)
            self._news.notify_all()

    # --- drawing; in the viewer's thread

    def _run(self) -> None:
        while True:
            with self._news:
                screen, pause = self._next()
                while screen is None and not self._wishes and not self._closed:
                    self._news.wait(pause)
                    screen, pause = self._next()
                if self._closed:
                    return
                wish = self._wishes.pop() if self._wishes else None
                wanted = 0 if screen is None else screen.wanted
            try:
                if wish is not None:
                    self._save(wish)
                elif screen is not None:
                    self._draw(screen)
            # Whatever goes wrong here must not end the training beside it; the page says what it was.
            except Exception as error:
                if screen is not None:
                    screen.drawn, screen.sharp = wanted, True
                reason = (str(error).splitlines() or [""])[0]
                self._panel.say(f"**cannot draw:** {type(error).__name__}: {reason}")

    def _next(self) -> tuple[_Screen | None, float | None]:
        """The screen to draw now, else how long to wait for one to come to rest, seconds."""
        screens = list(self._screens.values())
        waiting = [screen for screen in screens if screen.drawn != screen.wanted]
        if waiting:
            # Who has waited longest: one browser in motion must not keep the others still.
            return min(waiting, key=lambda screen: screen.served), None
        now = time.monotonic()
        blurred = [(screen.moved + _REST - now, screen) for screen in screens if not screen.sharp]
        if not blurred:
            return None, None
        pause, screen = min(blurred, key=lambda pair: pair[0])
        return (screen, None) if pause <= 0 else (None, pause)

    def _draw(self, screen: _Screen) -> None:
        wanted, look = screen.wanted, self._panel.look
        screen.served = time.monotonic()
        shape = image_shape(screen.client, look.size)
        if screen.drawn != wanted:
            width = self._pace.moving(shape[1], shape[1] / shape[0])
        else:
            width = self._pace.sharper(screen.width, shape[1])
        camera = camera_of(screen.client, shape, width)
        start = time.monotonic()
        # A first image is always finished: something must be seen during a long movement.
        rendered = self._render(camera, look, None if screen.drawn != wanted else screen, wanted)
        if rendered is None:
            return
        self._pace.saw(camera.lens.height * camera.lens.width, time.monotonic() - start)
        pixels, note = _composed(rendered, look)
        # Where rays are warped, distances are not the world's, and no camera can be hidden by them.
        depth = None if self._preview.warped else z_depth(rendered, camera.lens.intrinsics)
        screen.client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=90, depth=depth)
        screen.drawn, screen.width, screen.sharp = wanted, width, width >= shape[1]
        seconds = time.monotonic() - start
        step = f"step {self._preview.step}, " if self._preview.total_steps else ""
        step += "" if look.step is None else f"masks at step {look.step}, "
        self._panel.say(f"{step}{camera.lens.width}x{camera.lens.height} in {seconds:.2f} s{note}")

    def _render(self, camera: Camera, look: Look, screen: _Screen | None, wanted: int) -> Rendered | None:
        def given_up() -> bool:
            return self._closed or (screen is not None and screen.wanted != wanted)

        return self._preview.at(look.step, look.off).render(camera, chunk=1 << 13, stop=given_up)

    def _save(self, client: Any) -> None:
        """Send the image that a client sees, at full resolution, as a file."""
        look = self._panel.look
        shape = image_shape(client, look.size)
        rendered = self._render(camera_of(client, shape, shape[1]), look, None, 0)
        if rendered is not None:
            file = io.BytesIO()
            Image.fromarray(_composed(rendered, look)[0]).save(file, format="PNG")
            name = f"gridreg_{look.mode}_{time.strftime('%Y%m%d_%H%M%S')}.png"
            client.send_file_download(name, file.getvalue(), save_immediately=True)


class _Screen:
    """State of one browser: it is drawn when ``wanted`` is ahead, and until it is sharp."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.wanted, self.drawn = 1, 0
        self.width, self.sharp = 0, False
        self.moved, self.served = 0.0, 0.0


def _composed(rendered: Rendered, look: Look) -> tuple[ImageArray, str]:
    """Return the image for the page, and a note about it."""
    if look.mode != "depth":
        return to_image(rendered, look.mode), ""
    depths = depth_range([rendered])
    pixels = to_image(rendered, "depth", depths)
    if pixels.shape[1] >= 200 and pixels.shape[0] >= 64:
        pixels[:, -64:] = colour_bar(pixels.shape[0], depths)
    return pixels, f", depth {depths[0]:.3g} to {depths[1]:.3g}"
