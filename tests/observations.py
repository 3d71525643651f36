"""What the contract suite looks at: sites of a design, outputs of a step, the anatomy of a field."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach._resolve import find
from gridreg.attach.sites import SiteLike
from gridreg.base import Clock, Context, Regularizer, overrides
from tests.fields import Design, made, points

STEPS = 20
READS_GRIDS = ("grid_penalty", "local_terms", "parameter_groups", "update_groups")


def sites_for(cls: type[Regularizer], design: Design) -> tuple[SiteLike, ...]:
    """Sites of a design that make sense for a class of regularizers."""
    if any(overrides(cls, part) for part in READS_GRIDS) or cls.acts_on == "grids":
        return (design.grid_site,)
    return design.mask_sites if overrides(cls, "transform") else design.mask_sites[:1]


def examples_on(cls: type[Regularizer], design: Design) -> list[Regularizer]:
    """Every example of a class, and every site of a design at least once: the examples take turns."""
    sites = sites_for(cls, design)
    at_site = [cls.examples(site) for site in sites]
    count = max(len(sites), len(at_site[0])) if at_site[0] else 0
    return [at_site[i % len(sites)][i % len(at_site[0])] for i in range(count)]


def samples_of(field: nn.Module) -> gridreg.RaySamples:
    """Eight rays with six samples each, with everything that a renderer can fill in."""
    x, d = points(48)
    density, colours = field(x, d)
    t = torch.linspace(0.2, 2.0, 6)
    return gridreg.RaySamples.from_dense(
        t,
        torch.full((6,), 0.36),
        density.view(8, 6),
        positions=x.view(8, 6, 3),
        colours=colours.view(8, 6, 3),
        directions=d[:8],
        background=torch.ones(8, 3),
        patch=(2, 2, 2),
        target_opacity=torch.linspace(0, 1, 8),
    )


def observed(field: nn.Module, handle: gridreg.Handle) -> list[Tensor]:
    """All that a training step sees of a field and its handle."""
    samples = handle.on_samples(samples_of(field))
    background = handle.background(4, torch.Generator().manual_seed(3), torch.ones(4, 3))
    near, far = handle.near_far(torch.full((4,), 2.0), torch.full((4,), 6.0))
    assert background is not None
    assert samples.colours is not None
    seen = [samples.density, samples.weights, samples.colours, handle.loss(samples), background, near, far]
    return [tensor.detach().clone() for tensor in seen]


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    """Bit for bit."""
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def anatomy(field: nn.Module) -> list[Any]:
    """Everything about a field's modules that attaching could leave traces in, by identity."""
    return [
        (
            module,
            type(module),
            [(key, id(value)) for key, value in module.__dict__.items()],
            [(key, list(hooks)) for key, hooks in module.__dict__.items() if isinstance(hooks, dict)],
            [(key, id(value)) for key, value in module._parameters.items()],
        )
        for module in field.modules()
    ]


def contexts(regularizer: Regularizer, name: str, step: int) -> Iterator[Context]:
    """Prepared contexts of a transform at the tensors of its site."""
    field = made(name)
    for site in regularizer.sites():
        for match in find(field, site, type(regularizer).acts_on):
            if match.place.size is None:
                match.place.complete(len(match.place.octaves or range(12)))
            clock = Clock(STEPS, seed=5)
            clock.step = step
            context = Context(clock, match.place)
            regularizer.prepare(context)
            yield context


def tensor_for(context: Context, seed: int = 0) -> Tensor:
    """A small random tensor, float64, with the axes of a context's place."""
    place = context.place
    assert place is not None
    assert place.size is not None
    count = max(
        [abs(place.dim) if place.dim < 0 else place.dim + 1, *(axis + 1 for axis in place.spatial), 2]
    )
    shape = [2] * count
    shape[place.dim] = place.size
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)
