"""Five designs that know nothing of gridreg, and how a user attaches to each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

import gridreg
from gridreg.testing import Subject
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
class Design(Subject):
    """A foreign field with, besides sites for every kind of regularizer, a user's lines, and how it grows."""

    attach: Callable[[nn.Module], gridreg.Handle]
    grow: Callable[[nn.Module], None] | None = None


DESIGNS: dict[str, Design] = {
    "voxel": Design(
        DirectVoxelField,
        (gridreg.parameters("k0.grid", dim=1), gridreg.outputs("k0")),
        gridreg.parameters("*.grid", dim=1, spatial=(2, 3, 4)),
        attach_voxel,
        DirectVoxelField.grow,
    ),
    "hash": Design(
        InstantField,
        (
            gridreg.outputs("encoder", octaves=[0, 0, 1, 1, 2, 2, 3, 3]),
            gridreg.inputs("sigma_net.0"),
        ),
        gridreg.parameters("encoder.levels.*.weight", dim=1, spatial=(0,)),
        attach_hash,
    ),
    "kplanes": Design(
        KPlanesField,
        (gridreg.parameters("grids.*.*", dim=1), gridreg.inputs("sigma_net.0", channels=slice(2, 14))),
        gridreg.parameters("grids.*.*", dim=1),
        attach_kplanes,
    ),
    "tensorf": Design(
        TensorField,
        (gridreg.parameters("app_line.*", dim=1), gridreg.inputs("mlp.0", octaves=[-1] * 9 + [0, 1] * 18)),
        gridreg.parameters("density_*.*", dim=1),
        attach_tensorf,
        TensorField.upsample_volume_grid,
    ),
    "mlp": Design(
        NerfMLP,
        (gridreg.inputs("trunk.0", octaves=gridreg.octaves_of_channels(3, 6, "sines_first")),),
        gridreg.parameters("trunk.*.weight", dim=0),
        attach_mlp,
    ),
}


def made(name: str) -> nn.Module:
    """A design with the same random values each time."""
    return DESIGNS[name].made()
