"""Somebody else's tri-plane field at several scales (K-Planes, Fridovich-Keil et al. 2023, static scenes)."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class KPlanesField(nn.Module):
    """Features multiply over the planes of a scale and concatenate over scales; two small decoders."""

    def __init__(self, scales: tuple[int, ...] = (6, 12), features: int = 8) -> None:
        super().__init__()
        self.grids = nn.ModuleList(
            nn.ParameterList(nn.Parameter(torch.rand(1, features, edge, edge + 1) + 0.1) for _ in range(3))
            for edge in scales
        )
        self.sigma_net = nn.Sequential(nn.Linear(features * len(scales), 16), nn.ReLU(), nn.Linear(16, 8))
        self.color_net = nn.Sequential(nn.Linear(7 + 3, 16), nn.ReLU(), nn.Linear(16, 3))

    def interpolate(self, x: Tensor) -> Tensor:
        scales = []
        for planes in self.grids:
            value: Tensor | float = 1.0
            for plane, axes in zip(planes, combinations(range(3), 2), strict=True):
                found = F.grid_sample(plane, x[:, list(axes)].view(1, -1, 1, 2), align_corners=True)
                value = value * found.view(plane.shape[1], -1).T
            scales.append(value)
        return torch.cat(scales, -1)

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.sigma_net(self.interpolate(x))
        colour = self.color_net(torch.cat([hidden[:, 1:], d], -1))
        return torch.exp(hidden[:, 0]), torch.sigmoid(colour)
