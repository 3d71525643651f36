"""Diagrams of penalties: their values over the one thing that each of them is about."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import gridreg
from drawing.svg import Line, Note
from gridreg.samples import RaySamples


def line(function: Callable[[float], Tensor], places: np.ndarray, series: int = 1) -> Line:
    """A penalty at each place."""
    return Line(places, [float(function(float(place))) for place in places], series)


def samples(density: list[list[float]], delta: float = 1.0, **more: object) -> RaySamples:
    """Rays of equal steps."""
    sigma = torch.tensor(density, dtype=torch.float64)
    t = (torch.arange(sigma.shape[1], dtype=torch.float64) + 0.5) * delta
    return RaySamples.from_dense(t, torch.full_like(t, delta), sigma, **more)  # type: ignore[arg-type]


def occlusion() -> list[Line]:
    """A floater, a wall, and which part of the ray the loss looks at."""
    t = np.arange(64) * 0.05 + 2.0
    sigma = 14 * np.exp(-(((t - 2.45) / 0.1) ** 2)) + 30 / (1 + np.exp(-(t - 4.1) / 0.03)) * (t < 4.7)
    density = torch.tensor(sigma[None], requires_grad=True)
    rays = RaySamples.from_dense(torch.from_numpy(t), torch.full((64,), 0.05), density)
    (gradient,) = torch.autograd.grad(gridreg.occlusion_loss(rays, 20), density)
    inside = t[gradient[0].numpy() > 0]
    return [Line(inside, np.full(len(inside), 36.0), 2, low=np.zeros(len(inside))), Line(t, sigma)]


def two_lumps(first: float) -> Tensor:
    """Entropy of a ray on which a fraction of the matter is in the first of two lumps."""
    alphas = (0.9 * first, 0.9 * (1 - first))
    return gridreg.ray_entropy(samples([[-math.log1p(-alpha) for alpha in alphas]]))


def two_apart(distance: float) -> Tensor:
    """Distortion of two lumps of weight 1/2, some way apart."""
    t = torch.tensor([[1.0, 1.0 + distance]], dtype=torch.float64)
    half = torch.full_like(t, 0.5)
    return gridreg.distortion(RaySamples.from_dense(t, torch.full_like(t, 0.1), half, half))


def one_deeper(step: float) -> Tensor:
    """Smoothness of depth where a wall is nearer on one ray of a patch than on the others."""
    t = torch.full((4, 1), 2.0, dtype=torch.float64)
    t[0] += step
    rays = RaySamples.from_dense(t, torch.ones_like(t), torch.full_like(t, 1e3), patch=(1, 2, 2))
    return gridreg.depth_smoothness(rays)


def shifted(distance: float) -> Tensor:
    """Divergence of two rays with the same bump of density, so many steps apart."""
    bumps = [[0.3 * math.exp(-(((i - c) / 3) ** 2)) + 1e-3 for i in range(32)] for c in (12, 12 + distance)]
    return gridreg.ray_kl(samples(bumps, patch=(1, 1, 2)))


def at_angle(degrees: float) -> Tensor:
    """Orthogonality of two channels of unit length at an angle."""
    a = math.radians(degrees)
    return gridreg.orthogonality(torch.tensor([[1.0, 0.0], [math.cos(a), math.sin(a)]], dtype=torch.float64))


def same_rise() -> list[Line | Note]:
    """Three lines that rise by 1, and what each costs."""
    x = torch.linspace(0, 1, 33)
    wave = 0.1 * torch.sin(16 * math.pi * x)
    shown: list[Line | Note] = []
    for series, (name, y) in enumerate(
        (("ramp", x), ("ramp and ripple", x + wave), ("step", (x > 0.5).float())), start=1
    ):
        cost = float(gridreg.total_variation(y, (0,)))
        shown += [Line(x, y, series), Note(0.04, 2.5 - 0.3 * series, f"{name}: {cost:.4f}", series)]
    return shown


def diagrams() -> dict[str, list[Line] | list[Line | Note]]:
    """What each diagram shows."""
    density, size = np.linspace(0, 6, 121), np.linspace(-1.5, 1.5, 121)
    few = density[density <= 1.73]
    return {
        "penalty-occlusion": occlusion(),
        "penalty-cauchy": [
            line(lambda d: gridreg.cauchy_sparsity(samples([[d]])), density),
            Line(few, 2 * few**2, 2, dashed=True),
        ],
        "penalty-opacity": [
            line(
                lambda o: gridreg.opacity_entropy(samples([[-math.log1p(-o)]])),
                np.linspace(0.001, 0.999, 121),
            )
        ],
        "penalty-entropy": [line(two_lumps, np.linspace(0.002, 0.998, 121))],
        "penalty-distortion": [line(two_apart, np.linspace(0, 2, 81))],
        "penalty-depth": [line(one_deeper, np.linspace(0, 1, 61))],
        "penalty-kl": [line(shifted, np.linspace(0, 6, 61))],
        "penalty-values": [
            line(lambda d: gridreg.total_variation(torch.tensor([0.0, d]), (0,)), size),
            line(lambda v: gridreg.l1(torch.tensor([v])), size, 2),
        ],
        "penalty-tv": same_rise(),
        "penalty-orthogonality": [line(at_angle, np.linspace(0, 180, 121))],
    }
