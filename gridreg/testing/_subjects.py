"""Fields that laws are tried on, and all that can be observed of a field and its handle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gridreg.attach._binding import READS_GRIDS
from gridreg.attach._resolve import find
from gridreg.attach.handle import Handle
from gridreg.attach.selectors import inputs, outputs, parameters
from gridreg.attach.sites import SiteLike
from gridreg.base import Clock, Context, Regularizer, overrides
from gridreg.encodings import PositionalEncoding, octaves_of_channels
from gridreg.samples import RaySamples

STEPS = 20
"""Length of the runs that laws are tried in, iterations."""


def expect(truth: object, text: str) -> None:
    """An assertion that `python -O` keeps."""
    if not truth:
        raise AssertionError(text)


@dataclass(frozen=True)
class Subject:
    """A field to try regularizers on.

    Attributes:
        make: returns a new field; `field(x, d)` takes positions and directions `(N, 3)` and returns density
            `(N,)` and colours `(N, 3)`.
        mask_sites: sites for masks and other transforms of features.
        grid_site: a site whose raw parameters low-passes and grid penalties take.
    """

    make: Callable[[], nn.Module]
    mask_sites: tuple[SiteLike, ...]
    grid_site: SiteLike

    def made(self) -> nn.Module:
        """A new field with the same random values each time."""
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return self.make()


class _Lines(nn.Module):
    """Products of three lines (CP-TensoRF), an encoding that is a module, and a small network."""

    def __init__(self) -> None:
        super().__init__()
        self.line = nn.ParameterList(torch.randn(1, 7, 6, 1) for _ in range(3))
        self.encoding = PositionalEncoding(3, 2, "coordinate")
        self.mlp = nn.Sequential(nn.Linear(22, 8), nn.ReLU(), nn.Linear(8, 4))

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Density `(N,)` and colours `(N, 3)`."""
        places = torch.stack([torch.zeros_like(x), x], dim=-1).view(-1, 1, 3, 2).unbind(2)
        on_lines = [
            F.grid_sample(v, p[None], align_corners=True) for v, p in zip(self.line, places, strict=True)
        ]
        out = self.mlp(torch.cat([torch.stack(on_lines).prod(dim=0)[0, :, :, 0].T, self.encoding(d)], dim=-1))
        return F.softplus(out[:, 0]), out[:, 1:].sigmoid()


_ENCODED = inputs("mlp.0", channels=slice(7, 22), octaves=octaves_of_channels(3, 2, "coordinate"))
BUILT_IN = Subject(
    _Lines, (parameters("line.*", dim=1), outputs("encoding"), _ENCODED), parameters("line.*", dim=1)
)


def examples_on(cls: type[Regularizer], subject: Subject) -> list[Regularizer]:
    """Every example of a class, and every fitting site of a subject at least once: the examples take turns."""
    if any(overrides(cls, part) for part in READS_GRIDS) or cls.acts_on == "grids":
        sites: tuple[SiteLike, ...] = (subject.grid_site,)
    else:
        sites = subject.mask_sites if overrides(cls, Regularizer.transform) else subject.mask_sites[:1]
    at_site = [cls.examples(site) for site in sites]
    count = max(len(sites), len(at_site[0])) if at_site[0] else 0
    return [at_site[i % len(sites)][i % len(at_site[0])] for i in range(count)]


def points(count: int = 24, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions in [-1, 1]^3 and unit directions, each `(count, 3)`."""
    generator = torch.Generator().manual_seed(seed)
    x = 1.9 * torch.rand(count, 3, generator=generator) - 0.95
    d = torch.randn(count, 3, generator=generator)
    return x, d / d.norm(dim=-1, keepdim=True)


def seen(field: nn.Module) -> list[Tensor]:
    """Outputs of a field at 24 points."""
    return list(field(*points()))


def samples_of(field: nn.Module) -> RaySamples:
    """Eight rays with six samples each, with everything that a renderer can fill in."""
    x, d = points(48)
    density, colours = field(x, d)
    return rays_of(density.view(8, 6), x.view(8, 6, 3), colours.view(8, 6, 3), d[:8])


def rays_of(
    density: Tensor, positions: Tensor, colours: Tensor, directions: Tensor, final: Tensor | None = None
) -> RaySamples:
    """Samples of densities `(8, 6)`; those of a proposal are given a density, and the final ones `final`, if any."""
    dtype = density.dtype
    t, delta = torch.linspace(0.2, 2.0, 6, dtype=dtype), torch.full((6,), 0.36, dtype=dtype)
    return RaySamples.from_dense(
        t,
        delta,
        density if final is None else final,
        positions=positions,
        colours=colours,
        gradients=density[..., None] * positions,
        directions=directions,
        background=torch.ones(8, 3, dtype=dtype),
        patch=(2, 2, 2),
        target_opacity=torch.linspace(0, 1, 8, dtype=dtype),
        target_depth=directions[:, 0],
        images=torch.arange(8) % 2,
        proposals=(RaySamples.from_dense(t + 0.1, delta, density.roll(1, 1)),),
    )


def observed(field: nn.Module, handle: Handle) -> list[Tensor]:
    """All that a training step sees of a field and its handle."""
    samples = handle.on_samples(samples_of(field))
    background = handle.background(4, torch.Generator().manual_seed(3), torch.ones(4, 3))
    near, far = handle.near_far(torch.full((4,), 2.0), torch.full((4,), 6.0))
    found = [samples.density, samples.weights, samples.colours, handle.loss(samples), background, near, far]
    return [tensor.detach().clone() for tensor in found if tensor is not None]


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    """Whether two lists of tensors are equal bit for bit."""
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


def contexts(regularizer: Regularizer, subject: Subject, step: int) -> Iterator[Context]:
    """Prepared contexts of a transform at the tensors of its site."""
    field = subject.made()
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
    axes = [-place.dim if place.dim < 0 else place.dim + 1, *(axis + 1 for axis in place.spatial), 2]
    shape = [2] * max(axes)
    shape[place.dim] = place.size
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)


def renew(field: nn.Module) -> None:
    """Assign an equal parameter to every name, and a new list to every list."""
    for module in list(field.modules()):
        for key, parameter in list(module._parameters.items()):
            if parameter is not None:
                setattr(module, key, nn.Parameter(parameter.detach().clone()))
    renew_lists(field)


def renew_lists(field: nn.Module) -> None:
    """Put new lists of the raw parameters in the place of every `ParameterList`."""
    for module in list(field.modules()):
        for key, child in list(module._modules.items()):
            if isinstance(child, nn.ParameterList):
                module._modules[key] = nn.ParameterList(child._parameters.values())
