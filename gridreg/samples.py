"""The points along the rays of one batch, packed."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace as _replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.segments import (
    check_samples,
    optical_depth_to_weights,
    rectangle,
    spread,
    sum_before,
    sum_per_ray,
)

# Programs close a ray with an interval of 1e10, so that it ends opaque: no length of anything in the scene.
_ENDLESS = 1e9


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Samples along `R` rays, `N` in all, ray after ray; ray `r` has ``offsets[r] : offsets[r + 1]``.

    A march skips empty space, so rays hold different numbers of samples. What was skipped counts as
    density 0: `index`, `ray_start` and `ray_steps` say where the kept samples lie among all steps of their
    ray, and penalties that average along a ray use these, so their value does not depend on what was skipped.

    Args:
        offsets: ``(R + 1,)`` int64, from 0 to `N`, never decreasing.
        t: ``(N,)`` distance along the ray, world units.
        delta: ``(N,)`` length of the sample's interval, world units.
        index: ``(N,)`` int64, number of the sample on its ray counted from the ray's entry into the box,
            skipped ones included.
        density: ``(N,)`` per world unit.
        weights: ``(N,)`` fraction of the pixel's colour that comes from the sample.
        positions: ``(N, 3)`` world coordinates, or None.
        colours: ``(N, 3)`` in [0, 1], 0 where not evaluated, or None.
        directions: ``(R, 3)`` unit vectors, or None.
        background: ``(R, 3)`` colour behind each ray, or None.
        ray_start: ``(R,)`` distance at which the ray enters the box, world units; None: inferred from the
            first kept sample.
        ray_steps: ``(R,)`` int64, number of steps between entry and exit, skipped ones included; None: up to
            the last kept sample.
        patch: ``(count, height, width)``: the last ``count * height * width`` rays are image patches, row by
            row; None: the rays have no order.
        target_opacity: ``(R,)`` alpha, in [0, 1], of the pixel that each ray is compared with, NaN where it is not
            known; None: it is known of no ray.
        target_depth: ``(R,)`` depth of that pixel by a file of the user's, in a unit of its own, growing with the
            distance, NaN where it is not known; None: it is known of no ray.
        images: ``(R,)`` int64, number of the image that each ray belongs to; None: all belong to one.
        gradients: ``(N, 3)`` derivative of the density, or of a signed distance, by the position, or None.
        proposals: samples of the proposal networks on the same rays, coarse ones first, or None.

    Raises:
        InputError: a tensor has another shape, dtype or device than said above.

    Example:
        >>> import torch
        >>> t, density = torch.tensor([[0.5, 1.5]]), torch.tensor([[0.0, 50.0]])
        >>> samples = RaySamples.from_dense(t, torch.ones(1, 2), density)
        >>> len(samples), samples.rays, samples.opacity.item(), samples.depth.item()
        (2, 1, 1.0, 1.5)
    """

    offsets: Tensor
    t: Tensor
    delta: Tensor
    index: Tensor
    density: Tensor
    weights: Tensor
    positions: Tensor | None = None
    colours: Tensor | None = None
    directions: Tensor | None = None
    background: Tensor | None = None
    ray_start: Tensor | None = None
    ray_steps: Tensor | None = None
    patch: tuple[int, int, int] | None = None
    target_opacity: Tensor | None = None
    target_depth: Tensor | None = None
    images: Tensor | None = None
    gradients: Tensor | None = None
    proposals: tuple[RaySamples, ...] | None = None

    def __post_init__(self) -> None:
        """Refuse shapes, types and devices that do not fit together."""
        check_samples(self)

    @classmethod
    def from_dense(
        cls,
        t: Tensor,
        delta: Tensor,
        density: Tensor,
        weights: Tensor | None = None,
        *,
        positions: Tensor | None = None,
        colours: Tensor | None = None,
        gradients: Tensor | None = None,
        valid: Tensor | None = None,
        **others: Any,
    ) -> RaySamples:
        """Pack a rectangle of `R` rays with `S` samples each.

        Args:
            t: ``(R, S)`` or ``(S,)`` distances along the ray, world units, rising.
            delta: ``(R, S)`` or ``(S,)`` lengths of the intervals, world units.
            density: ``(R, S)`` per world unit.
            weights: ``(R, S)``, or None: computed from density and delta.
            positions, colours, gradients: ``(R, S, 3)``, or None.
            valid: ``(R, S)`` bool; the others are skipped, and count as density 0. None: all are kept.
            others: as in `RaySamples`: directions, background, patch, target_opacity, ...

        Raises:
            InputError: a shape differs, or `valid` is not bool.
        """
        t, delta, offsets, kept = rectangle(t, delta, density, valid)
        rays, width = density.shape

        def pack(name: str, value: Tensor | None, *tail: int) -> Tensor | None:
            if value is not None and tuple(value.shape) != (rays, width, *tail):
                raise InputError(f"{name} must have shape {(rays, width, *tail)}, found {tuple(value.shape)}")
            return None if value is None else value.flatten(0, 1).index_select(0, kept)

        packed: dict[str, Any] = {
            "t": pack("t", t),
            "delta": pack("delta", delta),
            "index": pack("index", torch.arange(width, device=density.device).expand(rays, width)),
            "density": pack("density", density),
            "weights": pack("weights", weights),
            "positions": pack("positions", positions, 3),
            "colours": pack("colours", colours, 3),
            "gradients": pack("gradients", gradients, 3),
        }
        if weights is None:
            packed["weights"] = optical_depth_to_weights(packed["density"] * packed["delta"], offsets)
        steps = torch.full((rays,), width, dtype=torch.int64, device=density.device)
        start = t[:, 0] if width else t.new_zeros(rays)
        return cls(offsets, ray_start=start, ray_steps=steps, **packed, **others)

    @classmethod
    def from_packed(
        cls,
        ray_indices: Tensor,
        t_starts: Tensor,
        t_ends: Tensor,
        density: Tensor,
        weights: Tensor | None = None,
        *,
        rays: int | None = None,
        index: Tensor | None = None,
        **others: Any,
    ) -> RaySamples:
        """Take packed samples as nerfacc, DVGO and ngp_pl give them.

        The distance `t` of a sample is the middle of its interval. An interval of 1e10 or more, with which programs
        close a ray, has no middle: its sample lies at its start, and its length counts for its weight alone.

        Args:
            ray_indices: ``(N,)`` ray of each sample, never decreasing; DVGO's `ray_id`.
            t_starts, t_ends: ``(N,)`` ends of the intervals, world units, rising along a ray.
            density: ``(N,)`` per world unit.
            weights: ``(N,)``, or None: computed from the density and the intervals.
            rays: number of rays `R`, nerfacc's `n_rays`; None: up to the last that has samples.
            index: ``(N,)`` number of each sample on its ray, skipped ones included, DVGO's `step_id`; None: counted
                from the first one given.
            others: as in `RaySamples`: positions, colours, directions, ray_start, ray_steps, ...

        Raises:
            InputError: the rays are not in order, or a shape differs.

        Example:
            >>> ends = torch.tensor([1.0, 1e10, 3.0])
            >>> rays = torch.tensor([0, 0, 2])
            >>> samples = RaySamples.from_packed(rays, torch.tensor([0.0, 1.0, 2.0]), ends, torch.ones(3))
            >>> samples.t.tolist(), samples.counts.tolist()
            ([0.5, 1.0, 2.5], [2, 0, 1])
        """
        named = {"t_starts": t_starts, "t_ends": t_ends, "density": density, "ray_indices": ray_indices}
        # Columns (N, 1) are how some of these programs keep them.
        starts, ends, density, ray_indices = (v[:, 0] if v.shape[1:] == (1,) else v for v in named.values())
        if any(v.shape != ray_indices.shape or v.ndim != 1 for v in (starts, ends, density)):
            found = ", ".join(f"{name} {tuple(value.shape)}" for name, value in named.items())
            raise InputError(f"samples: expected one value of each for every sample, found {found}")
        ray_indices = ray_indices.long()
        last = int(ray_indices[-1]) if len(ray_indices) and (rays is None or ray_indices.is_cpu) else -1
        if ray_indices.is_cpu and bool((ray_indices.diff() < 0).any()):
            raise InputError("ray_indices must never decrease; sort the samples by ray first")
        rays = last + 1 if rays is None else rays
        if last >= rays:
            raise InputError(f"rays={rays}: found samples of ray {last}")
        offsets = torch.searchsorted(ray_indices, torch.arange(rays + 1, device=ray_indices.device))
        delta = (ends - starts).clamp(max=1e10)
        t = torch.where(delta < _ENDLESS, starts + delta / 2, starts)
        if index is None:
            index = torch.arange(len(t), device=t.device) - offsets[ray_indices]
        if weights is None:
            weights = optical_depth_to_weights(density * delta, offsets)
        return cls(offsets, t, delta, index.long(), density, weights.reshape(t.shape), **others)

    def __len__(self) -> int:
        """Number of samples, `N`."""
        return self.t.shape[0]

    @property
    def rays(self) -> int:
        """Number of rays, `R`."""
        return self.offsets.shape[0] - 1

    @property
    def counts(self) -> Tensor:
        """Number of kept samples of each ray, ``(R,)`` int64."""
        return self.offsets[1:] - self.offsets[:-1]

    @cached_property
    def ray_indices(self) -> Tensor:
        """Ray of each sample, ``(N,)`` int64."""
        rays = torch.arange(self.rays, device=self.offsets.device)
        return torch.repeat_interleave(rays, self.counts, output_size=len(self))

    @property
    def opacity(self) -> Tensor:
        """Sum of the weights of each ray, ``(R,)``, in [0, 1]."""
        return self.sum_per_ray(self.weights)

    @property
    def depth(self) -> Tensor:
        """Sum of weight times distance of each ray, ``(R,)``, world units; not divided by the opacity."""
        return self.sum_per_ray(self.weights * self.t)

    @cached_property
    def lengths(self) -> Tensor:
        """`delta`, and 0 where a ray is closed by an interval of 1e9 or more, ``(N,)``, world units."""
        return torch.where(self.delta < _ENDLESS, self.delta, torch.zeros_like(self.delta))

    @cached_property
    def start(self) -> Tensor:
        """`ray_start`, or if None the entry inferred from each first kept sample, ``(R,)``, world units."""
        if self.ray_start is not None:
            return self.ray_start
        if len(self) == 0:
            return self.t.new_zeros(self.rays)
        first = self.offsets[:-1].clamp(max=len(self) - 1)
        entry = (self.t - self.index * self.lengths).detach().index_select(0, first)
        return torch.where(self.counts > 0, entry, torch.zeros_like(entry))

    @cached_property
    def steps(self) -> Tensor:
        """`ray_steps`, or where it is None, the number of the last kept sample plus 1, ``(R,)`` int64."""
        if self.ray_steps is not None:
            return self.ray_steps
        if len(self) == 0:
            return torch.zeros_like(self.counts)
        last = self.index.index_select(0, (self.offsets[1:] - 1).clamp(min=0)) + 1
        return torch.where(self.counts > 0, last, torch.zeros_like(last))

    def sum_per_ray(self, values: Tensor) -> Tensor:
        """Add ``(N, ...)`` along each ray: ``(R, ...)``; 0 for a ray without samples."""
        return sum_per_ray(values, self.offsets, self.ray_indices)

    def spread(self, values: Tensor) -> Tensor:
        """Give each sample the value of its ray: ``(R, ...)`` to ``(N, ...)``."""
        return spread(values, self.offsets, self.ray_indices)

    def sum_before(self, values: Tensor) -> Tensor:
        """Add ``(N,)`` over the earlier samples of the same ray: ``(N,)``, in float64 inside."""
        return sum_before(values, self.offsets, self.ray_indices)

    def to_dense(self, values: Tensor, width: int | None = None) -> Tensor:
        """Write ``(N, ...)`` into ``(R, width, ...)`` at each sample's `index`; 0 where none was kept.

        Args:
            values: ``(N, ...)``.
            width: number of columns; None: the largest index plus 1.

        Raises:
            InputError: `width` is too small for the largest index.
        """
        needed = int(self.index.max()) + 1 if len(self) else 0
        width = needed if width is None else width
        if width < needed:
            raise InputError(f"width {width} is too small: the largest sample index is {needed - 1}")
        dense = values.new_zeros((self.rays * width, *values.shape[1:]))
        slots = self.ray_indices * width + self.index
        return dense.index_copy(0, slots, values).reshape(self.rays, width, *values.shape[1:])

    def replace(self, **changes: Any) -> RaySamples:
        """A copy with some fields changed; the others are shared, not copied."""
        return _replace(self, **changes)
