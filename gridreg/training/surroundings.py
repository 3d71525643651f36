"""Surroundings of the box in training: when they are wanted, their field, optimizer and state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import gridreg
from gridreg.fields import make_field
from gridreg.rendering import CONTRACTED, Surroundings
from gridreg.scenes import Scene
from gridreg.scenes.focus import surround_focus
from gridreg.training.settings import TrainSettings

# Nodes along an edge at first and in the end. Few, and without dependence on direction: little that a few photographs
# could overfit. A fast rate and much opacity at first, as colours must not come from fog.
_FIRST, _LAST = 16, 128
_FIELD = {
    "density_components": 8,
    "appearance_components": 24,
    "decoder": "rgb",
    "density_shift": None,
    "initial_opacity": 0.99,
}
_SMOOTHNESS, _RATE = 0.01, 0.3


def wants_surroundings(scene: Scene, settings: TrainSettings) -> bool:
    """Whether the background of a scene is to be learned.

    ``train.surroundings`` decides; "auto": where images are opaque, do not stand on one colour, and show what their
    cameras look at from around it. Normalised device coordinates have nothing outside.
    """
    if scene.ndc or settings.surroundings is False:
        return False
    views = scene.train
    return settings.surroundings is True or (
        views.shows_room and surround_focus(views.poses.double().cpu().numpy())
    )


def make_surroundings(box: Tensor, near: float, seed: int = 0, nodes: int = _FIRST) -> Surroundings:
    """An untrained field outside a box ``(2, 3)``, world units, with so many nodes along an edge."""
    generator = torch.Generator().manual_seed(seed)
    return Surroundings(make_field("vm", CONTRACTED, (nodes,) * 3, generator=generator, **_FIELD), box, near)


class SurroundingsTraining:
    """Surroundings with their smoothness and optimizer; they train beside the field, from the same loss.

    Args:
        scene: its box and near.
        settings: learning rates and length of the run.
        seed: of the initial values.
    """

    def __init__(self, scene: Scene, settings: TrainSettings, seed: int) -> None:
        self.settings = settings
        self.model = make_surroundings(scene.bounds.cpu(), scene.near, seed).to(scene.bounds.device)
        self._field: Any = self.model.field
        smooth = [gridreg.TotalVariation(site, weight=_SMOOTHNESS) for site in ("density", "appearance")]
        self.handle = gridreg.apply(self._field, *smooth, total_steps=settings.steps, seed=seed)
        self.optimizer = self._make_optimizer()

    def _make_optimizer(self) -> Any:
        rates = {"grid": _RATE, "network": self.settings.learning_rate_network}
        groups = [{**group, "initial_lr": rates[group["name"]]} for group in self._field.parameter_groups()]
        return self._field.make_optimizer(groups, betas=(0.9, 0.99))

    def _resample(self, nodes: int) -> None:
        with self.handle.suspended():
            self._field.resample((nodes,) * 3)
        self.optimizer = self._make_optimizer()

    def step(self, step: int) -> None:
        """Update from the gradients of iteration ``step``; finer where the field in the box is due to be."""
        self.handle.step(step)
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * self.settings.learning_rate_decay ** (
                step / self.settings.steps
            )
        self.optimizer.step(local_terms=self.handle.grid_terms())
        events = self.settings.resample_at
        if step + 1 in events:
            fraction = sum(event <= step + 1 for event in events) / len(events)
            self._resample(round(_FIRST * (_LAST / _FIRST) ** fraction))

    def state_dict(self) -> dict[str, Any]:
        """The field with its nodes along an edge, and its optimizer."""
        nodes = self._field.resolution[0]
        return {
            "nodes": nodes,
            "field": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self._resample(state["nodes"])
        self.model.load_state_dict(state["field"])
        self.optimizer.load_state_dict(state["optimizer"])
