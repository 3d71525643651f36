"""LPIPS: a learned distance between images, from the features of a network trained on photographs.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", version 0.1.
The network is written out here and its weights are read from a safetensors file, so neither pickle nor
torchvision is needed. The weights are not ours to ship. Whoever has the ``lpips`` package makes the file
once, in any environment::

    import lpips, safetensors.torch
    safetensors.torch.save_model(lpips.LPIPS(net="vgg"), "lpips_vgg.safetensors")

Two numbers compare only if network and input range are the same, so both are in the metric's name: papers
mostly mean ``vgg`` or ``alex`` with images scaled to [-1, 1]; FreeNeRF's program feeds ``vgg`` with images
in [0, 1].
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import safetensors.torch
import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.files import read_bytes

Network = Literal["alex", "vgg"]
InputRange = Literal["signed", "unit"]


class _Convolution(NamedTuple):
    """A convolution followed by a rectifier; ``number`` is its place in torchvision's ``features``."""

    number: int
    stride: int
    padding: int


class _Slice(NamedTuple):
    """Layers up to the next features that are compared."""

    pool: int
    convolutions: tuple[_Convolution, ...]


def _threes(*numbers: int) -> tuple[_Convolution, ...]:
    """Convolutions of 3x3 that keep the size."""
    return tuple(_Convolution(number, 1, 1) for number in numbers)


_SLICES: dict[Network, tuple[_Slice, ...]] = {
    "alex": (
        _Slice(0, (_Convolution(0, 4, 2),)),
        _Slice(3, (_Convolution(3, 1, 2),)),
        _Slice(3, _threes(6)),
        _Slice(0, _threes(8)),
        _Slice(0, _threes(10)),
    ),
    "vgg": (
        _Slice(0, _threes(0, 2)),
        _Slice(2, _threes(5, 7)),
        _Slice(2, _threes(10, 12, 14)),
        _Slice(2, _threes(17, 19, 21)),
        _Slice(2, _threes(24, 26, 28)),
    ),
}

# Output and input channels and the size of the kernel of every convolution, in order.
_SHAPES: dict[Network, tuple[tuple[int, int, int], ...]] = {
    "alex": ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)),
    "vgg": (
        *((64, 3, 3), (64, 64, 3), (128, 64, 3), (128, 128, 3), (256, 128, 3), (256, 256, 3), (256, 256, 3)),
        *((512, 256, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3), (512, 512, 3)),
    ),
}

# Mean and deviation of photographs in [-1, 1], red, green, blue.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)

_SMALLEST = 32


class Lpips:
    """The distance, with its weights; 0 for identical images, larger for images that look less alike.

    Args:
        weights: tensors by the names of the ``lpips`` package: ``net.slice1.0.weight``,
            ``net.slice1.0.bias``, ..., ``lin0.model.1.weight``, ...
        network: whose features.
        input_range: ``"signed"`` scales images to [-1, 1] first, as LPIPS was calibrated; ``"unit"`` does
            not.

    Raises:
        InputError: if a weight is missing or has another shape, or a name is unknown.
    """

    def __init__(
        self, weights: Mapping[str, Tensor], network: Network = "vgg", input_range: InputRange = "signed"
    ) -> None:
        if network not in _SLICES:
            raise InputError(f"network: found {network!r}, expected one of {', '.join(_SLICES)}")
        if input_range not in get_args(InputRange):
            raise InputError(f"input_range: found {input_range!r}, expected signed or unit")
        self.network: Network = network
        self.input_range: InputRange = input_range
        self._weights: dict[str, Tensor] = {}
        shapes = iter(_SHAPES[network])
        for number, slice_ in enumerate(_SLICES[network]):
            outputs = 0
            for convolution in slice_.convolutions:
                name = f"net.slice{number + 1}.{convolution.number}"
                outputs, inputs, size = next(shapes)
                self._take(weights, f"{name}.weight", (outputs, inputs, size, size))
                self._take(weights, f"{name}.bias", (outputs,))
            self._take(weights, f"lin{number}.model.1.weight", (1, outputs, 1, 1))

    @property
    def name(self) -> str:
        """The metric's name: ``lpips_vgg``, ``lpips_alex``, or with images in [0, 1] ``lpips_vgg_unit``."""
        return f"lpips_{self.network}" + ("" if self.input_range == "signed" else "_unit")

    @property
    def convention(self) -> str:
        """Convention of the number, for ``metrics.json``."""
        reach = "[-1, 1]" if self.input_range == "signed" else "[0, 1]"
        return f"LPIPS 0.1, network {self.network}, inputs in {reach}; lower is better"

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> float:
        """The distance of two images ``(H, W, 3)`` in [0, 1] (clamped to it).

        Raises:
            InputError: if the shapes differ, are not ``(H, W, 3)``, or are smaller than 32 pixels.
        """
        if image.shape != target.shape or image.ndim != 3 or image.shape[-1] != 3:
            raise InputError(
                f"image, target: {tuple(image.shape)} and {tuple(target.shape)}; expected equal (H, W, 3)"
            )
        if min(image.shape[:2]) < _SMALLEST:
            raise InputError(
                f"image: {image.shape[0]}x{image.shape[1]}; LPIPS needs {_SMALLEST} pixels each way"
            )
        pair = torch.stack([image, target]).float().clamp(0, 1).permute(0, 3, 1, 2)
        if self.input_range == "signed":
            pair = 2 * pair - 1
        values = (pair - self._constant(_SHIFT, pair)) / self._constant(_SCALE, pair)
        distance = 0.0
        for number, slice_ in enumerate(_SLICES[self.network]):
            if slice_.pool:
                values = F.max_pool2d(values, slice_.pool, stride=2)
            for layer in slice_.convolutions:
                weight, bias = (
                    self._weights[f"net.slice{number + 1}.{layer.number}.{part}"].to(values)
                    for part in ("weight", "bias")
                )
                values = F.conv2d(values, weight, bias, stride=layer.stride, padding=layer.padding).relu()
            # (2, C, h, w) of unit length along C
            features = values / (values.square().sum(1, keepdim=True).sqrt() + 1e-10)
            difference = (features[:1] - features[1:]).square()
            distance += float(
                F.conv2d(difference, self._weights[f"lin{number}.model.1.weight"].to(values)).mean()
            )
        return distance

    def _take(self, weights: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> None:
        # The package registers the linear layers twice; a file without duplicates keeps one of the names.
        found = weights.get(name, weights.get(name.replace("lin", "lins.", 1)))
        if found is None:
            raise InputError(f"LPIPS weights: {name} is missing; expected those of network {self.network}")
        if tuple(found.shape) != shape:
            raise InputError(f"LPIPS weights: {name} has shape {tuple(found.shape)}; expected {shape}")
        self._weights[name] = found.detach().float()

    @staticmethod
    def _constant(values: tuple[float, ...], like: Tensor) -> Tensor:
        return torch.tensor(values).to(like)[None, :, None, None]


def read_lpips(
    path: str | os.PathLike[str], network: Network | None = None, input_range: InputRange = "signed"
) -> Lpips:
    """Read the weights from a safetensors file, made as this module's page says.

    Args:
        path: the file.
        network: whose weights they are; None: as the size of the first convolution tells.
        input_range: as for `Lpips`.

    Raises:
        InputError: if the file cannot be read, is no safetensors file, or holds other weights.
    """
    try:
        weights = safetensors.torch.load(read_bytes(path, "LPIPS weights"))
    except SafetensorError as error:
        raise InputError(f"{os.fspath(path)}: not a safetensors file with LPIPS weights") from error
    try:
        if network is None:
            first = weights.get("net.slice1.0.weight")
            network = "alex" if first is not None and first.shape[-1] == 11 else "vgg"
        return Lpips(weights, network, input_range)
    except InputError as error:
        raise InputError(f"{os.fspath(path)}: {error}") from error
