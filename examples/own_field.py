"""A voxel field of one's own, with and without gridreg: one call of `apply`, four photographs, half a minute.

Run it with `python examples/own_field.py`. It writes `own_field.png`: two views that were not trained on, from
left to right the truth, the bare field, and the same field with regularizers.
"""

from __future__ import annotations

import argparse

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import gridreg

SIZE, NEAR, FAR, SAMPLES = 48, 1.5, 4.5, 60


class VoxelField(nn.Module):
    """Density and colour features on a voxel grid over [-1, 1]^3. It has never heard of gridreg."""

    def __init__(self, edge: int = 40, features: int = 12) -> None:
        super().__init__()
        self.density = nn.Parameter(torch.full((1, 1, edge, edge, edge), -3.0))
        self.features = nn.Parameter(0.1 * torch.randn(1, features, edge, edge, edge))
        self.decoder = nn.Sequential(nn.Linear(features, 24), nn.ReLU(), nn.Linear(24, 3))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Positions `(N, 3)` to density `(N,)`, 0 outside the box, and colour `(N, 3)`."""
        at = x.flip(-1).view(1, -1, 1, 1, 3)
        density = F.softplus(F.grid_sample(self.density, at, align_corners=True)).view(-1)
        features = F.grid_sample(self.features, at, align_corners=True).view(self.features.shape[1], -1).T
        return 10 * density * (x.abs() < 1).all(-1), torch.sigmoid(self.decoder(features))


def regularizers() -> list[gridreg.Regularizer]:
    """What this page is about: everything that few photographs need, attached from the outside."""
    density, features = gridreg.parameters("density", dim=1), gridreg.parameters("features", dim=1)
    return [
        gridreg.FrequencyMask(features, until=0.5),
        gridreg.FourierLowPass(density, gridreg.Linear(0.2, 1.0, until=0.5), boundary="mirror"),
        gridreg.TotalVariation(density, weight=3e-4),
        gridreg.TotalVariation(features, weight=0.01),
        gridreg.OcclusionLoss(weight=0.1, distance=0.6),
    ]


def rays(azimuth: float, elevation: float) -> tuple[Tensor, Tensor]:
    """Origins and unit directions `(SIZE^2, 3)` of a camera at distance 3 that looks at the origin."""
    a, e = np.radians(azimuth), np.radians(elevation)
    back = torch.tensor([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], dtype=torch.float32)
    right = F.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
    y, x = torch.meshgrid(*2 * [(torch.arange(SIZE) + 0.5) / SIZE - 0.5], indexing="ij")
    directions = x[..., None] * right - y[..., None] * torch.linalg.cross(back, right) - back
    return 3 * back.expand(SIZE * SIZE, 3), F.normalize(directions.view(-1, 3), dim=-1)


def truth(origins: Tensor, directions: Tensor) -> Tensor:
    """Four shaded and striped balls on white, intersected exactly: `(N, 3)`."""
    colour, nearest = torch.ones_like(origins), torch.full((len(origins),), torch.inf)
    for x, y, z, radius, *paint in (
        (0.0, 0.0, 0.0, 0.45, 0.9, 0.25, 0.2),
        (0.5, 0.4, 0.1, 0.25, 0.2, 0.6, 0.3),
        (-0.5, 0.35, -0.2, 0.3, 0.2, 0.35, 0.85),
        (0.1, -0.55, 0.35, 0.2, 0.95, 0.75, 0.2),
    ):
        towards = origins - torch.tensor([x, y, z])
        b = (towards * directions).sum(-1)
        inside = b.square() - towards.square().sum(-1) + radius**2
        t = -b - inside.clamp(min=0).sqrt()
        normal = (towards + t[:, None] * directions) / radius
        light = 0.55 + 0.45 * (normal @ F.normalize(torch.tensor([0.3, 0.5, 0.8]), dim=0))
        stripes = 0.75 + 0.25 * torch.sign(torch.sin(14 * normal[:, 2]))
        hit = (inside > 0) & (t < nearest)
        nearest = torch.where(hit, t, nearest)
        colour = torch.where(hit[:, None], torch.tensor(paint) * (light * stripes)[:, None], colour)
    return colour


def render(
    field: nn.Module, origins: Tensor, directions: Tensor, jitter: float | Tensor = 0.5
) -> tuple[Tensor, gridreg.RaySamples]:
    """Colours `(N, 3)` on white, and the samples for the penalties."""
    step = (FAR - NEAR) / SAMPLES
    t = NEAR + (torch.arange(SAMPLES) + jitter) * step * torch.ones(len(origins), 1)
    density, colour = field((origins[:, None] + t[..., None] * directions[:, None]).view(-1, 3))
    samples = gridreg.RaySamples.from_dense(t, torch.full_like(t, step), density.view_as(t))
    weights = samples.weights.view_as(t)
    return (weights[..., None] * colour.view(*t.shape, 3)).sum(1) + 1 - weights.sum(1, keepdim=True), samples


def train(composition: list[gridreg.Regularizer], steps: int, seed: int) -> VoxelField:
    """A field trained on four photographs, with a composition attached while it learns."""
    torch.manual_seed(seed)
    field = VoxelField()
    views = [rays(90 * i, 20 + 20 * (i % 2)) for i in range(4)]
    origins, directions = (torch.cat(parts) for parts in zip(*views, strict=True))
    target = truth(origins, directions)
    grids = {"params": [field.density, field.features], "lr": 0.1}
    optimizer = torch.optim.Adam([grids, {"params": field.decoder.parameters(), "lr": 0.003}])
    with gridreg.apply(field, *composition, total_steps=steps) as handle:
        for step in range(steps):
            handle.step(step)
            chosen = torch.randint(len(origins), (384,))
            colour, samples = render(field, origins[chosen], directions[chosen], torch.rand(384, 1))
            loss = (colour - target[chosen]).square().mean() + handle.loss(samples)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(handle)
    return field


@torch.no_grad()
def main() -> None:
    """Train twice, compare on views between those of the training, write the image."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="own_field.png")
    options = parser.parse_args()
    with torch.enable_grad():
        fields = [train(composition, options.steps, options.seed) for composition in ([], regularizers())]
    views = [rays(azimuth, 30) for azimuth in (45, 135, 225, 315)]
    columns = [
        [truth(*view) for view in views],
        *([render(field, *view)[0] for view in views] for field in fields),
    ]
    for name, column in zip(("bare", "with gridreg"), columns[1:], strict=True):
        errors = [(a - b).square().mean() for a, b in zip(column, columns[0], strict=True)]
        print(
            f"{name}: {-10 * torch.stack(errors).log10().mean():.2f} dB on {len(views)} views not trained on"
        )
    rows = [torch.cat([column[i].view(SIZE, SIZE, 3) for column in columns], 1) for i in (0, 2)]
    image = (255 * torch.cat(rows).clamp(0, 1)).byte().numpy().repeat(4, 0).repeat(4, 1)
    imageio.imwrite(options.out, image)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
