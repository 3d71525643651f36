"""Models that train beside the field, where they are wanted: surroundings of the box, exposures of photographs."""

from __future__ import annotations

from typing import Any

import torch

from gridreg.rendering import Rendered, Surroundings
from gridreg.scenes import Scene
from gridreg.training.exposure import Exposure, wants_exposure
from gridreg.training.rays import Batch, RayBank
from gridreg.training.settings import TrainSettings
from gridreg.training.surroundings import SurroundingsTraining, wants_surroundings


class Beside:
    """Surroundings and exposures of a run.

    Args:
        scene: its training views, box and near.
        settings: which are wanted, learning rates, length of the run.
        seed: of initial values.

    Attributes:
        surroundings: None: there are none.
        exposure: likewise.
    """

    def __init__(self, scene: Scene, settings: TrainSettings, seed: int) -> None:
        self.surroundings: SurroundingsTraining | None = None
        self.exposure: Exposure | None = None
        if wants_surroundings(scene, settings):
            self.surroundings = SurroundingsTraining(scene, settings, seed)
        if wants_exposure(scene, settings):
            self.exposure = Exposure(len(scene.train), settings.steps, scene.bounds.device)

    @property
    def model(self) -> Surroundings | None:
        """The surroundings, to be rendered."""
        return None if self.surroundings is None else self.surroundings.model

    def note(self, scene: Scene, carves: bool) -> str:
        """A line on what is taken for the background of opaque photographs, or nothing."""
        if self.surroundings is not None:
            return "opaque photographs: what is outside the box is learned, too, instead of a background"
        if scene.train.backdrop is None:
            return ""
        colour = ", ".join(f"{c:.2f}" for c in scene.background.tolist())
        rest = ", and tells their silhouettes" if carves else ", never a random one"
        return f"opaque photographs on one colour ({colour}): it is the background{rest}"

    def finish(self, rendered: Rendered, batch: Batch, bank: RayBank, generator: torch.Generator) -> Rendered:
        """Pixels with what is behind the box, as the photographs show them.

        Args:
            rendered: rays of the batch; with surroundings, on black.
            batch: drawn from the bank last.
            bank: of the training rays.
            generator: for the samples of surroundings.
        """
        count = len(batch.rgba)
        if self.surroundings is not None:
            rays, jitter = batch.rays[:count], batch.jitter[:count]
            rendered = self.surroundings.model.behind(rendered, rays, jitter=jitter, generator=generator)
        if self.exposure is not None:
            rendered = self.exposure.expose(rendered, bank, taken=self.surroundings is not None)
        return rendered

    def step(self, step: int) -> None:
        """Update from the gradients of iteration ``step``."""
        for one in (self.surroundings, self.exposure):
            if one is not None:
                one.step(step)

    def state_dict(self) -> dict[str, Any]:
        """States by name, of what there is."""
        named = {"surroundings": self.surroundings, "exposure": self.exposure}
        return {name: one.state_dict() for name, one in named.items() if one is not None}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state that holds that of `state_dict`; what it lacks a run of before goes on without."""
        if "surroundings" not in state:
            self.surroundings = None
        if "exposure" not in state:
            self.exposure = None
        if self.surroundings is not None:
            self.surroundings.load_state_dict(state["surroundings"])
        if self.exposure is not None:
            self.exposure.load_state_dict(state["exposure"])
