"""Five designs that know nothing of gridreg, and how a user attaches to each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach.sites import SiteLike
from tests.fields.coordinate_mlp import NerfMLP
from tests.fields.hash_grid import InstantField
from tests.fields.kplanes import KPlanesField
from tests.fields.tensorf import TensorField
from tests.fields.voxel import DirectVoxelField


def attach_voxel(field: DirectVoxelField) -> gridreg.Handle:
    octaves = gridreg.octaves_of_channels(3, 2, "coordinate")
    return gridreg.apply(
        field,
        gridreg.FrequencyMask(gridreg.parameters("k0.grid", dim=1), until=0.9),
        gridreg.FrequencyMask(gridreg.inputs("rgbnet.0", channels=slice(12, 27), octaves=octaves)),
        total_steps=100,
    )


def attach_hash(field: InstantField) -> gridreg.Handle:
    return gridreg.apply(
        field,
        gridreg.LevelMask(gridreg.outputs("encoder"), start=2, every=20),
        gridreg.ViewDependenceMask(gridreg.inputs("color_net.0", channels=slice(7, 16)), bands=2),
        total_steps=100,
    )


def attach_kplanes(field: KPlanesField) -> gridreg.Handle:
    return gridreg.apply(
        field,
        gridreg.FrequencyMask(gridreg.parameters("grids.*.*", dim=1), until=0.9),
        gridreg.ViewDependenceMask(gridreg.inputs("color_net.0", channels=slice(7, 10)), bands=0),
        total_steps=100,
    )


def attach_tensorf(field: TensorField) -> gridreg.Handle:
    octaves = [-1] * 9 + [0, 1] * 18
    return gridreg.apply(
        field,
        gridreg.FrequencyMask(gridreg.parameters("density_line.*", dim=1), until=0.9),
        gridreg.FrequencyMask(gridreg.parameters("app_line.*", dim=1), until=0.9),
        gridreg.CosineMask(gridreg.inputs("mlp.0", octaves=octaves), until=0.9),
        total_steps=100,
    )


def attach_mlp(field: NerfMLP) -> gridreg.Handle:
    position = gridreg.octaves_of_channels(3, 6, "sines_first")
    direction = gridreg.octaves_of_channels(3, 2, "sines_first")
    return gridreg.apply(
        field,
        gridreg.FrequencyMask(gridreg.inputs("trunk.0", octaves=position), until=0.9),
        gridreg.FrequencyMask(gridreg.inputs("trunk.2", channels=slice(24, 63), octaves=position)),
        gridreg.FrequencyMask(gridreg.inputs("views", channels=slice(24, 39), octaves=direction)),
        total_steps=100,
    )


@dataclass(frozen=True)
class Design:
    """A foreign field: its class, a user's lines, sites for every kind of regularizer, and how it grows."""

    make: Callable[[], nn.Module]
    attach: Callable[[nn.Module], gridreg.Handle]
    mask_sites: tuple[SiteLike, ...]
    grid_site: SiteLike
    grow: Callable[[nn.Module], None] | None = None


DESIGNS: dict[str, Design] = {
    "voxel": Design(
        DirectVoxelField,
        attach_voxel,
        (gridreg.parameters("k0.grid", dim=1), gridreg.outputs("k0")),
        gridreg.parameters("*.grid", dim=1, spatial=(2, 3, 4)),
        DirectVoxelField.grow,
    ),
    "hash": Design(
        InstantField,
        attach_hash,
        (
            gridreg.outputs("encoder", octaves=[0, 0, 1, 1, 2, 2, 3, 3]),
            gridreg.inputs("sigma_net.0"),
        ),
        gridreg.parameters("encoder.levels.*.weight", dim=1),
    ),
    "kplanes": Design(
        KPlanesField,
        attach_kplanes,
        (gridreg.parameters("grids.*.*", dim=1), gridreg.inputs("sigma_net.0", channels=slice(2, 14))),
        gridreg.parameters("grids.*.*", dim=1),
    ),
    "tensorf": Design(
        TensorField,
        attach_tensorf,
        (gridreg.parameters("app_line.*", dim=1), gridreg.inputs("mlp.0", octaves=[-1] * 9 + [0, 1] * 18)),
        gridreg.parameters("density_*.*", dim=1),
        TensorField.upsample_volume_grid,
    ),
    "mlp": Design(
        NerfMLP,
        attach_mlp,
        (gridreg.inputs("trunk.0", octaves=gridreg.octaves_of_channels(3, 6, "sines_first")),),
        gridreg.parameters("trunk.*.weight", dim=0),
    ),
}


def made(name: str) -> nn.Module:
    """A design with the same random values each time."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return DESIGNS[name].make()


def points(count: int = 24, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions in [-1, 1]^3 and unit directions."""
    generator = torch.Generator().manual_seed(seed)
    x = 1.9 * torch.rand(count, 3, generator=generator) - 0.95
    d = torch.randn(count, 3, generator=generator)
    return x, d / d.norm(dim=-1, keepdim=True)
