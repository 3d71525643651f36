"""Samples in, colours out: emission-absorption volume rendering of any field (Max 1995; NeRF equation 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from gridreg import ops
from gridreg.rendering.occupancy import OccupancyGrid
from gridreg.rendering.rays import Rays, box_intersection
from gridreg.samples import RaySamples

_BLOCK = 1 << 13


class Field(Protocol):
    """The methods that the renderer asks of a field.

    It may also offer ``march_density(rays, t_min, t_max, step, occupancy, jitter, transmittance_bound)``, which returns
    a `gridreg.ops.RayMarchResult` (or a plain tuple of its first five or more); ``colour_of_rays(x, directions,
    ray_indices)``, which takes directions ``(R, 3)`` by ray; ``colour_of_features(features, directions, ray_indices)``
    for the features that its march returned; and ``colour_of_means(x, directions, ray_indices, fractions, offsets)``,
    one colour for positions ``offsets[p] : offsets[p + 1]``, whose features it averages by their fractions.
    """

    bounds: Tensor

    def density(self, x: Tensor, /) -> Tensor:
        """Positions ``(N, 3)`` to densities ``(N,)`` per world unit."""
        ...

    def colour(self, x: Tensor, d: Tensor, /) -> Tensor:
        """Positions and directions ``(N, 3)`` to colours ``(N, 3)`` in [0, 1]."""
        ...


class SampleHook(Protocol):
    """An object that may change samples between the field and the compositing: a `gridreg.Handle`."""

    def on_samples(self, samples: RaySamples, /) -> RaySamples:
        """The samples, perhaps with scaled gradients."""
        ...


@dataclass(frozen=True)
class MarchSettings:
    """Settings of ray marching.

    Args:
        step: distance between samples, world units.
        near, far: the part of each ray that counts, world units.
        transmittance_bound: samples behind this transmittance are dropped, unitless; the colour of a pixel
            changes by at most this much. 0 keeps them all.
        weight_bound: colour is evaluated only where the weight exceeds this (TensoRF uses 1e-4).
        merge_weight: low-weight samples, lighter than this, are merged with their neighbours on the ray and have the
            colour of one of them, see `gridreg.ops.merging`. 0: every sample has its own.
        feature_weight: neighbours on the ray have one colour, that of their mean features, until they weigh this much;
            for a field that offers ``colour_of_means``. 0: every one of them has its own.
    """

    step: float
    near: float = 0.0
    far: float = 1e10
    transmittance_bound: float = 1e-4
    weight_bound: float = 1e-4
    merge_weight: float = 0.0
    feature_weight: float = 0.0


@dataclass(frozen=True)
class Rendered:
    """Pixels of ``R`` rays.

    Args:
        colour: ``(R, 3)`` on the background.
        opacity: ``(R,)`` in [0, 1].
        depth: ``(R,)`` weighted mean distance times opacity, world units (0 where nothing was hit).
        samples: the samples behind them; None for whole images.
        coloured: ``(M,)`` int64, those of them whose colour was computed; None where that is not known.
        deviation: ``(R,)`` how far the members of an ensemble are apart; None where that was not asked for.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    samples: RaySamples | None = None
    coloured: Tensor | None = None
    deviation: Tensor | None = None


def _march(
    field: Any,
    rays: Rays,
    t_range: tuple[Tensor, Tensor],
    occupancy: OccupancyGrid,
    march: MarchSettings,
    jitter: Tensor,
) -> ops.RayMarchResult:
    """The samples that are not hidden."""
    t_min, t_max = t_range
    if getattr(field, "march_density", None) is not None:
        return ops.RayMarchResult(
            *field.march_density(rays, t_min, t_max, march.step, occupancy, jitter, march.transmittance_bound)
        )
    arguments = ops.MarchArguments(
        rays.origins, rays.directions, t_min, t_max, march.step, occupancy.cells, occupancy.bounds, jitter
    )
    return ops.march_density(arguments, field.density, march.transmittance_bound)


def _colours(
    field: Any, marched: ops.RayMarchResult, chosen: Tensor, rays: Rays, ray_indices: Tensor
) -> Tensor:
    """Colours of some of the samples; without gradients in blocks, which bounds the memory of an image's fog."""
    if not torch.is_grad_enabled() and len(chosen) > _BLOCK:
        parts = zip(torch.split(chosen, _BLOCK), torch.split(ray_indices, _BLOCK), strict=True)
        return torch.cat([_colours(field, marched, some, rays, of) for some, of in parts])
    if marched.features is not None:
        of_features = field.colour_of_features(
            marched.features.index_select(0, chosen), rays.directions, ray_indices
        )
        return of_features  # type: ignore[no-any-return]
    positions = marched.positions[chosen]
    by_ray = getattr(field, "colour_of_rays", None)
    if by_ray is not None:
        colours: Tensor = by_ray(positions, rays.directions, ray_indices)
        return colours
    return field.colour(positions, rays.directions[ray_indices])  # type: ignore[no-any-return]


def _mean_colours(
    field: Any,
    marched: ops.RayMarchResult,
    chosen: Tensor,
    rays: Rays,
    of_rays: Tensor,
    means: ops.FeatureMeans,
) -> Tensor:
    """Colours of runs of samples, from their mean features; without gradients in blocks, as `_colours`."""
    count = len(means.offsets) - 1
    if not torch.is_grad_enabled() and len(chosen) > _BLOCK and count > 1:
        middle = int(means.offsets[count // 2])
        halves = (
            (slice(0, middle), means.offsets[: count // 2 + 1]),
            (slice(middle, None), means.offsets[count // 2 :] - middle),
        )
        return torch.cat(
            [
                _mean_colours(
                    field,
                    marched,
                    chosen[half],
                    rays,
                    of_rays[half],
                    means._replace(fractions=means.fractions[half], offsets=offsets),
                )
                for half, offsets in halves
            ]
        )
    found: Tensor = field.colour_of_means(
        marched.positions[chosen],
        rays.directions,
        of_rays[means.offsets[:-1]],
        means.fractions,
        means.offsets,
    )
    return found


def render_rays(
    field: Any,
    rays: Rays,
    occupancy: OccupancyGrid,
    march: MarchSettings,
    *,
    background: Tensor,
    jitter: Tensor | None = None,
    near_far: tuple[Tensor, Tensor] | None = None,
    hook: SampleHook | None = None,
    generator: torch.Generator | None = None,
    target_opacity: Tensor | None = None,
    patch: tuple[int, int, int] | None = None,
) -> Rendered:
    """Render a batch of rays, differentiably in the field's parameters.

    Args:
        field: a `Field`.
        rays: ``R`` rays.
        occupancy: cells that may hold something; samples elsewhere are skipped.
        march: step and bounds.
        background: colour behind the field, ``(3,)`` or ``(R, 3)``.
        jitter: ``(R,)`` in [0, 1), the fraction of a step by which each ray's samples are shifted; None: 0.5.
        near_far: ``(R,)`` each, instead of the march's near and far.
        hook: gets the samples before they are composited.
        generator: for training: draws the representatives of merged samples (the march's ``merge_weight``); None: the
            samples at half of their weight.
        target_opacity, patch: of the rays, for the samples, see `gridreg.RaySamples`.
    """
    if jitter is None:
        jitter = torch.full((len(rays),), 0.5, dtype=rays.origins.dtype, device=rays.origins.device)
    near, far = (march.near, march.far) if near_far is None else near_far
    t_min, t_max = box_intersection(rays, field.bounds, near, far)
    marched = _march(field, rays, (t_min, t_max), occupancy, march, jitter)
    delta, ray_steps = marched.delta, marched.ray_steps
    if delta is None:
        delta = torch.full_like(marched.t, march.step)
        ray_steps = ((t_max - t_min) / march.step - jitter).ceil().clamp(min=0).long()
    weights = ops.composite_weights(marched.density * delta, marched.offsets)
    coloured, of_rays, groups = ops.merge_samples(
        weights.detach(), marched.offsets, march.weight_bound, march.merge_weight, generator
    )
    if march.feature_weight > 0 and marched.features is None and hasattr(field, "colour_of_means"):
        means = ops.average_features(weights.detach(), groups, of_rays, march.feature_weight)
        found = _mean_colours(field, marched, coloured, rays, of_rays, means)
        coloured, groups = coloured[means.offsets[:-1]], means.of_samples
    else:
        found = _colours(field, marched, coloured, rays, of_rays)
    samples = RaySamples(
        offsets=marched.offsets,
        t=marched.t,
        delta=delta,
        index=marched.index,
        density=marched.density,
        weights=weights,
        positions=marched.positions,
        directions=rays.directions,
        ray_start=t_min,
        ray_steps=ray_steps,
        colours=ops.spread_to_samples(found, groups, coloured),
        background=background.expand(len(rays), 3),
        target_opacity=target_opacity,
        patch=patch,
    )
    if hook is not None:
        samples = hook.on_samples(samples)
    return replace(composite(samples), coloured=coloured)


def composite(samples: RaySamples) -> Rendered:
    """Pixels from samples with colours and background: ``sum w c + (1 - sum w) background``."""
    if samples.colours is None or samples.background is None:
        raise ValueError("samples: found no colours or no background, expected both for compositing")
    colour, opacity, depth = ops.pixels(
        samples.weights, samples.colours, samples.t, samples.background, samples.offsets
    )
    return Rendered(colour, opacity, depth, samples)
