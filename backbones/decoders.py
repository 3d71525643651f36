"""From appearance features, direction and position to colour: the ``S`` of TensoRF (section 4.1)."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from gridreg import ops
from gridreg.attach._hooks import open_channels
from gridreg.attach.selectors import inputs, parameters
from gridreg.attach.sites import Site
from gridreg.encodings import octaves_of_channels
from gridreg.ops.perceptron import Precision


class Basis(nn.Linear):
    """The linear map from components to features (TensoRF's matrix ``B``), without bias.

    Args:
        components: that it reads.
        features: that it gives.
        precision: of the product on the CPU, see `gridreg.ops.mlp`.
    """

    def __init__(self, components: int, features: int, precision: Precision = "auto") -> None:
        super().__init__(components, features, bias=False)
        self.precision = precision

    @property
    def input_dtype(self) -> torch.dtype:
        """The dtype to which the input is rounded."""
        return ops.product_dtype(self.precision)

    def forward(self, components: Tensor) -> Tensor:
        """Components ``(N, C)``, float32 or `input_dtype`, to features ``(N, F)``, float32."""
        return ops.mlp(components, [(self.weight, None)], precision=self.precision)


class MLPDecoder(nn.Module):
    """An MLP ``width-width-3`` on features, direction and position, each with its positional encoding.

    The columns of the first weight are ``[features | direction | position]``, each block ordered octave by
    octave, so a mask on an encoding is a mask on columns of that weight: the same function, at the cost of a
    small matrix.

    Args:
        features: appearance features ``F`` (27 in TensoRF).
        feature_octaves, direction_octaves: octaves of the encodings (2 and 2 for ``MLP_Fea``).
        position_octaves: octaves of the position's encoding; None leaves the position out.
        width: hidden width.
        precision: of the matrix products on the CPU, see `gridreg.ops.mlp`.
    """

    layers: nn.ModuleList

    def __init__(
        self,
        features: int = 27,
        *,
        feature_octaves: int = 2,
        direction_octaves: int = 2,
        position_octaves: int | None = None,
        width: int = 128,
        precision: Precision = "auto",
    ) -> None:
        super().__init__()
        self.features = features
        self.precision = precision
        self.feature_octaves = feature_octaves
        self.direction_octaves = direction_octaves
        self.position_octaves = position_octaves
        self.layers = nn.ModuleList(
            [nn.Linear(sum(self.block_sizes), width), nn.Linear(width, width), nn.Linear(width, 3)]
        )
        nn.init.zeros_(self.layers[2].bias)  # type: ignore[arg-type]

    @property
    def block_sizes(self) -> tuple[int, int, int]:
        """Input columns of features, direction and position."""
        position = 0 if self.position_octaves is None else 3 * (1 + 2 * self.position_octaves)
        return (
            self.features * (1 + 2 * self.feature_octaves),
            3 * (1 + 2 * self.direction_octaves),
            position,
        )

    def forward(
        self, features: Tensor, directions: Tensor, positions: Tensor, ray_indices: Tensor | None = None
    ) -> Tensor:
        """Colours ``(N, 3)`` in (0, 1).

        Args:
            features: ``(N, F)``.
            directions: ``(N, 3)``, or ``(R, 3)`` with ``ray_indices``.
            positions: ``(N, 3)`` normalised to [-1, 1].
            ray_indices: ``(N,)``: the ray of each sample; its direction is then encoded once per ray.
        """
        blocks = [
            ops.Block(features, self.feature_octaves),
            ops.Block(directions, self.direction_octaves, ray_indices),
        ]
        if self.position_octaves is not None:
            blocks.append(ops.Block(positions, self.position_octaves))
        blocks, first = self._open(blocks)
        layers = [(first, self.layers[0].bias), *((layer.weight, layer.bias) for layer in self.layers[1:])]
        out = ops.encoded_mlp(blocks, layers, precision=self.precision)  # type: ignore[arg-type]
        return torch.sigmoid(out)

    def _open(self, blocks: list[ops.Block]) -> tuple[list[ops.Block], Tensor]:
        """Encodings without the octaves that masks have closed altogether, and the weight's columns for them."""
        parts, columns, start = [], [], 0
        for block in blocks:
            stop = start + block.width
            opened = open_channels(self.layers[0], "weight", slice(start, stop))
            if opened is not None:
                dims = block.x.shape[1]
                block = block._replace(octaves=max(0, math.ceil((opened - dims) / (2 * dims))))
            parts.append(block)
            columns.append(slice(start, start + block.width))
            start = stop
        weight: Tensor = self.layers[0].weight  # type: ignore[assignment]
        if sum(part.width for part in parts) < start:
            weight = torch.cat([weight[:, part] for part in columns], dim=1)
        return parts, weight

    def sites(self, prefix: str) -> dict[str, Site]:
        """The encodings' sites: columns of the first weight, each with its octave."""
        found, start = {}, 0
        octaves = (self.feature_octaves, self.direction_octaves, self.position_octaves or 0)
        for name, size, width, count in zip(
            ("features", "direction", "position"),
            self.block_sizes,
            (self.features, 3, 3),
            octaves,
            strict=True,
        ):
            if size:
                selector = parameters(
                    f"{prefix}.layers.0.weight",
                    dim=1,
                    channels=slice(start, start + size),
                    octaves=octaves_of_channels(width, count),
                )
                found[f"encoding.{name}"] = Site(mask=selector)
            start += size
        return found


class SHDecoder(nn.Module):
    """Spherical harmonics of degree 2, 9 coefficients per colour (PlenOctrees section 3; TensoRF "SH")."""

    bands = 3

    def __init__(self, features: int = 27) -> None:
        super().__init__()
        if features != 3 * self.bands**2:
            raise ValueError(f"features={features}: spherical harmonics of degree 2 need {3 * self.bands**2}")

    def forward(
        self, features: Tensor, directions: Tensor, positions: Tensor, ray_indices: Tensor | None = None
    ) -> Tensor:
        """Colours ``(N, 3)``; see `MLPDecoder.forward` for the arguments."""
        basis = spherical_harmonics(directions)
        if ray_indices is not None:
            basis = basis[ray_indices]
        return torch.relu((features.reshape(-1, 3, basis.shape[-1]) * basis[:, None, :]).sum(dim=-1) + 0.5)

    def sites(self, prefix: str) -> dict[str, Site]:
        """The coefficients, with the band (degree) of each as its octave."""
        bands = [band for _ in range(3) for band in range(self.bands) for _ in range(2 * band + 1)]
        return {"view": Site(mask=inputs(prefix, octaves=bands))}


class RGBDecoder(nn.Module):
    """The features are the colour: three of them, through a sigmoid. No dependence on the direction."""

    def __init__(self, features: int = 3) -> None:
        super().__init__()
        if features != 3:
            raise ValueError(f"features={features}: the RGB decoder needs 3")

    def forward(
        self, features: Tensor, directions: Tensor, positions: Tensor, ray_indices: Tensor | None = None
    ) -> Tensor:
        """Colours ``(N, 3)``; see `MLPDecoder.forward` for the arguments."""
        return torch.sigmoid(features)

    def sites(self, prefix: str) -> dict[str, Site]:
        """No sites: there is nothing to mask."""
        return {}


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The 9 real spherical harmonics up to degree 2 of unit directions ``(N, 3)``, as ``(N, 9)``."""
    x, y, z = directions.unbind(-1)
    one = math.sqrt(3 / (4 * math.pi))
    two = math.sqrt(15 / (4 * math.pi))
    return torch.stack(
        [
            torch.full_like(x, 0.5 / math.sqrt(math.pi)),
            -one * y,
            one * z,
            -one * x,
            two * x * y,
            -two * y * z,
            0.25 * math.sqrt(5 / math.pi) * (3 * z * z - 1),
            -two * x * z,
            0.5 * two * (x * x - y * y),
        ],
        dim=-1,
    )


def _mlp(feature: int, direction: int, position: int | None) -> Callable[..., nn.Module]:
    return functools.partial(
        MLPDecoder, feature_octaves=feature, direction_octaves=direction, position_octaves=position
    )


#: Decoders by name: default features, and constructor.
DECODERS: dict[str, tuple[int, Callable[..., nn.Module]]] = {
    "mlp_fea": (27, _mlp(2, 2, None)),
    "mlp_pe": (27, _mlp(0, 2, 6)),
    "mlp": (27, _mlp(2, 6, 6)),
    "sh": (27, SHDecoder),
    "rgb": (3, RGBDecoder),
}


def make_decoder(name: str, features: int | None = None, **options: Any) -> tuple[int, nn.Module]:
    """A decoder by name, and the number of features it reads.

    Args:
        name: ``mlp_fea`` (TensoRF MLP_Fea), ``mlp_pe`` (MLP_PE), ``mlp`` (Few TensoRF: position 6, direction
            6, feature 2 octaves), ``sh`` or ``rgb``.
        features: that it reads; None: its own default.
        options: of its constructor, such as ``width`` and ``precision`` of the MLPs.

    Raises:
        ValueError: for an unknown name.
        TypeError: for an option that the decoder does not have.
    """
    if name not in DECODERS:
        raise ValueError(f"decoder={name!r}: unknown; expected one of {', '.join(sorted(DECODERS))}")
    default, make = DECODERS[name]
    count = default if features is None else features
    return count, make(count, **options)
