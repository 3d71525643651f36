"""``gridreg page``: one file that shows a run."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from gridreg.cli.arguments import Checkpoint, OptionalFolder


@dataclass
class PageOptions:
    """Make index.html of what lies in a run's folder: one file that works offline and on a telephone.

    The object to turn, photographs at their cameras, test views beside renders, score, curve and video.
    """

    checkpoint: Checkpoint
    """Output folder of a run, or its checkpoint."""
    scene: OptionalFolder = None
    """Where the scene lies now, for its photographs; default: where the run found it."""


def run(options: PageOptions) -> int:
    """Write the page and say where.

    Raises:
        InputError: for a missing or damaged checkpoint, another scene, or a place that is not writable.
    """
    from gridreg.cli.runs import folder_of, views_scene
    from gridreg.export import write_page
    from gridreg.training import load_run

    loaded = load_run(options.checkpoint)
    scene = views_scene(loaded, options.checkpoint, options.scene)
    if scene is None:
        print(f"{loaded.config.scene}: not there any more, so no photographs", file=sys.stderr)
    path = write_page(folder_of(options.checkpoint), scene, model=loaded)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0
