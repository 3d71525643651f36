"""``gridreg compare-mesh``: how far a mesh is from the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gridreg.cli.arguments import OptionalFile, OptionalFloat


@dataclass
class CompareMeshOptions:
    """Measure a mesh against the true one: Chamfer distance, F-score, normal consistency."""

    mesh: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MESH")]
    """The mesh to judge (.ply, .obj, .glb, ...)."""
    truth: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TRUTH")]
    """The true mesh in the same coordinates, or the word `builtin` for the built-in scene's exact geometry."""
    threshold: OptionalFloat = None
    """Distance that counts as met in the F-score, world units; default: 1 % of the diagonal of the truth's box."""
    samples: int = 50_000
    """Points drawn from each surface."""
    out: OptionalFile = None
    """JSON file for the figures."""


def run(options: CompareMeshOptions) -> int:
    """Print the figures.

    Raises:
        InputError: for files that are no meshes, numbers out of range, or a place that is not writable.
    """
    from gridreg.export import Mesh, compare_meshes, read_mesh
    from gridreg.training.files import write_json

    mesh = read_mesh(options.mesh)
    if options.truth == "builtin":
        from gridreg.scenes import builtin_mesh

        truth = Mesh(*builtin_mesh())
    else:
        truth = read_mesh(options.truth)
    comparison = compare_meshes(mesh, truth, threshold=options.threshold, samples=options.samples)
    print(comparison)
    if options.out is not None:
        write_json(options.out, comparison.to_dict())
    return 0
