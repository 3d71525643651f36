"""Somebody else's TensoRF (Chen et al. 2022): its lists of planes and lines are replaced when it grows."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MATRICES = ((0, 1), (0, 2), (1, 2))
VECTORS = (2, 1, 0)


def positional_encoding(x: Tensor, octaves: int) -> Tensor:
    """All sines, coordinate by coordinate, then all cosines."""
    angles = (x[..., None] * 2.0 ** torch.arange(octaves)).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


class TensorField(nn.Module):
    """Vector-matrix field; the network sees features, direction, and the encodings of both."""

    def __init__(self, edge: tuple[int, int, int] = (6, 7, 8), n_density: int = 9, n_app: int = 12) -> None:
        super().__init__()
        self.density_plane, self.density_line = self.init_one(n_density, edge)
        self.app_plane, self.app_line = self.init_one(n_app, edge)
        self.basis_mat = nn.Linear(3 * n_app, 6, bias=False)
        self.mlp = nn.Sequential(nn.Linear(6 + 3 + 24 + 12, 16), nn.ReLU(), nn.Linear(16, 3))

    @staticmethod
    def init_one(channels: int, edge: tuple[int, int, int]) -> tuple[nn.ParameterList, nn.ParameterList]:
        planes = [nn.Parameter(0.4 * torch.randn(1, channels, edge[b], edge[a])) for a, b in MATRICES]
        lines = [nn.Parameter(0.4 * torch.randn(1, channels, edge[axis], 1)) for axis in VECTORS]
        return nn.ParameterList(planes), nn.ParameterList(lines)

    @staticmethod
    def products(planes: nn.ParameterList, lines: nn.ParameterList, x: Tensor) -> list[Tensor]:
        found = []
        for plane, line, axes, axis in zip(planes, lines, MATRICES, VECTORS, strict=True):
            on_plane = x[:, list(axes)].view(1, -1, 1, 2)
            on_line = torch.stack([torch.zeros_like(x[:, axis]), x[:, axis]], -1).view(1, -1, 1, 2)
            factors = (
                F.grid_sample(g, p, align_corners=True) for g, p in ((plane, on_plane), (line, on_line))
            )
            first, second = (factor.view(factor.shape[1], -1) for factor in factors)
            found.append(first * second)
        return found

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        density = torch.stack(
            [p.sum(0) for p in self.products(self.density_plane, self.density_line, x)]
        ).sum(0)
        features = self.basis_mat(torch.cat(self.products(self.app_plane, self.app_line, x)).T)
        encoded = [features, d, positional_encoding(features, 2), positional_encoding(d, 2)]
        return F.softplus(density), torch.sigmoid(self.mlp(torch.cat(encoded, -1)))

    @torch.no_grad()
    def upsample_volume_grid(self, edge: tuple[int, int, int] = (9, 10, 11)) -> None:
        for name in ("density", "app"):
            planes, lines = getattr(self, f"{name}_plane"), getattr(self, f"{name}_line")
            sizes = [
                ((edge[b], edge[a]), (edge[axis], 1)) for (a, b), axis in zip(MATRICES, VECTORS, strict=True)
            ]
            grown = [
                [
                    F.interpolate(grid.data, size=size[k], mode="bilinear", align_corners=True)
                    for grid, size in zip(grids, sizes, strict=True)
                ]
                for k, grids in enumerate((planes, lines))
            ]
            setattr(self, f"{name}_plane", nn.ParameterList(map(nn.Parameter, grown[0])))
            setattr(self, f"{name}_line", nn.ParameterList(map(nn.Parameter, grown[1])))

    def get_optparam_groups(self) -> list[dict]:
        return [{"params": self.density_line, "lr": 0.02}, {"params": self.density_plane, "lr": 0.02}]
