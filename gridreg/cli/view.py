"""``gridreg view``: a checkpoint in the browser."""

from __future__ import annotations

import contextlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gridreg.cli.arguments import Checkpoint, OptionalFolder
from gridreg.errors import InputError
from gridreg.machine import DeviceName, choose_device

if TYPE_CHECKING:
    from gridreg.training import LoadedRun


@dataclass
class ViewOptions:
    """Look at a checkpoint in the browser, with its masks at any step (extra `viewer`); Ctrl-C ends it."""

    checkpoint: Checkpoint
    """Output folder of a run, or its checkpoint."""
    scene: OptionalFolder = None
    """Where the scene lies now, for its training cameras; default: where the run found it."""
    host: str = "127.0.0.1"
    """Address to listen on; the default is reached from this machine only, 0.0.0.0 from the network with a token."""
    port: int = 8080
    """Port to listen on; 0: any free one."""
    size: int = 512
    """Longer edge of the image at rest, pixels."""
    device: DeviceName = "cpu"
    """Where to compute; auto: a GPU where there is one."""


def run(options: ViewOptions) -> int:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: for a missing or damaged checkpoint, without viser, or if the port is taken.
    """
    from gridreg.cli.runs import folder_of, views_scene
    from gridreg.export import Viewer
    from gridreg.export.browser import check_address
    from gridreg.export.runs import smoothed
    from gridreg.training import load_run

    check_address(options.host, options.port)
    loaded = load_run(options.checkpoint, choose_device(options.device))
    scene = views_scene(loaded, options.checkpoint, options.scene)
    if scene is None:
        print(f"{loaded.config.scene}: not there any more, so no training cameras", file=sys.stderr)
    views = None if scene is None else scene.train
    title, curve = described(loaded, folder_of(options.checkpoint))
    with Viewer(
        loaded, views, host=options.host, port=options.port, size=options.size, title=title
    ) as viewer:
        if loaded.warp is None:
            viewer.offer_crop(folder_of(options.checkpoint) / "crop.json", loaded.field.bounds, loaded.world)
        viewer.curve(*smoothed(curve))
        viewer.wait()
    return 0


def described(run: LoadedRun, folder: Path) -> tuple[str, list[tuple[float, float]]]:
    """The title of a run's page (its name, score and scene), and its PSNR by iteration, as far as its files tell.

    Args:
        run: the checkpoint.
        folder: that it lies in; files there that are damaged tell nothing.
    """
    from gridreg.training.curves import History

    parts: list[str] = [folder.resolve().name]
    curve: list[tuple[float, float]] = []
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        parts.append(f"{float(metrics['mean']['psnr']):.2f} dB")
    parts.append("built-in scene" if run.config.scene is None else Path(run.config.scene).name)
    with contextlib.suppress(InputError):
        rows = History.load(folder / "history.jsonl").rows
        curve = [(float(row["step"]), float(row["psnr"])) for row in rows if "psnr" in row]
    return ", ".join(parts), curve
