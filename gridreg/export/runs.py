"""Runs and what can be held and shown of them: models, a mesh, a video, and a look while they are under way."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridreg.errors import InputError
from gridreg.export.browser import check_address
from gridreg.export.camera_paths import camera_path
from gridreg.export.mesh_files import write_mesh
from gridreg.export.page import write_page
from gridreg.export.video import render_video
from gridreg.export.viewer import Viewer
from gridreg.export.writers import find_ffmpeg
from gridreg.ops.compilation import clock_stopped
from gridreg.rendering.cameras import Camera
from gridreg.rendering.model import Model
from gridreg.scenes import Views

if TYPE_CHECKING:
    from gridreg.training import Execution, StepReport


def video_path(
    model: Model, views: Views | None = None, path: str | Path | None = None, **options: Any
) -> list[Camera]:
    """Cameras for a video of a model, as `camera_path` gives them.

    Args:
        model: what to video.
        views: the training views.
        path: name or camera file; None: a turntable, or for a forward-facing scene a spiral.
        options: further arguments of `camera_path`.

    Raises:
        InputError: of `camera_path`; for a turntable of a forward-facing scene.
    """
    forward = model.warp is not None
    name = path if path is not None else "spiral" if forward else "turntable"
    if forward and name == "turntable":
        raise InputError(
            "path: found 'turntable', expected spiral or train: a forward-facing scene has no back"
        )
    if forward and views is None and name == "spiral":
        raise InputError("path 'spiral': needs the training cameras of the forward-facing scene")
    return camera_path(name, model.field.bounds, views, **options)


def check_drawing(*, video: bool = True) -> None:
    """Say before a training what `draw_run` would say after it.

    Raises:
        InputError: if a video is wanted and there is no ffmpeg.
    """
    if video:
        try:
            find_ffmpeg()
        except InputError as error:
            raise InputError(f"{error}; or train with --no-video") from None


def draw_run(run: Execution, *, mesh: bool = True, video: bool = True) -> list[Path]:
    """Write ``mesh.ply``, ``turntable.mp4`` (forward-facing: ``spiral.mp4``) and ``index.html`` into the folder of a
    finished run.

    A field without a surface (a very short run) and a forward-facing scene get no mesh; standard error says why.

    Args:
        run: trained to its end.
        mesh: write the mesh.
        video: write the video.

    Returns:
        What was written.

    Raises:
        InputError: without ffmpeg, or if the place is not writable.
    """
    trainer, written = run.trainer, []
    model = trainer.model
    forward = model.warp is not None
    if mesh and forward:
        print("no mesh: the field of a forward-facing scene is not in world coordinates", file=sys.stderr)
    elif mesh:
        try:
            write_mesh(
                trainer.field,
                run.out / "mesh.ply",
                trainer.occupancy,
                world=run.scene.world,
                cameras=run.scene.train.cameras,
            )
            written.append(run.out / "mesh.ply")
        except InputError as error:
            print(f"no mesh: {error}", file=sys.stderr)
    if video:
        target = run.out / ("spiral.mp4" if forward else "turntable.mp4")
        render_video(model, target, video_path(model, run.scene.train, frames=60, width=200))
        written.append(target)
    return [*written, write_page(run.out, run.scene)]


class LiveView:
    """A viewer beside a training: pass it to `gridreg.training.execute` as ``watch``.

    Args:
        host: address to listen on; 127.0.0.1 is reached from this machine alone.
        port: 0: any free one.

    Raises:
        InputError: without viser, if the port is taken, or if the host is none of this machine's.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080) -> None:
        # Before anything is loaded or written.
        check_address(host, port)
        self._host, self._port = host, port
        self._run: Execution | None = None
        self._psnr: list[tuple[float, float]] = []
        self.viewer: Viewer | None = None

    def start(self, run: Execution) -> None:
        """Open the page on the untrained field."""
        self._run = run
        self.viewer = Viewer(
            run.trainer.model,
            run.scene.train,
            host=self._host,
            port=self._port,
            title=f"{run.out.name}, {run.scene.name}, {run.scene.protocol}",
            pausable=True,
        )

    def step(self, report: StepReport) -> None:
        """Show the field as it is now, if somebody looks and the last copy is old; wait while it is paused."""
        if self.viewer is None or self._run is None:
            return
        self._psnr.append((self._run.trainer.step, report["psnr"]))
        if self.viewer.wants_update:
            self._update()
        if self.viewer.paused:
            with clock_stopped():
                while self.viewer.paused and not self._run.stopping():
                    time.sleep(0.1)

    def finish(self) -> None:
        """Show the final field, and stay as long as a browser shows the page."""
        if self.viewer is not None and self.viewer.watched:
            self._update()
            print("done; the page stays until it is closed, or Ctrl-C", file=sys.stderr, flush=True)
            self.viewer.wait(watched=True)

    def close(self) -> None:
        """Take the page away."""
        if self.viewer is not None:
            self.viewer.close()

    def _update(self) -> None:
        if self.viewer is not None and self._run is not None:
            self.viewer.update(self._run.trainer.model)
            self.viewer.curve(*smoothed(self._psnr))


def smoothed(points: Sequence[tuple[float, float]], most: int = 200) -> tuple[list[float], list[float]]:
    """A curve of at most so many points: means of neighbours.

    Example:
        >>> smoothed([(1, 2.0), (2, 4.0), (3, 6.0)], most=2)
        ([1.5, 3.0], [3.0, 6.0])
    """
    width = max(1, -(-len(points) // most))
    groups = [points[i : i + width] for i in range(0, len(points), width)]
    x, y = ([sum(p[axis] for p in group) / len(group) for group in groups] for axis in (0, 1))
    return x, y


@contextmanager
def live_view(wanted: bool, host: str = "127.0.0.1", port: int = 8080) -> Iterator[LiveView | None]:
    """A `LiveView` for the block if it is wanted, else None; at the end of the block the page goes away.

    Raises:
        InputError: as `LiveView`.
    """
    if not wanted:
        yield None
        return
    look = LiveView(host, port)
    try:
        yield look
    finally:
        look.close()
