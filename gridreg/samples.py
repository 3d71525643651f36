"""The points along the rays of one batch, packed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from dataclasses import replace as _replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.segments import optical_depth_to_weights, spread, sum_before, sum_per_ray

__all__ = ["RaySamples"]


_PER_SAMPLE = ("t", "delta", "index", "density", "weights")
_PER_SAMPLE_3 = ("positions", "colours")
_PER_RAY_3 = ("directions", "background")
_PER_RAY = ("ray_start", "ray_steps", "target_opacity")
_INTEGERS = ("offsets", "index", "ray_steps")


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
        weights: ``(N,)`` share of the pixel's colour that comes from the sample.
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

    def __post_init__(self) -> None:
        if self.offsets.ndim != 1 or self.offsets.shape[0] < 1:
            raise InputError(f"offsets must have shape (rays + 1,), found {tuple(self.offsets.shape)}")
        rays, count = self.offsets.shape[0] - 1, self.t.shape[0] if self.t.ndim else -1
        expected = {
            **dict.fromkeys(_PER_SAMPLE, (count,)),
            **dict.fromkeys(_PER_SAMPLE_3, (count, 3)),
            **dict.fromkeys(_PER_RAY_3, (rays, 3)),
            **dict.fromkeys(_PER_RAY, (rays,)),
        }
        for name, value in self._tensors():
            if name in expected and tuple(value.shape) != expected[name]:
                raise InputError(
                    f"{name} must have shape {expected[name]} for {count} samples on {rays} rays, "
                    f"found {tuple(value.shape)}"
                )
            integer = name in _INTEGERS
            if not (value.dtype == torch.int64 if integer else value.is_floating_point()):
                wanted = "int64" if integer else "a floating-point type"
                raise InputError(f"{name} must be {wanted}, found {value.dtype}")
            if value.device != self.t.device:
                raise InputError(
                    f"{name} is on {value.device}, but t is on {self.t.device}: one device for all"
                )
        # Reading the values would stop a GPU's queue, so elsewhere only the shapes are checked.
        if self.offsets.device.type == "cpu":
            ends = int(self.offsets[0]), int(self.offsets[-1])
            if ends != (0, count) or bool((self.offsets[1:] < self.offsets[:-1]).any()):
                raise InputError(
                    f"offsets must rise from 0 to the {count} samples, found {ends[0]} to {ends[1]}"
                )
        if self.patch is not None and (min(self.patch) < 1 or self._patch_rays() > rays):
            raise InputError(
                f"patch {self.patch} needs {self._patch_rays()} rays at the end of the {rays} given"
            )

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                yield field.name, value

    def _patch_rays(self) -> int:
        return self.patch[0] * self.patch[1] * self.patch[2] if self.patch is not None else 0

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
        directions: Tensor | None = None,
        background: Tensor | None = None,
        valid: Tensor | None = None,
        patch: tuple[int, int, int] | None = None,
        target_opacity: Tensor | None = None,
    ) -> RaySamples:
        """Pack a rectangle of `R` rays with `S` samples each.

        Args:
            t: ``(R, S)`` or ``(S,)`` distances along the ray, world units, rising.
            delta: ``(R, S)`` or ``(S,)`` lengths of the intervals, world units.
            density: ``(R, S)`` per world unit.
            weights: ``(R, S)``, or None: computed from density and delta.
            positions: ``(R, S, 3)``, or None.
            colours: ``(R, S, 3)``, or None.
            directions: ``(R, 3)``, or None.
            background: ``(R, 3)``, or None.
            valid: ``(R, S)`` bool; the others are skipped, and count as density 0. None: all are kept.
            patch, target_opacity: as in `RaySamples`.

        Raises:
            InputError: a shape differs, or `valid` is not bool.
        """
        if density.ndim != 2:
            raise InputError(f"density must have shape (rays, samples), found {tuple(density.shape)}")
        rays, width = density.shape
        if valid is None:
            valid = torch.ones(rays, width, dtype=torch.bool, device=density.device)
        if valid.dtype != torch.bool or valid.shape != density.shape:
            raise InputError(
                f"valid must be bool of shape {(rays, width)}, found {valid.dtype} {tuple(valid.shape)}"
            )
        try:
            t, delta = t.expand(rays, width), delta.expand(rays, width)
        except RuntimeError as error:
            raise InputError(
                f"t and delta must have shape {(rays, width)} like density, "
                f"found {tuple(t.shape)} and {tuple(delta.shape)}"
            ) from error
        for name, value, tail in (
            ("weights", weights, ()),
            ("positions", positions, (3,)),
            ("colours", colours, (3,)),
        ):
            if value is not None and tuple(value.shape) != (rays, width, *tail):
                raise InputError(f"{name} must have shape {(rays, width, *tail)}, found {tuple(value.shape)}")
        offsets = torch.cat([valid.new_zeros(1, dtype=torch.int64), valid.sum(1).cumsum(0)])
        kept = valid.flatten().nonzero()[:, 0]

        def pack(value: Tensor) -> Tensor:
            return value.flatten(0, 1).index_select(0, kept)

        index = torch.arange(width, device=density.device).expand(rays, width)
        if weights is None:
            packed_weights = optical_depth_to_weights(pack(density) * pack(delta), offsets)
        else:
            packed_weights = pack(weights)
        return cls(
            offsets=offsets,
            t=pack(t),
            delta=pack(delta),
            index=pack(index),
            density=pack(density),
            weights=packed_weights,
            positions=None if positions is None else pack(positions),
            colours=None if colours is None else pack(colours),
            directions=directions,
            background=background,
            ray_start=t[:, 0] if width else t.new_zeros(rays),
            ray_steps=torch.full((rays,), width, dtype=torch.int64, device=density.device),
            patch=patch,
            target_opacity=target_opacity,
        )

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
    def start(self) -> Tensor:
        """`ray_start`, or if None the entry inferred from each first kept sample, ``(R,)``, world units."""
        if self.ray_start is not None:
            return self.ray_start
        if len(self) == 0:
            return self.t.new_zeros(self.rays)
        first = self.offsets[:-1].clamp(max=len(self) - 1)
        entry = (self.t - self.index * self.delta).detach().index_select(0, first)
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
