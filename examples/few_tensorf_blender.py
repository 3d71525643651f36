"""Few TensoRF on a few photographs: TensoRF, masks that open, an occlusion loss. All of it is in this file.

python examples/few_tensorf_blender.py                  the built-in scene, as `gridreg train` does it
python examples/few_tensorf_blender.py --scene DIR --protocol dietnerf8 --preset few_tensorf --out DIR
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch
import tyro

import gridreg
from backbones.vm import VMField
from gridreg.cli import run_cli
from gridreg.cli.train import run
from gridreg.fields import make_field, register_field
from gridreg.scenes import Scene
from gridreg.training import RunConfig, Trainer, TrainOptions, load_preset
from gridreg.training.events import carved_box, resolution_of
from gridreg.training.run import check_size, regularizers_of
from gridreg.training.trainer import StepReport

# What is attached to the field, from the outside: the field knows nothing of it.
FEW_TENSORF = [
    # Masks (FreeNeRF): channels of the grids open from low to high within the first fifth of the run.
    gridreg.FrequencyMask("density", until=0.2),
    gridreg.FrequencyMask("appearance", until=0.2),
    # Occlusion loss (FreeNeRF): density at the first ten samples of a ray, right before the camera, is penalised.
    gridreg.OcclusionLoss(weight=1e-3, samples=10),
    # Grids are smooth, and empty where nothing is seen.
    gridreg.TotalVariation("density", weight=0.003),
    gridreg.TotalVariation("appearance", weight=0.003),
    gridreg.L1("density", weight=8e-5),
    # What is transparent in a photograph has no colour that the field could paint as matter.
    gridreg.RandomBackground(),
]
"""Few TensoRF in minutes, the composition of the preset `quick`. Other presets bring their own."""


class FewTensoRF(Trainer):
    """The loop: rays through random pixels are rendered, compared, and what differs goes back into the grids."""

    def train(self, until: int | None = None, each: Callable[[StepReport], bool] | None = None) -> None:
        """Iterate until a step (default: the end of the schedule) or until ``each`` returns False."""
        while self.step < (self.settings.steps if until is None else until):
            self.handle.step(self.step)  # here the masks open
            self.set_learning_rates()

            # Volume rendering of some rays, on the background that RandomBackground drew for each of them.
            rendered, target = self.render_batch()
            mse = (rendered.colour[: len(target)] - target).square().mean()

            # Penalties on grids go to the optimizer where it has a closed form for them; the others read the samples.
            terms = self.local_terms()
            loss = mse + self.handle.loss(rendered.samples, exclude={term.name for term in terms})

            report = self.descend(loss, mse, terms)  # gradients, and a step of Adam
            self.advance()  # finer grids, empty cells, ... where the schedule has them
            if each is not None and not each(report):
                return


# `--backbone vm`: density and colour are sums of planes times lines (TensoRF, Chen et al. 2022).
register_field("vm", VMField)


def few_tensorf(config: RunConfig, scene: Scene) -> FewTensoRF:
    """The field in its box, with everything attached, at step 0."""
    check_size(config)
    settings = config.train
    # The box around the visual hull: what lies outside it is background in some photograph.
    bounds = carved_box(scene) if settings.carve and not scene.ndc else scene.bounds
    resolution = resolution_of(settings.voxels_start, bounds)
    generator = torch.Generator().manual_seed(config.seed)
    field = make_field(config.backbone, bounds, resolution, generator=generator, **config.field)
    own = config.composition == load_preset("quick").composition
    # The trainer calls gridreg.apply(field, *regularizers, total_steps=settings.steps).
    return FewTensoRF(
        field, scene, FEW_TENSORF if own else regularizers_of(config), settings, seed=config.seed
    )


if __name__ == "__main__":
    # What comes before and after is that of every run: options, scene; scores, renders, checkpoint, mesh, video.
    sys.exit(run_cli(lambda: run(tyro.cli(TrainOptions), few_tensorf, sys.argv)))
