"""Somebody else's coordinate network (NeRF, Mildenhall et al. 2020), its encodings in FreeNeRF's order."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def posenc(x: Tensor, octaves: int) -> Tensor:
    """The input, all sines octave by octave, then all cosines."""
    angles = torch.cat([x * 2**k for k in range(octaves)], -1)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


class NerfMLP(nn.Module):
    """A trunk with one skip connection, a density head, and a colour head that sees the direction."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.trunk = nn.ModuleList(
            [nn.Linear(39, width), nn.Linear(width, width), nn.Linear(width + 39, width)]
        )
        self.sigma = nn.Linear(width, 1)
        self.views = nn.Linear(width + 15, width)
        self.rgb = nn.Linear(width, 3)

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        encoded = posenc(x, 6)
        hidden = encoded
        for i, layer in enumerate(self.trunk):
            hidden = torch.cat([hidden, encoded], -1) if i == 2 else hidden
            hidden = torch.relu(layer(hidden))
        density = nn.functional.softplus(self.sigma(hidden).squeeze(-1))
        coloured = torch.relu(self.views(torch.cat([hidden, posenc(d, 2)], -1)))
        return density, torch.sigmoid(self.rgb(coloured))
