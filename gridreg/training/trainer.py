"""The loop: rays, render, loss, optimizer, events."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

import gridreg
from gridreg.base import LocalTerm, Regularizer
from gridreg.errors import InputError
from gridreg.rendering import MarchSettings, Model, OccupancyGrid, Rays, Rendered, render_rays
from gridreg.scenes import Scene
from gridreg.training.averaging import WeightAverage
from gridreg.training.beside import Beside
from gridreg.training.events import OccupiedSpace
from gridreg.training.rays import Batch, RayBank, behind, known_alpha, warp_of
from gridreg.training.settings import TrainSettings
from gridreg.training.unseen import UnseenPatches

# Iterations from one that is averaged to the next: neighbours hardly differ.
_AVERAGED = 5


class StepReport(dict[str, float]):
    """Figures of one iteration: ``loss``, ``mse``, ``psnr`` (dB, of the batch), and one per regularizer."""


class Trainer:
    """Trains a field on a scene, one iteration at a time; all that changes is in `state` and the field.

    Args:
        field: a `gridreg.rendering.Field` module that also offers ``parameter_groups()``. ``resample(resolution)`` and
            ``shrink(bounds)`` are called if it has them.
        scene: training views and box; where its tensors are, the field is moved to.
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
        self.field, self.scene, self.settings = field.to(scene.bounds.device), scene, settings
        self.generator = torch.Generator().manual_seed(seed)
        self.handle = gridreg.apply(field, *composition, total_steps=settings.steps, seed=seed)
        self.warp = warp_of(scene)
        self.bank = RayBank(
            scene.train, self.warp, reshuffle=settings.reshuffle, alpha=known_alpha(scene, settings.carve)
        )
        self.unseen: UnseenPatches | None = None
        if any("patch" in regularizer.needs() for regularizer in composition):
            self.unseen = UnseenPatches(scene.train, settings.patch_size, self.warp)
        self.step = 0
        self.space = OccupiedSpace(field, scene, settings, self.bank, self.handle.suspended)
        self._restart_at = 0
        self.average = WeightAverage()
        self.beside = Beside(scene, settings, seed)
        self.optimizer = self._make_optimizer()
        make = getattr(field, "gradient_context", None)
        self._gradient_context: Callable[[], AbstractContextManager[Any]] = (
            nullcontext if make is None else partial(make, rounding=settings.stochastic_rounding)
        )

    @property
    def occupancy(self) -> OccupancyGrid:
        """Cells that may hold something."""
        return self.space.occupancy

    @property
    def march(self) -> MarchSettings:
        """Settings of the march at the field's present resolution."""
        return self.space.march

    @property
    def model(self) -> Model:
        """The field with all it takes to render it; nothing is copied, so it follows the training."""
        background, warp = self.scene.background, self.warp
        return Model(self.field, self.occupancy, self.march, background, self.handle, warp, self.beside.model)

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

    def set_learning_rates(self) -> None:
        """Give the optimizer the rates of this step."""
        progress = (self.step - self._restart_at) / self.settings.steps
        factor = self.settings.learning_rate_decay**progress
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * factor
        self.handle.update_groups(self.optimizer.param_groups)

    def restart_optimizer(self) -> None:
        """Make a fresh optimizer for replaced parameters; the decay starts anew if the settings say so."""
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

    def draw_batch(self) -> Batch:
        """Draw random training rays and, where a regularizer needs them, rays of unseen patches behind these."""
        settings = self.settings
        rays, rgba = self.bank.draw(settings.rays, self.generator)
        patch = None
        if self.unseen is not None:
            more = self.unseen.draw(settings.patches, self.generator)
            rays = Rays(
                torch.cat([rays.origins, more.origins]), torch.cat([rays.directions, more.directions])
            )
            patch = (settings.patches, settings.patch_size, settings.patch_size)
        jitter = torch.rand(len(rays), generator=self.generator).to(rays.origins.device)
        return Batch(rays, rgba, jitter, patch)

    def render_batch(self) -> tuple[Rendered, Tensor]:
        """Draw rays, render them, and composite the targets of the first ones on the same background ``(S, 3)``."""
        batch, march = self.draw_batch(), self.march
        background, opacity = behind(
            batch, self.scene, self.handle, self.generator, black=self.beside.surroundings is not None
        )
        ones = torch.ones_like(batch.jitter)
        rendered = render_rays(
            self.field,
            batch.rays,
            self.occupancy,
            march,
            background=background,
            jitter=batch.jitter,
            near_far=self.handle.near_far(march.near * ones, march.far * ones),
            hook=self.handle,
            generator=self.generator,
            target_opacity=opacity,
            patch=batch.patch,
        )
        rendered = self.beside.finish(rendered, batch, self.bank, self.generator)
        rgb, alpha = batch.rgba[:, :3], batch.rgba[:, 3:]
        if self.scene.train.backdrop is not None:
            alpha = alpha.nan_to_num(1.0)
        return rendered, rgb * alpha + (1 - alpha) * background[: len(rgb)]

    def train_step(self) -> StepReport:
        """One iteration.

        Raises:
            InputError: if the loss is not finite, with the step; the parameters are those before the step.
        """
        self.handle.step(self.step)
        self.set_learning_rates()
        rendered, target = self.render_batch()
        mse = (rendered.colour[: len(target)] - target).square().mean()
        terms = self.local_terms()
        loss = mse + self.handle.loss(rendered.samples, exclude={term.name for term in terms})
        report = self.descend(loss, mse, terms)
        self.advance()
        return report

    def local_terms(self) -> list[LocalTerm]:
        """Grid penalties that the optimizer takes over, if it can: they need not be in the loss."""
        return self.handle.grid_terms() if getattr(self.optimizer, "accepts_local_terms", False) else []

    def descend(self, loss: Tensor, mse: Tensor, terms: Sequence[LocalTerm] = ()) -> StepReport:
        """Gradients and one step of the optimizer.

        Args:
            loss: what is descended.
            mse: the part of it that is the error of the batch, for the report.
            terms: of `local_terms`.

        Raises:
            InputError: if the loss is not finite, with the step; the parameters stay.
        """
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
        if terms:
            values: dict[str, float] = self.optimizer.step(local_terms=terms)  # type: ignore[call-overload]
            report.update(values)
        else:
            self.optimizer.step()
        self.beside.step(self.step)
        return report

    def advance(self) -> None:
        """Count the step, and carry out what the schedule has after it: resampling, shrinking, occupancy, averaging."""
        self.step += 1
        if self.space.run(self.step):
            self.restart_optimizer()
        self._average()

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
            **self.beside.state_dict(),
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
            self.average.load_state_dict(state["average"], self.bank.pixels.device)
        device = self.bank.pixels.device
        self.space.occupancy = OccupancyGrid.restored(state["occupancy"]).to(device)
        self.bank.active = state["active"].to(device)
        self.bank.waiting = state.get("waiting", state["active"][:0]).to(device)
        self.beside.load_state_dict(state)


def load_field(field: nn.Module, state: dict[str, Any], handle: gridreg.Handle | None = None) -> None:
    """Bring a field to the grid sizes and values of a checkpoint's state, past what ``handle`` has attached to it.

    Raises:
        InputError: for grids larger than any tensor of the state, or values that are not finite.
    """
    longest = max((max(value.shape, default=1) for value in state["field"].values()), default=1)
    if state["resolution"]:
        if not all(0 < edge <= longest for edge in state["resolution"]):
            raise InputError(
                f"checkpoint: found a grid of {state['resolution']}, expected what its tensors hold"
            )
        with nullcontext() if handle is None else handle.suspended():
            field.resample(tuple(state["resolution"]))  # type: ignore[operator]
    for name, value in state["field"].items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"checkpoint: {name} is not finite; expected numbers")
    field.load_state_dict(state["field"])
