"""Base of VM- and CP-TensoRF: a box, a density activation, a basis and a decoder."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backbones.decoders import Basis, make_decoder
from gridreg import ops
from gridreg.attach.sites import Site
from gridreg.ops.fused_adam import FusedAdam

if TYPE_CHECKING:
    from gridreg.rendering import OccupancyGrid, Rays


def density_shift_for(opacity: float, length: float, distance_scale: float) -> float:
    """The shift at which a ray through an untrained field has a wanted opacity.

    With features near 0, ``distance_scale * softplus(shift)`` must be ``-log(1 - opacity) / length``. DVGO (section
    4.1) derives its shift from the opacity of a step; the opacity of a ray does not depend on the step.

    Args:
        opacity: in (0, 1).
        length: of the ray inside the box, world units.
        distance_scale: factor on the density.

    Example:
        >>> shift = density_shift_for(0.1, 3.0, 25.0)
        >>> round(1 - math.exp(-25.0 * math.log1p(math.exp(shift)) * 3.0), 6)
        0.1
    """
    if not 0 < opacity < 1:
        raise ValueError(f"initial_opacity={opacity}: expected a number between 0 and 1, both excluded")
    return math.log(math.expm1(-math.log1p(-opacity) / (length * distance_scale)))


def resampled(grid: Tensor, size: tuple[int, ...]) -> Tensor:
    """Linear interpolation of a channels-last plane or line, corner to corner."""
    mode = "bilinear" if len(size) == 2 else "linear"
    out = F.interpolate(grid.movedim(-1, 0)[None], size=size, mode=mode, align_corners=True)[0]
    return out.movedim(0, -1).contiguous()


def check_box(bounds: Tensor) -> None:
    """Refuse what is no box ``(2, 3)``."""
    if tuple(bounds.shape) != (2, 3) or not bool((bounds[1] > bounds[0]).all()):
        raise ValueError(
            f"bounds={bounds.tolist()}: expected a lower and a larger upper corner, shape (2, 3)"
        )


@torch.no_grad()
def _initialise(modules: Iterable[nn.Module], generator: torch.Generator | None) -> None:
    """The default initial values of linear layers, drawn from a generator; the last bias of a decoder stays 0."""
    for module in modules:
        if isinstance(module, nn.Linear):
            bound = module.in_features**-0.5
            module.weight.uniform_(-bound, bound, generator=generator)
            if module.bias is not None and bool(module.bias.any()):
                module.bias.uniform_(-bound, bound, generator=generator)


class TensorialField(nn.Module):
    """``density = distance_scale * softplus(G(x) + shift)``, ``colour = S(B A(x), d)`` (TensoRF, section 4.1).

    Subclasses own the grids: they give `density_features`, `appearance_features`, `resample`, `_crop` and `_marched`.

    Args:
        bounds: ``(2, 3)``, world units.
        resolution: nodes along x, y, z.
        appearance_channels: width of `appearance_features`.
        decoder: name, see `backbones.decoders.make_decoder`.
        features: decoder features; None for the decoder's own default.
        density_shift: added before the softplus; -10 in TensoRF. None: from ``initial_opacity``.
        initial_opacity: opacity of a ray along the mean edge of the box before training; used when there is no shift.
        distance_scale: factor on the density (25 in TensoRF).
        generator: for the networks' initial values.
        decoder_options: of the decoder, such as ``width`` (128) and ``precision`` ("auto") of the MLPs.
    """

    bounds: Tensor

    def __init_subclass__(cls, **options: Any) -> None:
        """A subclass with a density of its own is marched through that density, unless it brings its own march."""
        super().__init_subclass__(**options)
        own = {"density", "density_features", "activate", "normalise"} & cls.__dict__.keys()
        if own and "_marched" not in cls.__dict__:
            cls._marched = TensorialField._marched  # type: ignore[method-assign]

    def __init__(
        self,
        bounds: Tensor,
        resolution: tuple[int, int, int],
        appearance_channels: int,
        *,
        decoder: str = "mlp_fea",
        features: int | None = None,
        density_shift: float | None = -10.0,
        initial_opacity: float = 0.1,
        distance_scale: float = 25.0,
        generator: torch.Generator | None = None,
        **decoder_options: Any,
    ) -> None:
        super().__init__()
        check_box(bounds)
        if min(resolution) < 2:
            raise ValueError(f"resolution={resolution}: expected at least 2 nodes along every axis")
        self.register_buffer("bounds", bounds.clone().float())
        self.resolution = resolution
        count, self.decoder = make_decoder(decoder, features, **decoder_options)
        # What has no network of bfloat16 behind it keeps its features whole.
        self.basis = Basis(appearance_channels, count, getattr(self.decoder, "precision", "float32"))
        _initialise([self.basis, *self.decoder.modules()], generator)
        self.distance_scale = distance_scale
        if density_shift is None:
            length = float((bounds[1] - bounds[0]).mean())
            density_shift = density_shift_for(initial_opacity, length, distance_scale)
        self.density_shift = density_shift

    def normalise(self, x: Tensor) -> Tensor:
        """World positions ``(N, 3)`` to [0, 1]^3 inside the box."""
        return (x - self.bounds[0]) / (self.bounds[1] - self.bounds[0])

    def density_features(self, u: Tensor) -> Tensor:
        """Normalised positions ``(N, 3)`` to the scalar ``G(x)``, ``(N,)``."""
        raise TypeError(f"{type(self).__name__} must define density_features")

    def appearance_features(self, u: Tensor) -> Tensor:
        """Normalised positions ``(N, 3)`` to components ``(N, C)``."""
        raise TypeError(f"{type(self).__name__} must define appearance_features")

    def _components(self, u: Tensor) -> Tensor:
        """`appearance_features` in the precision that the basis reads."""
        return self.appearance_features(u)

    def activate(self, features: Tensor) -> Tensor:
        """Density per world unit from density features."""
        return self.distance_scale * F.softplus(features + self.density_shift)

    def density(self, x: Tensor) -> Tensor:
        """Density ``(N,)`` per world unit at world positions ``(N, 3)``; 0 outside the box."""
        u = self.normalise(x)
        inside = ((u >= 0) & (u <= 1)).all(dim=-1)
        density = self.activate(self.density_features(u))
        return torch.where(inside, density, torch.zeros_like(density))

    def march_density(
        self,
        rays: Rays,
        t_min: Tensor,
        t_max: Tensor,
        step: float,
        occupancy: OccupancyGrid,
        jitter: Tensor,
        transmittance_bound: float,
    ) -> ops.RayMarchResult:
        """March, density and early termination in one: see `gridreg.ops.RayMarchResult`.

        Args:
            rays: ``R`` rays.
            t_min, t_max: ``(R,)``, where they enter and leave the box, world units.
            step: between samples, world units.
            occupancy: cells that may hold something.
            jitter: ``(R,)`` in [0, 1).
            transmittance_bound: samples behind this transmittance are dropped.
        """
        march = ops.MarchArguments(
            rays.origins, rays.directions, t_min, t_max, step, occupancy.cells, occupancy.bounds, jitter
        )
        activation = ops.Activation(self.bounds, self.density_shift, self.distance_scale)
        return self._marched(march, activation, transmittance_bound)

    def _marched(
        self, march: ops.MarchArguments, activation: ops.Activation, transmittance_bound: float
    ) -> ops.RayMarchResult:
        """The samples kept; subclasses evaluate their own grids while they march."""
        return ops.march_density(march, self.density, transmittance_bound)

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        """Colour ``(N, 3)`` at world positions ``(N, 3)`` seen along unit directions ``(N, 3)``."""
        return self._colour(x, d, None)

    def colour_of_rays(self, x: Tensor, directions: Tensor, ray_indices: Tensor) -> Tensor:
        """Like `colour` with directions ``(R, 3)`` given per ray and the ray ``(N,)`` of each position."""
        return self._colour(x, directions, ray_indices)

    def _colour(self, x: Tensor, directions: Tensor, ray_indices: Tensor | None) -> Tensor:
        u = self.normalise(x)
        features = self.basis(self._components(u))
        return self.decoder(features, directions, 2 * u - 1, ray_indices)  # type: ignore[no-any-return]

    def colour_of_means(
        self, x: Tensor, directions: Tensor, ray_indices: Tensor, fractions: Tensor, offsets: Tensor
    ) -> Tensor:
        """Colours ``(P, 3)`` of the mean features of neighbours on a ray.

        Args:
            x: ``(N, 3)``; those of run p are ``offsets[p] : offsets[p + 1]``.
            directions: ``(R, 3)``.
            ray_indices: ``(P,)`` the ray of each run.
            fractions: ``(N,)`` of each in the mean.
            offsets: ``(P + 1,)`` int64.
        """

        def mean(values: Tensor) -> Tensor:
            every = torch.arange(len(x), device=x.device)
            options: dict[str, Any] = {"mode": "sum", "include_last_offset": True}
            return F.embedding_bag(every, values, offsets, per_sample_weights=fractions, **options)

        u = self.normalise(x)
        # The basis is linear: it is the same before the mean, and then has more to do.
        features = self.basis(mean(self._components(u).float()))
        return self.decoder(features, directions, mean(2 * u - 1), ray_indices)  # type: ignore[no-any-return]

    def shrink(self, bounds: Tensor) -> None:
        """Crop to the nodes around a smaller box: inside it the field keeps its values exactly.

        Args:
            bounds: ``(2, 3)``, world units; the new box is the smallest one between nodes that holds it.
        """
        nodes = torch.tensor(self.resolution, device=self.bounds.device)
        cell = (self.bounds[1] - self.bounds[0]).double() / (nodes - 1)
        scaled = (bounds.double() - self.bounds[0].double()) / cell
        # A corner a rounding error past a node belongs to that node.
        lower = (scaled[0] + 1e-4).floor().long().clamp(min=0)
        upper = torch.minimum((scaled[1] - 1e-4).ceil().long(), nodes - 1)
        lower = torch.minimum(lower, upper - 1).clamp(min=0)
        upper = torch.maximum(upper, lower + 1)
        origin = self.bounds[0].double()
        self._crop(lower.tolist(), (upper + 1).tolist())
        self.bounds.copy_(torch.stack([origin + lower * cell, origin + upper * cell]).float())
        x, y, z = (upper - lower + 1).tolist()
        self.resolution = (x, y, z)

    def _crop(self, start: list[int], stop: list[int]) -> None:
        raise TypeError(f"{type(self).__name__} must define _crop")

    def grid_parameters(self) -> list[nn.Parameter]:
        """Planes and lines."""
        networks = {id(p) for p in self.network_parameters()}
        return [p for p in self.parameters() if id(p) not in networks]

    def network_parameters(self) -> list[nn.Parameter]:
        """Basis and decoder."""
        return [*self.basis.parameters(), *self.decoder.parameters()]

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Optimizer groups named ``grid`` and ``network``."""
        return [
            {"name": "grid", "params": self.grid_parameters()},
            {"name": "network", "params": self.network_parameters()},
        ]

    def make_optimizer(
        self, groups: list[dict[str, Any]], betas: tuple[float, float]
    ) -> torch.optim.Optimizer:
        """Adam that adds the gradients of grid penalties in its one pass over memory.

        Args:
            groups: as of `parameter_groups`, with learning rates.
            betas: decay rates of the moments.
        """
        return FusedAdam(groups, betas=betas)

    def gradient_context(self, rounding: float = 0.0) -> AbstractContextManager[None]:
        """Around a trainer's backward pass: gradients of planes are added to buffers that stay.

        ``rounding``: see `gridreg.ops.accumulate_into_grad`.
        """
        return ops.accumulate_into_grad(rounding)

    def sites(self) -> dict[str, Site]:
        """The encodings of the decoder; subclasses add their grids."""
        return self.decoder.sites("decoder")  # type: ignore[operator, no-any-return]
