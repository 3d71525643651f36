"""A field that needs no training: a ball in a box, for questions about size rather than about a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import gridreg
from gridreg.base import Regularizer
from gridreg.fields import make_field
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, Rendered, render_rays

from .situations import cells_of

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
# Density features are this high in the middle and fall like a Gaussian, to 10 at a radius of 0.7.
_HEIGHT, _WIDTH = 1000.0, 0.231


@torch.no_grad()
def ball_field(backbone: str, edge: int, components: tuple[int, int] | None = None) -> Any:
    """A ball of radius 0.7 with random colours.

    A Gaussian is a product of functions of x, y and z, so the first component alone carries it, and masks that close
    others leave the samples as they are. Like a trained surface it is opaque after a few cells.

    Args:
        backbone: ``vm`` or ``cp``.
        edge: nodes along an edge of the grid.
        components: of density and appearance; None: the backbone's own.
    """
    options = {}
    if components is not None:
        options = {"density_components": components[0], "appearance_components": components[1]}
    generator = torch.Generator().manual_seed(0)
    field: Any = make_field(
        backbone,
        BOX,
        (edge,) * 3,
        generator=generator,
        decoder="mlp",
        scale=0.01,
        density_shift=-10.0,
        **options,
    )
    bump = torch.exp(-0.5 * (torch.linspace(-1, 1, edge) / _WIDTH) ** 2)
    if backbone == "cp":
        for line in field.density_lines:
            line[:, 0] = _HEIGHT ** (1 / 3) * bump
        return field
    for plane, line in zip(field.density_planes, field.density_lines, strict=True):
        plane[..., 0] = _HEIGHT / 3 * bump[:, None] * bump
        line[:, 0] = bump
    return field


def ball_rays(count: int) -> Rays:
    """Rays from a sphere of radius 4 towards the ball; most of them meet it."""
    generator = torch.Generator().manual_seed(0)
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    aims = 0.8 * (2 * torch.rand(count, 3, generator=generator) - 1)
    return Rays(origins, torch.nn.functional.normalize(aims - origins, dim=-1))


class BallStep:
    """A training step on the ball: render, squared error, penalties, backward pass, Adam with a learning rate of 0.

    Args:
        field: of `ball_field`.
        rays: of `ball_rays`.
        composition: regularizers to attach; None: the bare field, without a handle.
        at: the iteration of 1000 that schedules read.
        everywhere: march through every cell instead of the occupied ones.
        weight_bound: colour is evaluated where the weight exceeds this; by default as `quick` has it, which gives about
            as many coloured samples as a trained scene has.
    """

    def __init__(
        self,
        field: Any,
        rays: Rays,
        composition: Sequence[Regularizer] | None = None,
        *,
        at: int = 0,
        everywhere: bool = False,
        weight_bound: float = 1e-3,
    ) -> None:
        edge = field.resolution[0]
        self.field, self.rays, self.at = field, rays, at
        # Half a cell, as in the published schedule.
        self.march = MarchSettings(step=1.0 / (edge - 1), weight_bound=weight_bound)
        full = OccupancyGrid.full(BOX, (64, 64, 64))
        self.occupancy = full if everywhere else cells_of(field.density, BOX, self.march.step)
        self.optimizer = field.make_optimizer(
            [{**group, "lr": 0.0} for group in field.parameter_groups()], betas=(0.9, 0.99)
        )
        self.handle = None
        if composition is not None:
            self.handle = gridreg.apply(field, *composition, total_steps=1000)
        generator = torch.Generator().manual_seed(1)
        self.target = torch.rand(len(rays), 3, generator=generator)
        self.jitter = torch.full((len(rays),), 0.5)

    def render(self) -> Rendered:
        return render_rays(
            self.field,
            self.rays,
            self.occupancy,
            self.march,
            background=torch.ones(3),
            jitter=self.jitter,
            hook=self.handle,
        )

    def __call__(self, turn: int = 0) -> None:
        if self.handle is not None:
            self.handle.step(self.at)
        rendered = self.render()
        loss: Tensor = (rendered.colour - self.target).square().mean()
        if self.handle is not None:
            loss = loss + self.handle.loss(rendered.samples)
        with self.field.gradient_context():
            loss.backward()
        self.optimizer.step()

    @torch.no_grad()
    def samples_per_ray(self) -> dict[str, float]:
        """Mean number of samples with a density and with a colour."""
        samples = self.render().samples
        assert samples is not None
        seen = int((samples.weights > self.march.weight_bound).sum())
        return {
            "density_samples_per_ray": samples.t.numel() / len(self.rays),
            "colour_samples_per_ray": seen / len(self.rays),
        }


def ball_step(
    backbone: str, edge: int, rays: int, components: tuple[int, int] | None = None, **options: Any
) -> BallStep:
    """A `BallStep` from plain numbers."""
    return BallStep(ball_field(backbone, edge, components), ball_rays(rays), **options)
