"""The inner loops of our fields: plain PyTorch versions, compiled ones for the CPU, and the choice between them."""

from __future__ import annotations

from backbones.kernels import composite
from backbones.kernels.autograd import accumulate_into_grad
from backbones.kernels.dispatch import cp_density, cp_features, vm_density, vm_features
from backbones.kernels.encode import encode, encode_together
from backbones.kernels.linear import mlp

__all__ = [
    "accumulate_into_grad",
    "cp_density",
    "cp_features",
    "encode",
    "encode_together",
    "mlp",
    "vm_density",
    "vm_features",
]

composite.register()
