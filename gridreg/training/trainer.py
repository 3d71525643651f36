"""The loop: rays, render, loss, optimizer, events."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

import gridreg
from gridreg.base import Regularizer
from gridreg.errors import InputError
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, Rendered, render_rays
from gridreg.scenes import Scene
from gridreg.training import events
from gridreg.training.averaging import WeightAverage
from gridreg.training.rays import RayBank, warp_of
from gridreg.training.settings import TrainSettings
from gridreg.training.unseen import UnseenPatches

__all__ = ["StepReport", "Trainer"]

# Iterations from one that is averaged to the next: neighbours hardly differ.
_AVERAGED = 5


class StepReport(dict[str, float]):
    """Figures of one iteration: ``loss``, ``mse``, ``psnr`` (dB, of the batch), and one per regularizer."""


class Trainer:
    """Trains a field on a scene, one iteration at a time; all that changes is in `state` and the field.

    Args:
        field: a `gridreg.rendering.Field` module that also offers ``parameter_groups()``. ``resample(resolution)`` and
            ``shrink(bounds)`` are called if it has them.
        scene: training views and box.
        composition: regularizers, attached here with `gridreg.apply`.
        settings: the schedule.
        seed: of rays, jitter, backgrounds and regularizers.
    """

    def __init__(
        self,
        field: Any,
        scene: Scene,
        composition: list[Regularizer],
        settings: TrainSettings,
        *,
        seed: int = 0,
    ) -> None:
        self.field, self.scene, self.settings = field, scene, settings
        self.generator = torch.Generator().manual_seed(seed)
        self.handle = gridreg.apply(field, *composition, total_steps=settings.steps, seed=seed)
        self.warp = warp_of(scene)
        self.bank = RayBank(scene.train, self.warp, reshuffle=settings.reshuffle)
        self.unseen: UnseenPatches | None = None
        if any("patch" in regularizer.needs() for regularizer in composition):
            self.unseen = UnseenPatches(scene.train, settings.patch_size, self.warp)
        self.step = 0
        self.occupancy = OccupancyGrid.full(field.bounds, events.occupancy_resolution(field, settings))
        self._restart_at = 0
        self.average = WeightAverage()
        self.optimizer = self._make_optimizer()
        make = getattr(field, "gradient_context", None)
        self._gradient_context: Callable[[], AbstractContextManager[Any]] = (
            nullcontext if make is None else partial(make, rounding=settings.faint_gradient)
        )
        if self.carves:
            events.carve(self)
        if 0 in settings.filter_rays_at:
            events.filter_rays(self)

    @property
    def carves(self) -> bool:
        """Whether the visual hull counts; cells of normalised device coordinates have no silhouettes."""
        return self.settings.carve and not self.scene.ndc

    @property
    def march(self) -> MarchSettings:
        """How rays are walked at the field's present resolution."""
        return events.march_of(self.field, self.settings, self.scene.near, self.scene.far)

    def _make_optimizer(self) -> torch.optim.Optimizer:
        rates = {"grid": self.settings.learning_rate_grid, "network": self.settings.learning_rate_network}
        groups = [{**group, "lr": rates[group["name"]]} for group in self.field.parameter_groups()]
        groups = self.handle.parameter_groups(groups)
        for group in groups:
            group["initial_lr"] = group["lr"]
        make = getattr(self.field, "make_optimizer", None)
        if make is not None:
            optimizer: torch.optim.Optimizer = make(groups, betas=(0.9, 0.99))
            return optimizer
        return torch.optim.Adam(groups, betas=(0.9, 0.99))

    def _set_learning_rates(self) -> None:
        progress = (self.step - self._restart_at) / self.settings.steps
        factor = self.settings.learning_rate_decay**progress
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * factor
        self.handle.update_groups(self.optimizer.param_groups)

    def restart_optimizer(self) -> None:
        """A fresh optimizer for replaced parameters; the decay starts anew if the settings say so."""
        if self.settings.reset_learning_rate:
            self._restart_at = self.step
        self.average.clear()
        self.optimizer = self._make_optimizer()

    def _average(self) -> None:
        """Take the iterate into the mean where it is due, and let the mean take over at the end."""
        settings = self.settings
        if settings.average_from < 1 and self.step >= settings.average_from * settings.steps:
            if self.step % _AVERAGED == 0:
                self.average.add(self.field.parameters())
            if self.step == settings.steps:
                self.average.copy_to(self.field.parameters())

    def render_batch(self) -> tuple[Rendered, Tensor]:
        """Draw rays, render them, and composite the targets of the first ones on the same background ``(R, 3)``.

        Rays of unseen patches, where a regularizer needs them, come last and have no targets. The samples know the
        opacity of their targets, but for these and for opaque photographs on a backdrop, which tell nothing of it.
        """
        settings = self.settings
        rays, rgba = self.bank.draw(settings.rays, self.generator)
        seen, patch = len(rays), None
        if self.unseen is not None:
            more = self.unseen.draw(settings.patches, self.generator)
            rays = Rays(
                torch.cat([rays.origins, more.origins]), torch.cat([rays.directions, more.directions])
            )
            patch = (settings.patches, settings.patch_size, settings.patch_size)
        jitter = torch.rand(len(rays), generator=self.generator)
        default = self.scene.background.to(rgba)
        background, opacity = None, rgba.new_full((len(rays),), math.nan)
        # Behind opaque photographs on one colour, random ones would be answered with walls of that colour.
        if self.scene.train.backdrop is None:
            background = self.handle.background(len(rays), self.generator, default)
            opacity[:seen] = rgba[:, 3]
        background = (default if background is None else background).expand(len(rays), 3)
        target = rgba[:, :3] * rgba[:, 3:] + (1 - rgba[:, 3:]) * background[:seen]
        march = self.march
        ones = torch.ones_like(jitter)
        rendered = render_rays(
            self.field,
            rays,
            self.occupancy,
            march,
            background=background,
            jitter=jitter,
            near_far=self.handle.near_far(march.near * ones, march.far * ones),
            hook=self.handle,
            generator=self.generator,
        )
        assert rendered.samples is not None
        samples = rendered.samples.replace(target_opacity=opacity, patch=patch)
        return replace(rendered, samples=samples), target

    def train_step(self) -> StepReport:
        """One iteration.

        Raises:
            InputError: if the loss is not finite, with the step; the parameters are those before the step.
        """
        self.handle.step(self.step)
        self._set_learning_rates()
        rendered, target = self.render_batch()
        mse = (rendered.colour[: len(target)] - target).square().mean()
        folded = self.handle.grid_terms() if getattr(self.optimizer, "accepts_local_terms", False) else []
        loss = mse + self.handle.loss(rendered.samples, exclude={term.name for term in folded})
        value = loss.item()
        if not math.isfinite(value):
            raise InputError(
                f"step {self.step}: the loss is {value}; a lower learning rate or penalty weight may help"
            )
        if not getattr(self.optimizer, "zeroes_gradients", False):
            self.optimizer.zero_grad(set_to_none=True)
        if loss.requires_grad:
            with self._gradient_context():
                loss.backward()  # type: ignore[no-untyped-call]
        report = StepReport(loss=value, mse=mse.item(), psnr=-10 * math.log10(max(mse.item(), 1e-12)))
        report.update({name: float(term) for name, term in self.handle.terms.items()})
        if folded:
            values: dict[str, float] = self.optimizer.step(local_terms=folded)  # type: ignore[call-overload]
            report.update(values)
        else:
            self.optimizer.step()
        self.step += 1
        events.run(self)
        self._average()
        return report

    def train(self, until: int | None = None, each: Callable[[StepReport], bool] | None = None) -> None:
        """Iterate until a step (default: the end of the schedule) or until ``each`` returns False."""
        end = self.settings.steps if until is None else until
        while self.step < end:
            report = self.train_step()
            if each is not None and not each(report):
                return

    def state_dict(self) -> dict[str, Any]:
        """All that a later process needs to go on bit for bit: nested dicts of tensors and plain values."""
        return {
            "step": self.step,
            "restart_at": self._restart_at,
            "resolution": list(getattr(self.field, "resolution", ())),
            "field": self.field.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "handle": self.handle.state_dict(),
            "generator": self.generator.get_state(),
            "average": self.average.state_dict(),
            "occupancy": {
                "bounds": self.occupancy.bounds,
                "cells": self.occupancy.cells,
                "hull": self.occupancy.hull,
            },
            "active": self.bank.active,
            "waiting": self.bank.waiting.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.step, self._restart_at = state["step"], state["restart_at"]
        load_field(self.field, state, self.handle)
        self.optimizer = self._make_optimizer()
        self.optimizer.load_state_dict(state["optimizer"])
        self.handle.load_state_dict(state["handle"])
        self.generator.set_state(state["generator"])
        if "average" in state:
            self.average.load_state_dict(state["average"])
        self.occupancy = OccupancyGrid(**state["occupancy"])
        self.bank.active = state["active"]
        self.bank.waiting = state.get("waiting", self.bank.active[:0])


def load_field(field: nn.Module, state: dict[str, Any], handle: Any = None) -> None:
    """Bring a field to the grid sizes and values of a checkpoint's state."""
    if state["resolution"]:
        if handle is None:
            field.resample(tuple(state["resolution"]))  # type: ignore[operator]
        else:
            with handle.suspended():
                field.resample(tuple(state["resolution"]))  # type: ignore[operator]
    field.load_state_dict(state["field"])
