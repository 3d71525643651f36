"""gridreg inside programs of others; each test needs the program and skips without it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import gridreg
from gridreg.scenes import builtin_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scene"), size=32)


@pytest.fixture
def nerfstudio_field() -> torch.nn.Module:
    pytest.importorskip("nerfstudio", reason="needs nerfstudio 1.1.5")
    pytest.importorskip("gridreg.adapters.nerfstudio")
    from nerfstudio.field_components import encodings
    from nerfstudio.fields.tensorf_field import TensoRFField

    octaves = {"num_frequencies": 2, "min_freq_exp": 0, "max_freq_exp": 2}
    torch.manual_seed(0)
    return TensoRFField(
        torch.tensor([[-1.5] * 3, [1.5] * 3]),
        feature_encoding=encodings.NeRFEncoding(in_dim=27, **octaves),
        direction_encoding=encodings.NeRFEncoding(in_dim=3, **octaves),
        density_encoding=encodings.TensorVMEncoding(8, 4),
        color_encoding=encodings.TensorVMEncoding(8, 4),
        head_mlp_layer_width=16,
    )


def test_few_tensorf_attaches_to_the_field_of_nerfstudio(nerfstudio_field: torch.nn.Module) -> None:
    sites = gridreg.sites_of(nerfstudio_field)
    assert {"density", "appearance", "encoding.features", "encoding.direction"} <= set(sites)
    before = {name: value.clone() for name, value in nerfstudio_field.state_dict().items()}
    composition = gridreg.composition("few_tensorf", missing="skip")
    with gridreg.apply(nerfstudio_field, *composition, total_steps=10) as handle:
        handle.step(0)
        handle.suspends("density_encoding.upsample_grid")
        line = nerfstudio_field.density_encoding.line_coef
        assert bool((line[:, -1] == 0).all())
        assert bool((line[:, 0] == before["density_encoding.line_coef"][:, 0]).all())
        nerfstudio_field.density_encoding.upsample_grid(16)
        raw = dict(nerfstudio_field.named_parameters())["density_encoding.line_coef"]
        assert raw.shape[2] == 16
        assert bool((raw != 0).all())


def test_levels_of_the_hash_grid_of_nerfstudio(nerfstudio_field: torch.nn.Module) -> None:
    from nerfstudio.cameras.rays import Frustums, RaySamples
    from nerfstudio.fields.nerfacto_field import NerfactoField

    bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
    options = {"num_levels": 4, "max_res": 64, "log2_hashmap_size": 8, "appearance_embedding_dim": 0}
    field = NerfactoField(bounds, num_images=1, implementation="torch", **options)
    at = torch.rand(2, 3, 3)
    one = torch.ones(2, 3, 1)
    samples = RaySamples(Frustums(at, at, 0 * one, 0 * one, one), camera_indices=one.long())
    mask = gridreg.LevelMask("levels", start=1, every=2, features=2)
    with gridreg.apply(field, mask, total_steps=10) as handle:
        handle.step(0)
        field.get_density(samples)
        assert list(handle.values().values()) == [0.25]


def test_octaves_of_the_encodings_of_nerfstudio(nerfstudio_field: torch.nn.Module) -> None:
    """A channel of octave k has the frequency of octave k: twice that of the one before."""
    encoding = nerfstudio_field.direction_encoding
    octaves = gridreg.octaves_of_channels(3, 2, "coordinate", include_input=False)
    x = torch.zeros(3, requires_grad=True)
    slopes = torch.autograd.functional.jacobian(encoding, x).abs().sum(1)[:6]
    assert len(octaves) == encoding.get_out_dim()
    assert [float(s / slopes.min()) > 2 for s in slopes] == [octave == 1 for octave in octaves[:6]]


def test_few_view_protocols_are_a_data_set_of_nerfbaselines(folder: Path) -> None:
    pytest.importorskip("nerfbaselines", reason="needs nerfbaselines")
    from gridreg.adapters.nerfbaselines import load_few_views, scene_of

    scene = gridreg.scenes.load_scene(folder, "builtin8")
    dataset = load_few_views(str(folder), "train", protocol="builtin8")
    images = [json.dumps(path) for path in dataset["image_paths"]]
    assert len(set(images)) == 8
    import imageio.v3 as imageio

    dataset["images"] = [imageio.imread(path) for path in dataset["image_paths"]]
    found = scene_of(dataset)
    assert torch.equal(found.train.poses, scene.train.poses)
    assert torch.allclose(found.train.rgba, scene.train.rgba, atol=1 / 255)
    assert torch.equal(found.bounds, scene.bounds)


def test_the_method_of_nerfbaselines_trains_saves_and_resumes(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("nerfbaselines", reason="needs nerfbaselines")
    import imageio.v3 as imageio

    from gridreg.adapters.nerfbaselines import GridregMethod, load_few_views

    dataset = load_few_views(str(folder), "train", protocol="builtin8")
    dataset["images"] = [imageio.imread(path) for path in dataset["image_paths"]]
    changes = {"preset": "quick", "train.steps": 4, "train.rays": 32}
    method = GridregMethod(train_dataset=dataset, config_overrides=changes)
    assert method.get_info()["num_iterations"] == 4
    for step in range(2):
        assert np.isfinite(method.train_iteration(step)["loss"])
    method.save(str(tmp_path / "checkpoint"))
    expected = method.render(dataset["cameras"][0])
    loaded = GridregMethod(checkpoint=str(tmp_path / "checkpoint"))
    assert loaded.get_info()["loaded_step"] == 2
    assert np.array_equal(loaded.render(dataset["cameras"][0])["color"], expected["color"])
    resumed = GridregMethod(checkpoint=str(tmp_path / "checkpoint"), train_dataset=dataset)
    assert resumed.train_iteration(2) == method.train_iteration(2)
