"""Fields of other people's for `foreign.py`, and where gridreg attaches to them; wants nerfstudio and K-Planes."""

from __future__ import annotations

import itertools
import sys
import types
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

import gridreg


class Foreign(NamedTuple):
    """A field of somebody else's, and where gridreg attaches to it."""

    field: nn.Module
    rates: dict[str, float]  # learning rate by the beginning of a parameter's name
    grids: tuple[gridreg.Selector, ...]  # raw grids, for penalties
    masks: tuple[gridreg.Regularizer, ...]  # open from coarse to fine
    direction: gridreg.Selector  # the encoding of the viewing direction
    smooth: bool = True  # whether neighbours in the grids are neighbours in space
    grow: tuple[str, ...] = ()  # modules whose grids are upsampled on the way


def stub_tinycudann() -> None:
    """Stand in for the CUDA networks that K-Planes' decoder is made of: the same layers in plain PyTorch."""

    class Network(nn.Sequential):
        def __init__(self, n_input_dims: int, n_output_dims: int, network_config: dict[str, Any]) -> None:
            width, sizes = network_config["n_neurons"], [n_input_dims]
            sizes += [width] * network_config["n_hidden_layers"] + [n_output_dims]
            layers: list[nn.Module] = []
            for before, after in itertools.pairwise(sizes):
                layers += [nn.Linear(before, after, bias=False), nn.ReLU()]
            layers.pop()
            if network_config["output_activation"] == "Sigmoid":
                layers.append(nn.Sigmoid())
            super().__init__(*layers)

    class Encoding(nn.Module):
        def __init__(self, n_input_dims: int, encoding_config: dict[str, Any]) -> None:
            super().__init__()
            from nerfstudio.utils.math import components_from_spherical_harmonics

            self.n_output_dims = encoding_config["degree"] ** 2
            self._of = components_from_spherical_harmonics
            self._levels = encoding_config["degree"]

        def forward(self, x: Tensor) -> Tensor:
            return self._of(self._levels, 2 * x - 1)

    from nerfstudio.fields import base_field

    module = types.ModuleType("tinycudann")
    module.Network, module.Encoding = Network, Encoding  # type: ignore[attr-defined]
    sys.modules.setdefault("tinycudann", module)
    # A function that newer releases of nerfstudio call otherwise.
    vars(base_field).setdefault("shift_directions_for_tcnn", lambda directions: (directions + 1) / 2)


def make(name: str, bounds: Tensor, seed: int) -> Foreign:
    """Construct a field with its own initial values, and name its sites."""
    from nerfstudio.field_components import encodings
    from nerfstudio.fields.nerfacto_field import NerfactoField
    from nerfstudio.fields.tensorf_field import TensoRFField
    from nerfstudio.fields.vanilla_nerf_field import NeRFField

    torch.manual_seed(seed)
    direction = gridreg.outputs("direction_encoding", dim=-1)
    if name == "tensorf":
        grids = {
            "density_encoding": encodings.TensorVMEncoding(resolution=48, num_components=16),
            "color_encoding": encodings.TensorVMEncoding(resolution=48, num_components=24),
        }
        octaves = {"num_frequencies": 2, "min_freq_exp": 0, "max_freq_exp": 2}
        field = TensoRFField(
            bounds,
            feature_encoding=encodings.NeRFEncoding(in_dim=27, **octaves),
            direction_encoding=encodings.NeRFEncoding(in_dim=3, **octaves),
            head_mlp_layer_width=64,
            **grids,
        )
        planes = [gridreg.parameters(f"{grid}.plane_coef", dim=1, stack=0) for grid in grids]
        lines = [gridreg.parameters(f"{grid}.line_coef", dim=1, stack=0) for grid in grids]
        mask = [gridreg.FrequencyMask(line, until=0.5) for line in lines]
        return Foreign(
            field,
            {"density_encoding": 0.02, "color_encoding": 0.02},
            tuple(planes),
            tuple(mask),
            direction,
            grow=tuple(grids),
        )
    if name == "kplanes":
        stub_tinycudann()
        from kplanes.kplanes_field import KPlanesField

        field = KPlanesField(
            bounds, 1, grid_base_resolution=(48, 48, 48), grid_feature_dim=16, multiscale_res=(1, 2)
        )
        grid = gridreg.parameters("grids.*.plane_coefs.*", dim=0)
        mask = gridreg.FrequencyMask(gridreg.outputs("grids.*", dim=-1), until=0.5)
        return Foreign(field, {"grids": 0.02}, (grid,), (mask,), direction)
    if name == "hash":
        field = NerfactoField(
            bounds,
            num_images=1,
            num_levels=8,
            max_res=256,
            log2_hashmap_size=15,
            appearance_embedding_dim=0,
            implementation="torch",
        )
        levels = gridreg.outputs("mlp_base.model.0", dim=-1)
        table = gridreg.parameters("mlp_base.model.0.hash_table", dim=1)
        mask = gridreg.LevelMask(levels, start=4, every=100, features=2)
        return Foreign(field, {"mlp_base.model.0": 0.01}, (table,), (mask,), direction, smooth=False)
    octaves = gridreg.octaves_of_channels(3, 8, order="coordinate", include_input="last")
    field = NeRFField(
        position_encoding=encodings.NeRFEncoding(
            in_dim=3, num_frequencies=8, min_freq_exp=0, max_freq_exp=7, include_input=True
        ),
        direction_encoding=encodings.NeRFEncoding(
            in_dim=3, num_frequencies=2, min_freq_exp=0, max_freq_exp=1, include_input=True
        ),
        base_mlp_num_layers=3,
        base_mlp_layer_width=96,
        head_mlp_num_layers=1,
        head_mlp_layer_width=64,
        skip_connections=(1,),
    )
    mask = gridreg.FrequencyMask(gridreg.outputs("position_encoding", octaves=octaves), until=0.5)
    return Foreign(field, {}, (), (mask,), direction)


def pieces(foreign: Foreign) -> dict[str, list[gridreg.Regularizer]]:
    """Return what validation views choose from, each a kind of regularizer and, after a colon, how strong."""
    found: dict[str, list[gridreg.Regularizer]] = {
        "background": [gridreg.ExpectedBackground()],
        "direction": [gridreg.ViewDependenceMask(foreign.direction, bands=0)],
        "mask": [*foreign.masks],
        "occlusion:0.01": [gridreg.OcclusionLoss(weight=1e-2, distance=0.3)],
        "distortion:0.01": [gridreg.DistortionLoss(weight=1e-2)],
    }
    if foreign.grids and foreign.smooth:
        for weight in (1e-3, 1e-2):
            found[f"smooth:{weight:g}"] = [gridreg.TotalVariation(g, weight=weight) for g in foreign.grids]
    elif foreign.grids:
        found["small:0.1"] = [gridreg.L2(grid, weight=0.1) for grid in foreign.grids]
    return found


def composition(foreign: Foreign, name: str) -> list[gridreg.Regularizer]:
    """Return the regularizers of one piece, or of several joined by plus signs."""
    return [regularizer for piece in name.split("+") for regularizer in pieces(foreign)[piece]]
