"""Looking at a field in a browser, also while it is being trained (viser)."""

from __future__ import annotations

import contextlib
import io
import math
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from gridreg.export import browser
from gridreg.export._admission import Admission
from gridreg.export.browser import quiet_console, start_server
from gridreg.export.cameras import orbit_of_box, orbit_of_views
from gridreg.export.images import z_depth
from gridreg.export.preview import Preview
from gridreg.export.training_cameras import TrainingCameras
from gridreg.export.viewer_crop import CropControls
from gridreg.export.viewer_panel import Look, Panel
from gridreg.export.viewer_screen import Pace, Screen, composed
from gridreg.rendering import Rendered
from gridreg.rendering.cameras import Camera
from gridreg.rendering.model import Model
from gridreg.scenes import Views, World

# Seconds without movement after which the image is sharpened.
_REST = 0.25
# Of the window's height, or of its width if that is less.
_ANGLE = math.radians(50.0)


class Viewer:
    """A page with the field in it: orbit camera, training cameras, colour, depth, opacity, masks at any step, curves.

    A thread of its own draws a private copy of the model (`Preview`), so nothing that is set in the page changes the
    field. A trainer gives new copies between two iterations, when one is wanted (``viewer.update(trainer.model)``).
    Nothing is copied or drawn while no browser looks.

    Args:
        model: what to show first.
        views: training views, drawn as cameras with their images; they also say where up is.
        host: address to listen on; 127.0.0.1 is reached from this machine alone.
        port: 0: any free one.
        size: longer edge of the image at rest, pixels; can be changed in the page.
        refresh: least time between two copies of a field in training, seconds.
        quiet: do not say on standard error where the page is.
        title: of the page.
        pausable: whether the page has a button that sets `paused`.

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
        title: str = "gridreg",
        pausable: bool = False,
    ) -> None:
        self._preview = Preview(model)
        self._admission = Admission(host, title)
        self._server = start_server(host, port, self._admission)
        self.host, self.port = host, int(self._server.get_port())
        self._refresh, self._updated = refresh, time.monotonic()
        self._news = threading.Condition()
        self._screens: dict[int, Screen] = {}
        self._wishes: list[tuple[Callable[[Any], None], Any]] = []
        self._closed = False
        self._pace = Pace()
        self._crop: CropControls | None = None
        act = (self._touch, partial(self._ask, self._save))
        self._panel = Panel(self._server, self._preview, *act, size, pausable=pausable)
        self.curve = self._panel.curve
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

    @property
    def paused(self) -> bool:
        """True while somebody who looks wants the training to wait; with nobody looking it goes on."""
        return self._panel.paused and self.watched

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
        """Add controls for a box that cuts what is seen, saved to a file that ``gridreg mesh --crop`` takes."""
        self._crop = CropControls(self._server, bounds, world, path, self._touch)
        return self._crop

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
        orbit = orbit_of_views(views, bounds) if views is not None and seen else orbit_of_box(bounds)
        # Inside the ring of training cameras, which would stand in the way.
        browser.place_camera(self._server, orbit, 0.8 if seen else 1.0, _ANGLE)
        visited, depth = partial(self._ask, self._compare), 0.12 * orbit.radius
        self._cameras = TrainingCameras(self._server, views, model.background, depth, visited)
        self._panel.cameras.visible = seen
        self._panel.cameras.on_update(lambda event: self._cameras.show(bool(event.target.value)))

    def _connected(self, client: Any) -> None:
        screen = Screen(client)
        with self._news:
            self._screens[client.client_id] = screen
            self._news.notify_all()

        @client.camera.on_update  # type: ignore[untyped-decorator]
        def _(_: Any) -> None:
            screen.moved = time.monotonic()
            if not screen.placed:
                screen.placed = True
                browser.fit_upright(client, _ANGLE)
            self._cameras.come_back(client.camera.position)
            self._touch(screen)

        self._touch(screen)

    def _disconnected(self, client: Any) -> None:
        with self._news:
            self._screens.pop(client.client_id, None)

    def _touch(self, *screens: Screen) -> None:
        """Have screens (none named: all) drawn anew."""
        with self._news:
            for screen in screens or tuple(self._screens.values()):
                screen.wanted += 1
            self._news.notify_all()

    def _ask(self, action: Callable[[Any], None], of: Any) -> None:
        with self._news:
            if (action, of) not in self._wishes:
                self._wishes.append((action, of))
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
                    wish[0](wish[1])
                elif screen is not None:
                    self._draw(screen)
            # Whatever goes wrong here must not end the training beside it; the page says what it was.
            except Exception as error:
                if screen is not None:
                    screen.drawn, screen.sharp = wanted, True
                reason = (str(error).splitlines() or [""])[0]
                self._panel.say(f"**cannot draw:** {type(error).__name__}: {reason}")

    def _next(self) -> tuple[Screen | None, float | None]:
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

    def _draw(self, screen: Screen) -> None:
        wanted, look = screen.wanted, self._panel.look
        screen.served = time.monotonic()
        shape = browser.image_shape(screen.client, look.size)
        pace, first = self._pace, screen.drawn != wanted
        width = pace.moving(shape[1], shape[1] / shape[0]) if first else pace.sharper(screen.width, shape[1])
        camera = browser.camera_of(screen.client, shape, width)
        start = time.monotonic()
        # A first image is always finished: something must be seen during a long movement.
        rendered = self._render(camera, look, None if first else screen, wanted)
        # Nor to a browser that went away meanwhile: viser would warn of it in the terminal.
        if rendered is None or screen.client.client_id not in self._screens:
            return
        self._pace.saw(camera.lens.height * camera.lens.width, time.monotonic() - start)
        pixels, note = composed(rendered, look)
        # Where rays are warped, distances are not the world's, and no camera can be hidden by them.
        depth = None if self._preview.warped else z_depth(rendered, camera.lens.intrinsics)
        screen.client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=90, depth=depth)
        screen.drawn, screen.width, screen.sharp = wanted, width, width >= shape[1]
        seconds = time.monotonic() - start
        step = f"step {self._preview.step}, " if self._preview.total_steps else ""
        step += "" if look.step is None else f"masks at step {look.step}, "
        self._panel.say(f"{step}{camera.lens.width}x{camera.lens.height} in {seconds:.2f} s{note}")

    def _render(self, camera: Camera, look: Look, screen: Screen | None, wanted: int) -> Rendered | None:
        def given_up() -> bool:
            return self._closed or (screen is not None and screen.wanted != wanted)

        crop = None if self._crop is None else self._crop.inner
        model = self._preview.at(look.step, look.off, crop)
        return model.render(camera, stop=given_up, deviation=look.mode == "deviation")

    def _compare(self, number: int) -> None:
        """Show the render of a training view beside its photograph."""
        look = self._panel.look
        found = self._cameras.comparison(self._preview.at(look.step, look.off), number, lambda: self._closed)
        if found is not None:
            self._panel.compare(*found)

    def _save(self, client: Any) -> None:
        """Send the image that a client sees, at full resolution, as a file."""
        look = self._panel.look
        shape = browser.image_shape(client, look.size)
        rendered = self._render(browser.camera_of(client, shape, shape[1]), look, None, 0)
        if rendered is not None:
            file = io.BytesIO()
            Image.fromarray(composed(rendered, look)[0]).save(file, format="PNG")
            name = f"gridreg_{look.mode}_{time.strftime('%Y%m%d_%H%M%S')}.png"
            client.send_file_download(name, file.getvalue(), save_immediately=True)
