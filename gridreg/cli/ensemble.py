"""``gridreg ensemble``: one run of several."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gridreg.cli.arguments import OptionalFolder


@dataclass
class EnsembleOptions:
    """Join runs of one scene, such as several seeds, into the mean of their fields.

    What the runs agree on stays, what one of them invented fades. The folder holds all it takes; `eval`, `view`,
    `render` and `mesh` read it like a run. Where runs differ is not to be trusted: `render --modes deviation`, `view`
    and `page` show it, and next.json is the camera to photograph from next.
    """

    runs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RUN RUN [RUN ...]", help_behavior_hint=""),
    ]
    """Output folders of runs, or their checkpoints, trained on the same images."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the ensemble; one that holds a run is refused."""
    scene: OptionalFolder = None
    """Where the scene lies now, for its cameras; default: where the first run found it."""


def run(options: EnsembleOptions) -> int:
    """Write the checkpoint and say what is in it.

    Raises:
        InputError: for fewer than two runs, runs of different scenes, missing or damaged checkpoints, a folder that
            holds a run, another scene, or a place that is not writable.
    """
    from gridreg.cli.runs import views_scene
    from gridreg.export import next_view, save_cameras
    from gridreg.training import load_run, save_ensemble

    members = save_ensemble(options.runs, options.out)
    print(f"{options.out}: the mean of {members} fields; its score: gridreg eval {options.out}")
    joined = load_run(options.out)
    scene = None if joined.warp is not None else views_scene(joined, options.out, options.scene)
    if scene is not None:
        found = next_view(joined, scene.train)
        save_cameras(options.out / "next.json", [found.camera], joined.world, about=str(found))
        print(f"{found}; that camera: {options.out / 'next.json'}")
    return 0
