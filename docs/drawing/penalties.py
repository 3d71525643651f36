"""Diagrams of penalties: their values over the one thing that each of them is about."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import gridreg
from drawing.svg import Panel
from gridreg.samples import RaySamples


def values(function: Callable[[float], Tensor], places: np.ndarray) -> list[float]:
    """A penalty at each place."""
    return [float(function(float(place))) for place in places]


def samples(density: list[list[float]], delta: float = 1.0, **more: object) -> RaySamples:
    """Rays of equal steps."""
    sigma = torch.tensor(density, dtype=torch.float64)
    t = (torch.arange(sigma.shape[1], dtype=torch.float64) + 0.5) * delta
    return RaySamples.from_dense(t, torch.full_like(t, delta), sigma, **more)  # type: ignore[arg-type]


def occlusion() -> str:
    """A floater, a wall, and which part of the ray the loss looks at."""
    t = np.arange(64) * 0.05 + 2.0
    sigma = 14 * np.exp(-(((t - 2.45) / 0.1) ** 2)) + 30 / (1 + np.exp(-(t - 4.1) / 0.03)) * (t < 4.7)
    density = torch.tensor(sigma[None], requires_grad=True)
    gridreg.occlusion_loss(
        RaySamples.from_dense(torch.from_numpy(t), torch.full((64,), 0.05), density), 20
    ).backward()
    counted = density.grad[0].numpy() > 0 if density.grad is not None else np.zeros(64, bool)
    panel = Panel(
        "OcclusionLoss(samples=20) on one ray",
        x=(2, 5.2), y=(0, 36), x_label="distance along the ray, world units", y_label="density",
        x_ticks=(2, 3, 4, 5), y_ticks=(0, 10, 20, 30),
    )  # fmt: skip
    inside = t[counted]
    panel.area(inside, np.zeros(len(inside)), np.full(len(inside), 36.0), 2)
    panel.line(t, sigma)
    panel.note(float(inside[0]) + 0.06, 32.5, "first 20 steps", 2)
    panel.note(2.52, 14.5, "penalised", 1)
    panel.note(3.5, 27, "left alone", 1)
    return panel.svg()


def cauchy() -> str:
    """Draw the part of one sample."""
    density = np.linspace(0, 6, 121)
    panel = Panel(
        "CauchySparsity of one sample",
        x=(0, 6), y=(0, 6), x_label="density per world unit", x_ticks=(0, 2, 4, 6), y_ticks=(0, 2, 4, 6),
    )  # fmt: skip
    panel.line(density, values(lambda d: gridreg.cauchy_sparsity(samples([[d]])), density))
    few = density[density <= 1.73]
    panel.line(few, 2 * few**2, 2, dashed=True)
    panel.note(3.1, 2.55, "log(1 + 2 density²)", 1)
    panel.note(1.85, 5.5, "2 density²", 2)
    return panel.svg()


def opacity() -> str:
    """Entropy of a ray's opacity."""
    fraction = np.linspace(0.001, 0.999, 121)
    panel = Panel(
        "OpacityEntropy of one ray",
        x=(0, 1), y=(0, 0.75), x_label="opacity", y_label="nats", x_ticks=(0, 0.5, 1), y_ticks=(0, 0.35, 0.7),
    )  # fmt: skip
    entropy = values(lambda o: gridreg.opacity_entropy(samples([[-math.log1p(-o)]])), fraction)
    panel.line(fraction, entropy)
    return panel.svg()


def spread_out() -> str:
    """Entropy of where the matter of a ray is."""
    fraction = np.linspace(0.002, 0.998, 121)

    def two(first: float) -> Tensor:
        alphas = (0.9 * first, 0.9 * (1 - first))
        return gridreg.ray_entropy(samples([[-math.log1p(-alpha) for alpha in alphas]]))

    panel = Panel(
        "RayEntropy of two lumps on a ray",
        x=(0, 1), y=(0, 0.75), x_label="fraction of the first lump", y_label="nats",
        x_ticks=(0, 0.5, 1), y_ticks=(0, 0.35, 0.7),
    )  # fmt: skip
    panel.line(fraction, values(two, fraction))
    return panel.svg()


def distortion() -> str:
    """Two lumps of weight 1/2, some way apart."""
    apart = np.linspace(0, 2, 81)

    def two(distance: float) -> Tensor:
        t = torch.tensor([[1.0, 1.0 + distance]], dtype=torch.float64)
        half = torch.full_like(t, 0.5)
        return gridreg.distortion(RaySamples.from_dense(t, 0 * t + 0.1, half, half))

    panel = Panel(
        "DistortionLoss of two lumps on a ray",
        x=(0, 2), y=(0, 1.1), x_label="distance between them, world units", x_ticks=(0, 0.5, 1, 1.5, 2),
        y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    panel.line(apart, values(two, apart))
    panel.note(0.12, 0.93, "each of weight 1/2 and length 0.1", 1)
    return panel.svg()


def neighbours() -> tuple[str, str]:
    """A wall that is nearer on one ray of a patch than on the others."""
    jump = np.linspace(0, 1, 61)

    def depth(step: float) -> Tensor:
        t = torch.tensor([[2.0], [2.0], [2.0], [2.0]], dtype=torch.float64)
        t[0] += step
        return gridreg.depth_smoothness(
            RaySamples.from_dense(
                t, torch.ones(1, dtype=torch.float64), torch.full_like(t, 1e3), patch=(1, 2, 2)
            )
        )

    first = Panel(
        "DepthSmoothness of a patch of 2x2 rays",
        x=(0, 1), y=(0, 2.1), x_label="one ray is deeper by, world units", x_ticks=(0, 0.5, 1), y_ticks=(0, 1, 2),
    )  # fmt: skip
    first.line(jump, values(depth, jump))

    shift, index = np.linspace(0, 6, 61), np.arange(32)

    def bump(centre: float) -> list[float]:
        return [0.3 * math.exp(-(((i - centre) / 3) ** 2)) + 1e-3 for i in index]

    second = Panel(
        "RayKL of two neighbouring rays",
        x=(0, 6), y=(0, 4), x_label="shift between them, steps", y_label="nats", x_ticks=(0, 2, 4, 6),
        y_ticks=(0, 2, 4),
    )  # fmt: skip
    second.line(
        shift, values(lambda s: gridreg.ray_kl(samples([bump(12), bump(12 + s)], patch=(1, 1, 2))), shift)
    )
    return first.svg(), second.svg()


def one_value() -> str:
    """TV of a step, L1 of a value."""
    size = np.linspace(-1.5, 1.5, 121)
    panel = Panel(
        "TotalVariation and L1 of a single number",
        x=(-1.5, 1.5), y=(0, 2.3), x_label="difference of neighbours (TV), value (L1)", x_ticks=(-1, 0, 1),
        y_ticks=(0, 1, 2),
    )  # fmt: skip
    panel.line(size, values(lambda d: gridreg.total_variation(torch.tensor([0.0, d]), (0,)), size))
    panel.line(size, values(lambda v: gridreg.l1(torch.tensor([v])), size), 2)
    panel.note(-1.2, 2.05, "TotalVariation", 1)
    panel.note(0.45, 0.65, "L1", 2, "end")
    return panel.svg()


def same_rise() -> str:
    """Three lines that rise by 1, and what each costs."""
    nodes = 33
    x = torch.linspace(0, 1, nodes)
    wave = 0.1 * torch.sin(16 * math.pi * x)
    shown = (("ramp", x), ("ramp and ripple", x + wave), ("step", (x > 0.5).float()))
    panel = Panel(
        f"TotalVariation of lines of {nodes} nodes", x=(0, 1), y=(-0.25, 2.5), x_label="place", x_ticks=(0, 0.5, 1),
        y_ticks=(0, 1),
    )  # fmt: skip
    for series, (name, line) in enumerate(shown, start=1):
        cost = float(gridreg.total_variation(line, (0,)))
        panel.line(x, line, series)
        panel.note(0.04, 2.5 - 0.3 * series, f"{name}: {cost:.4f}", series)
    return panel.svg()


def angle() -> str:
    """Two channels of unit length at an angle."""
    degrees = np.linspace(0, 180, 121)

    def two(turn: float) -> Tensor:
        a = math.radians(turn)
        return gridreg.orthogonality(
            torch.tensor([[1.0, 0.0], [math.cos(a), math.sin(a)]], dtype=torch.float64)
        )

    panel = Panel(
        "Orthogonality of two channels of length 1",
        x=(0, 180), y=(0, 1.1), x_label="angle between them, degrees", x_ticks=(0, 45, 90, 135, 180),
        y_ticks=(0, 0.5, 1),
    )  # fmt: skip
    panel.line(degrees, values(two, degrees))
    return panel.svg()


def diagrams() -> dict[str, str]:
    """SVG text by name."""
    smooth, divergence = neighbours()
    return {
        "penalty-occlusion": occlusion(),
        "penalty-cauchy": cauchy(),
        "penalty-opacity": opacity(),
        "penalty-entropy": spread_out(),
        "penalty-distortion": distortion(),
        "penalty-depth": smooth,
        "penalty-kl": divergence,
        "penalty-values": one_value(),
        "penalty-tv": same_rise(),
        "penalty-orthogonality": angle(),
    }
