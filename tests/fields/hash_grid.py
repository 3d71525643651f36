"""Somebody else's multi-resolution hash grid (Instant-NGP, Mueller et al. 2022)."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor, nn


class HashEncoder(nn.Module):
    """Levels of embeddings, hashed where the level is finer than the table; output level by level."""

    def __init__(
        self, levels: int = 4, features: int = 2, table: int = 128, base: int = 2, growth: float = 1.8
    ):
        super().__init__()
        self.resolutions = [int(base * growth**level) for level in range(levels)]
        self.levels = nn.ModuleList(
            nn.Embedding(min(table, (resolution + 1) ** 3), features) for resolution in self.resolutions
        )
        for level in self.levels:
            nn.init.uniform_(level.weight, -0.5, 0.5)
        self.register_buffer("primes", torch.tensor([1, 2654435761, 805459861]))

    def forward(self, x: Tensor) -> Tensor:
        outputs = []
        for resolution, embedding in zip(self.resolutions, self.levels, strict=True):
            scaled = x * resolution
            low = scaled.floor()
            fraction = scaled - low
            value = 0.0
            for corner in product((0, 1), repeat=3):
                offset = x.new_tensor(corner)
                weight = torch.where(offset > 0, fraction, 1 - fraction).prod(-1, keepdim=True)
                value = value + weight * embedding(self.slot((low + offset).long(), resolution, embedding))
            outputs.append(value)
        return torch.cat(outputs, -1)

    def slot(self, cell: Tensor, resolution: int, embedding: nn.Embedding) -> Tensor:
        entries, edge = embedding.num_embeddings, resolution + 1
        if edge**3 <= entries:
            return (cell[:, 0] * edge + cell[:, 1]) * edge + cell[:, 2]
        hashed = cell * self.primes
        return (hashed[:, 0] ^ hashed[:, 1] ^ hashed[:, 2]) % entries


def spherical_harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics of degrees 0 to 2, unnormalised, `(N, 9)`."""
    x, y, z = d.unbind(-1)
    degree_2 = (x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y)
    return torch.stack([torch.ones_like(x), y, z, x, *degree_2], -1)


class InstantField(nn.Module):
    """Hash encoding, a density network with geometry features, and a colour network."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = HashEncoder()
        self.sigma_net = nn.Sequential(nn.Linear(8, 16), nn.ReLU(), nn.Linear(16, 8))
        self.color_net = nn.Sequential(nn.Linear(7 + 9, 16), nn.ReLU(), nn.Linear(16, 3))

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.sigma_net(self.encoder((x + 1) / 2))
        colour = self.color_net(torch.cat([hidden[:, 1:], spherical_harmonics(d)], -1))
        return torch.exp(hidden[:, 0]), torch.sigmoid(colour)
