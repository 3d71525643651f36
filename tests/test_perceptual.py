"""LPIPS with random weights against the networks as torchvision lists them and the formula in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import Tensor, nn
from torchmetrics.functional.image import lpips as torchmetrics_lpips

from gridreg.errors import InputError
from gridreg.training.metrics import image_metrics
from gridreg.training.perceptual import Lpips, read_lpips

WIDTHS = {"alex": [64, 192, 384, 256, 256], "vgg": [64, 128, 256, 512, 512]}
# Numbers of the rectifiers whose outputs are compared.
COMPARED = {"alex": [1, 4, 7, 9, 11], "vgg": [3, 8, 15, 22, 29]}


def features(network: str) -> nn.Sequential:
    """The ``features`` of AlexNet and VGG16, layer by layer as torchvision numbers them."""
    layers: list[nn.Module] = []
    if network == "alex":
        layers += [nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
        layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
        for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
        return nn.Sequential(*layers)
    inputs = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width:
            layers += [nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU()]
            inputs = width
        else:
            layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


def random_weights(network: str) -> tuple[nn.Sequential, dict[str, Tensor]]:
    """Layers, and their weights by the names of the lpips package."""
    torch.manual_seed(0)
    layers = features(network)
    weights = {}
    for number, layer in enumerate(layers):
        slice_ = 1 + sum(number > last for last in COMPARED[network])
        for part, value in layer.state_dict().items():
            weights[f"net.slice{slice_}.{number}.{part}"] = value
    for number, width in enumerate(WIDTHS[network]):
        weights[f"lin{number}.model.1.weight"] = torch.rand(1, width, 1, 1)
    return layers, weights


def reference(network: str, layers: nn.Sequential, weights: dict[str, Tensor], pair: Tensor) -> float:
    """The distance of two prepared images (2, 3, H, W), from the paper's equation 1 in NumPy."""
    distance, level = 0.0, 0
    with torch.no_grad():
        for number, layer in enumerate(layers):
            pair = layer(pair)
            if number in COMPARED[network]:
                x, y = pair.double().numpy()
                x, y = (z / (np.sqrt((z**2).sum(0)) + 1e-10) for z in (x, y))
                w = weights[f"lin{level}.model.1.weight"].double().numpy()[0, :, 0, 0]
                distance += np.einsum("c,chw->hw", w, (x - y) ** 2).mean()
                level += 1
    return distance


def images(height: int = 47, width: int = 40) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + 0.3 * torch.rand(height, width, 3, generator=generator)).clamp(0, 1), target


@pytest.fixture(scope="module")
def alex() -> dict[str, Tensor]:
    return random_weights("alex")[1]


@pytest.mark.parametrize("network", ["alex", "vgg"])
@pytest.mark.parametrize("input_range", ["signed", "unit"])
def test_distance_is_that_of_the_paper(network, input_range):
    layers, weights = random_weights(network)
    image, target = images()
    prepared = torch.stack([image, target]).permute(0, 3, 1, 2)
    if input_range == "signed":
        prepared = 2 * prepared - 1
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    expected = reference(network, layers, weights, (prepared - shift) / scale)
    lpips = Lpips(weights, network, input_range)
    assert lpips(image, target) == pytest.approx(expected, rel=1e-5)
    assert lpips.name == f"lpips_{network}" + ("_unit" if input_range == "unit" else "")
    assert ("[-1, 1]" if input_range == "signed" else "[0, 1]") in lpips.convention


def test_identical_images_have_distance_zero_and_noise_adds_to_it(alex):
    lpips = Lpips(alex, "alex")
    image, target = images()
    assert lpips(target, target) == 0
    assert 0 < lpips((image + target) / 2, target) < lpips(image, target)
    assert lpips(image, target) == pytest.approx(lpips(target, image), rel=1e-6)
    assert lpips(image * 3 - 1, target) == lpips((image * 3 - 1).clamp(0, 1), target)


def test_it_joins_the_other_metrics(alex):
    lpips = Lpips(alex, "alex")
    got = image_metrics(*images(), {lpips.name: lpips})
    assert got["lpips_alex"] == lpips(*images())


def test_weights_come_from_a_safetensors_file(tmp_path, alex):
    path = tmp_path / "lpips_alex.safetensors"
    safetensors.torch.save_file(alex, path)
    assert read_lpips(path, "alex")(*images()) == Lpips(alex, "alex")(*images())
    renamed = {name.replace("lin", "lins.", 1): value for name, value in alex.items()}
    safetensors.torch.save_file(renamed, path)
    assert read_lpips(path, "alex")(*images()) == Lpips(alex, "alex")(*images())


def test_wrong_files_are_one_line(tmp_path, alex):
    path = tmp_path / "w.safetensors"
    cases = []
    path.write_bytes(b"\x80\x04 a pickle")
    cases.append((path, "alex", "not a safetensors file"))
    good = tmp_path / "good.safetensors"
    safetensors.torch.save_file(alex, good)
    cases += [
        (good, "vgg", r"good.safetensors: LPIPS weights: net.slice1.0.weight has shape (64, 3, 11, 11)"),
        (tmp_path / "none.safetensors", "vgg", "LPIPS weights not found"),
    ]
    part = tmp_path / "part.safetensors"
    safetensors.torch.save_file({k: v for k, v in alex.items() if not k.startswith("lin3")}, part)
    cases.append((part, "alex", "lin3.model.1.weight is missing"))
    for file, network, expected in cases:
        with pytest.raises(InputError) as caught:
            read_lpips(file, network)
        assert expected in str(caught.value)
        assert str(file) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_wrong_arguments(alex):
    with pytest.raises(InputError, match="found 'squeeze', expected one of alex, vgg"):
        Lpips(alex, "squeeze")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="expected signed or unit"):
        Lpips(alex, "alex", "bytes")  # type: ignore[arg-type]
    lpips = Lpips(alex, "alex")
    with pytest.raises(InputError, match=r"expected equal \(H, W, 3\)"):
        lpips(torch.zeros(40, 40, 3), torch.zeros(40, 41, 3))
    with pytest.raises(InputError, match="LPIPS needs 32 pixels each way"):
        lpips(torch.zeros(31, 40, 3), torch.zeros(31, 40, 3))


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_distance_is_that_of_torchmetrics(network):
    """Its scaling, normalisation, linear layers and average, around the same convolutions with random weights."""
    layers, weights = random_weights(network)
    image, target = images()
    features_of = []
    for values in (image, target):
        x, found = torchmetrics_lpips.ScalingLayer()(2 * values.permute(2, 0, 1)[None] - 1), []
        for number, layer in enumerate(layers):
            x = layer(x)
            if number in COMPARED[network]:
                found.append(torchmetrics_lpips._normalize_tensor(x))
        features_of.append(found)
    expected = 0.0
    for level, width in enumerate(WIDTHS[network]):
        linear = torchmetrics_lpips.NetLinLayer(width)
        linear.model[-1].weight.data = weights[f"lin{level}.model.1.weight"]
        difference = (features_of[0][level] - features_of[1][level]) ** 2
        expected += torchmetrics_lpips._spatial_average(linear.eval()(difference)).item()
    assert Lpips(weights, network)(image, target) == pytest.approx(expected, rel=1e-5)
    assert expected > 0


def test_the_network_is_told_by_its_weights(tmp_path, alex):
    safetensors.torch.save_file(alex, tmp_path / "a.safetensors")
    safetensors.torch.save_file(random_weights("vgg")[1], tmp_path / "v.safetensors")
    assert read_lpips(tmp_path / "a.safetensors").name == "lpips_alex"
    assert read_lpips(tmp_path / "v.safetensors").name == "lpips_vgg"
