"""Somebody else's dense voxel grid with a small colour network (DVGO, Sun et al. 2022; Plenoxels)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class DenseGrid(nn.Module):
    """A grid `[1, C, X, Y, Z]` with trilinear lookup at positions in [-1, 1]^3."""

    def __init__(self, channels: int, resolution: tuple[int, int, int]) -> None:
        super().__init__()
        self.grid = nn.Parameter(0.5 * torch.randn(1, channels, *resolution))

    def forward(self, x: Tensor) -> Tensor:
        found = F.grid_sample(self.grid, x.flip(-1).view(1, -1, 1, 1, 3), mode="bilinear", align_corners=True)
        return found.view(self.grid.shape[1], -1).T

    def scale_volume_grid(self, resolution: tuple[int, int, int]) -> None:
        self.grid = nn.Parameter(
            F.interpolate(self.grid.data, size=resolution, mode="trilinear", align_corners=True)
        )


class DirectVoxelField(nn.Module):
    """Post-activated density grid, feature grid, and a network on features and encoded direction."""

    def __init__(self, resolution: tuple[int, int, int] = (5, 6, 7), features: int = 12) -> None:
        super().__init__()
        self.density = DenseGrid(1, resolution)
        self.k0 = DenseGrid(features, resolution)
        self.register_buffer("viewfreq", 2.0 ** torch.arange(2))
        self.rgbnet = nn.Sequential(nn.Linear(features + 15, 16), nn.ReLU(), nn.Linear(16, 3))

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        density = F.softplus(self.density(x).squeeze(-1))
        angles = (d[:, :, None] * self.viewfreq).flatten(-2)
        view = torch.cat([d, angles.sin(), angles.cos()], -1)
        return density, torch.sigmoid(self.rgbnet(torch.cat([self.k0(x), view], -1)))

    def grow(self, resolution: tuple[int, int, int] = (8, 9, 10)) -> None:
        self.density.scale_volume_grid(resolution)
        self.k0.scale_volume_grid(resolution)
