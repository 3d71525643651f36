"""The coordinate network of NeRF (Mildenhall et al., ECCV 2020), for FreeNeRF (Yang et al., CVPR 2023)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backbones.hierarchical import intervals, inverse_transform, stratified
from backbones.tensorial import check_box, density_shift_for
from gridreg import ops
from gridreg.attach.selectors import parameters
from gridreg.attach.sites import Site
from gridreg.encodings import octaves_of_channels, positional_encoding
from gridreg.ops.fused_adam import FusedAdam
from gridreg.ops.perceptron import Precision

if TYPE_CHECKING:
    from gridreg.rendering import OccupancyGrid, Rays

# Positions at once where no gradient is wanted: some tens of megabytes of hidden units.
_CHUNK = 1 << 15


class MLPField(nn.Module):
    """Density and colour from one network of ``depth`` layers, which sees the position again half-way.

    Position and direction enter by positional encodings, which FreeNeRF masks: sites ``encoding.position``
    and ``encoding.direction``, columns of the weights that read them, with the octave of each.

    Rays are sampled twice: evenly, and where the first look found something. FreeNeRF's program for the
    synthetic scenes has a network for each look (NeRF); here one network serves both, as in mip-NeRF, and the first
    look is taken without gradient: what is composited, and learned from, is the union of both, so that a step
    costs ``coarse_samples`` less than NeRF's per ray, and half the parameters.

    Density is ``softplus(f(x) + shift)``, with ``f`` 0 everywhere before training. NeRF's ReLU has no
    gradient where it is 0 and in some runs never starts, which its programs cure by training on the middle of
    the images at first.

    Args:
        bounds: ``(2, 3)``, world units. Encodings see positions from its centre, in thirds of its longest
            edge: world coordinates in the box [-1.5, 1.5]^3 of the synthetic scenes.
        resolution: of grids; a network has none, and ignores it.
        width, depth: of the trunk (256 and 8 in NeRF).
        skip: the layer after which the encoded position is put beside the hidden units again (4 in NeRF),
            from 0.
        colour_width: of the layer that sees the direction (128 in NeRF).
        position_octaves, direction_octaves: 10 and 4, as NeRF and FreeNeRF's program for the synthetic
            scenes. (Its program for real scenes is mip-NeRF's, where 16 octaves of the position are averaged
            over cones.)
        coarse_samples, fine_samples: per ray (64 and 128 in NeRF).
        initial_opacity: of a ray along the mean edge of the box before training. (mip-NeRF's shift of -1
            makes 0.6 of it in the synthetic scenes.)
        precision: of the matrix products on the CPU, see `gridreg.ops.mlp`.
        generator: for the initial weights.

    Raises:
        ValueError: for a box without volume, or sizes below 1.

    Example:
        >>> field = MLPField(torch.tensor([[-1.5] * 3, [1.5] * 3]), width=32)
        >>> round(1 - math.exp(-3.0 * field.density(torch.zeros(1, 3)).item()), 4)
        0.5
    """

    bounds: Tensor

    def __init__(
        self,
        bounds: Tensor,
        resolution: tuple[int, int, int] | None = None,
        *,
        width: int = 256,
        depth: int = 8,
        skip: int = 4,
        colour_width: int = 128,
        position_octaves: int = 10,
        direction_octaves: int = 4,
        coarse_samples: int = 64,
        fine_samples: int = 128,
        initial_opacity: float = 0.5,
        precision: Precision = "auto",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        check_box(bounds)
        sizes = {"width": width, "colour_width": colour_width, "skip": skip, "depth": depth}
        sizes |= {"coarse_samples": coarse_samples, "fine_samples": fine_samples}
        least = {"skip": 0, "depth": skip + 2}
        for name, size in sizes.items():
            if size < least.get(name, 1):
                raise ValueError(f"{name}={size}: expected at least {least.get(name, 1)}")
        self.register_buffer("bounds", bounds.clone().float())
        self.position_octaves, self.direction_octaves = position_octaves, direction_octaves
        self.coarse_samples, self.fine_samples = coarse_samples, fine_samples
        self.precision, self.skip = precision, skip
        self.density_shift = density_shift_for(
            initial_opacity, float((bounds[1] - bounds[0]).mean()), distance_scale=1.0
        )
        positions, directions = 3 * (1 + 2 * position_octaves), 3 * (1 + 2 * direction_octaves)
        reads = [width] * depth
        reads[0], reads[skip + 1] = positions, positions + width
        self.trunk = nn.ModuleList(nn.Linear(count, width) for count in reads)
        self.density_head = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.colour_layers = nn.ModuleList(
            [nn.Linear(directions + width, colour_width), nn.Linear(colour_width, 3)]
        )
        self._initialise(generator)

    @torch.no_grad()
    def _initialise(self, generator: torch.Generator | None) -> None:
        """Glorot's uniform weights, with the gain of the ReLU before which they stand; biases 0."""
        rectified = [*self.trunk, self.colour_layers[0]]
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                gain = math.sqrt(2) if layer in rectified else 1.0
                bound = gain * math.sqrt(6 / (layer.in_features + layer.out_features))
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()
        self.density_head.weight.zero_()

    def _hidden(self, x: Tensor) -> Tensor:
        """The trunk: positions ``(N, 3)`` to hidden units ``(N, width)``."""
        centre = self.bounds.mean(0)
        third = (self.bounds[1] - self.bounds[0]).max() / 3
        encoded = positional_encoding((x - centre) / third, self.position_octaves)
        before, after = self.trunk[: self.skip + 1], self.trunk[self.skip + 1 :]
        hidden = torch.relu(ops.mlp(encoded, _pairs(before), precision=self.precision))
        again = [ops.Block(encoded, 0), ops.Block(hidden, 0)]
        return torch.relu(ops.encoded_mlp(again, _pairs(after), precision=self.precision))

    def _density_of(self, hidden: Tensor) -> Tensor:
        """Hidden units ``(N, width)`` to densities ``(N,)`` per world unit."""
        return F.softplus(self.density_head(hidden).squeeze(-1) + self.density_shift)

    def density(self, x: Tensor) -> Tensor:
        """Density ``(N,)`` per world unit at world positions ``(N, 3)``; 0 outside the box."""
        inside = ((x >= self.bounds[0]) & (x <= self.bounds[1])).all(dim=-1)
        density = torch.cat([self._density_of(self._hidden(part)) for (part,) in _parts(x)])
        return torch.where(inside, density, torch.zeros_like(density))

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        """Colour ``(N, 3)`` at world positions ``(N, 3)`` seen along unit directions ``(N, 3)``."""
        return torch.cat([self._colour_of(self._hidden(a), b, None) for a, b in _parts(x, d)])

    def colour_of_rays(self, x: Tensor, directions: Tensor, ray_indices: Tensor) -> Tensor:
        """Like `colour` with directions ``(R, 3)`` given per ray and the ray ``(N,)`` of each position."""
        parts = _parts(x, ray_indices)
        return torch.cat([self._colour_of(self._hidden(a), directions, b) for a, b in parts])

    def colour_of_features(self, features: Tensor, directions: Tensor, ray_indices: Tensor) -> Tensor:
        """Like `colour_of_rays`, from the hidden units ``(N, width)`` that `march_density` returned."""
        return self._colour_of(features, directions, ray_indices)

    def _colour_of(self, hidden: Tensor, directions: Tensor, ray_indices: Tensor | None) -> Tensor:
        hidden = ops.mlp(hidden, _pairs([self.bottleneck]), precision=self.precision)
        blocks = [ops.Block(directions, self.direction_octaves, ray_indices), ops.Block(hidden, 0)]
        return torch.sigmoid(ops.encoded_mlp(blocks, _pairs(self.colour_layers), precision=self.precision))

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
        """Coarse and fine samples of rays, and the density at all of them.

        The coarse samples are evenly spread, and looked at without gradient; the fine ones follow their
        weights (NeRF, section 5.2). Samples in empty cells count as density 0 at both looks.

        Args:
            rays: ``R`` rays.
            t_min, t_max: ``(R,)``, where they enter and leave the box.
            step: not used: how densely rays are sampled does not follow from a grid.
            occupancy: cells that may hold something.
            jitter: ``(R,)`` in [0, 1), of both looks.
            transmittance_bound: not used: what is hidden is known only once it is evaluated.

        Returns:
            The union of both looks. Where gradients are wanted, its features are the hidden units, so that
            the trunk is not computed again for the colour.
        """
        with torch.no_grad():
            t = self._distances(rays, t_min, t_max, occupancy, jitter)
            met = t_max > t_min
            positions, kept = _placed(rays, t, met, occupancy)
            ray, index = kept.nonzero(as_tuple=True)
            delta = intervals(t, t_min, t_max)[kept]
            offsets = F.pad(kept.sum(1).cumsum(0), (1, 0))
        x = positions[kept]
        if torch.is_grad_enabled():
            features = self._hidden(x)
            density = self._density_of(features)
        else:
            features, density = None, self.density(x)
        return ops.RayMarchResult(
            offsets, index, t[ray, index], x, density, delta, met.long() * t.shape[1], features=features
        )

    def _distances(
        self, rays: Rays, t_min: Tensor, t_max: Tensor, occupancy: OccupancyGrid, jitter: Tensor
    ) -> Tensor:
        """Coarse and fine samples in order, ``(R, coarse_samples + fine_samples)``, world units."""
        coarse, edges = stratified(t_min, t_max, self.coarse_samples, jitter)
        positions, kept = _placed(rays, coarse, t_max > t_min, occupancy)
        depth = torch.zeros_like(coarse)
        depth[kept] = self.density(positions[kept])
        depth *= edges.diff(dim=1)
        offsets = torch.arange(len(rays) + 1, device=coarse.device) * self.coarse_samples
        weights = ops.composite_weights(depth.reshape(-1), offsets).reshape(coarse.shape)
        fine = inverse_transform(edges, weights, self.fine_samples, jitter)
        return torch.cat([coarse, fine], dim=1).sort(dim=1).values

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One optimizer group, named ``network``."""
        return [{"name": "network", "params": list(self.parameters())}]

    def make_optimizer(
        self, groups: list[dict[str, Any]], betas: tuple[float, float]
    ) -> torch.optim.Optimizer:
        """Adam with NeRF's moments, 0.9 and 0.999, whatever ``betas`` a trainer has for grids."""
        return FusedAdam(groups, betas=(0.9, 0.999))

    def sites(self) -> dict[str, Site]:
        """The encodings: columns of every weight that reads them, each with its octave."""
        positions = octaves_of_channels(3, self.position_octaves)
        directions = octaves_of_channels(3, self.direction_octaves)
        selectors = [
            parameters(f"{name}.weight", dim=1, channels=slice(0, len(octaves)), octaves=octaves)
            for name, octaves in (
                ("trunk.0", positions),
                (f"trunk.{self.skip + 1}", positions),
                ("colour_layers.0", directions),
            )
        ]
        return {"encoding.position": Site(mask=selectors[:2]), "encoding.direction": Site(mask=selectors[2])}


def _pairs(layers: Any) -> list[tuple[Tensor, Tensor | None]]:
    """Weights and biases of linear layers."""
    return [(layer.weight, layer.bias) for layer in layers]


def _parts(*positions: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Tensors in pieces of equal length, or where a gradient is wanted, whole."""
    if torch.is_grad_enabled():
        return [positions]
    return zip(*(torch.split(x, _CHUNK) for x in positions), strict=True)


def _placed(rays: Rays, t: Tensor, met: Tensor, occupancy: OccupancyGrid) -> tuple[Tensor, Tensor]:
    """Positions ``(R, S, 3)`` of samples at distances ``(R, S)``, and whether they may hold something."""
    positions = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    kept = occupancy.contains(positions.reshape(-1, 3)).reshape(t.shape)
    return positions, kept & met[:, None]
