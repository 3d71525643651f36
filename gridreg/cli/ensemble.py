"""``gridreg ensemble``: one run of several."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["EnsembleOptions", "run"]


@dataclass
class EnsembleOptions:
    """Join runs of one scene, such as several seeds, into the mean of their fields.

    What the runs agree on stays, what one of them invented fades. The folder holds all it takes; `eval`, `view`,
    `render` and `mesh` read it like a run.
    """

    runs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RUN RUN [RUN ...]", help_behavior_hint=""),
    ]
    """Output folders of runs, or their checkpoints, trained on the same images."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the ensemble; one that holds a run is refused."""


def run(options: EnsembleOptions) -> int:
    """Write the checkpoint and say what is in it.

    Raises:
        InputError: for fewer than two runs, runs of different scenes, missing or damaged checkpoints, a folder that
            holds a run, or a place that is not writable.
    """
    from gridreg.training import save_ensemble

    members = save_ensemble(options.runs, options.out)
    print(f"{options.out}: the mean of {members} fields; its score: gridreg eval {options.out}")
    return 0
