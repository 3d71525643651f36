"""The inner loops of our fields: plain PyTorch versions, compiled ones for the CPU, and the choice between them."""

from __future__ import annotations

from backbones.kernels import composite
from backbones.kernels.autograd import accumulate_into_grad
from backbones.kernels.dispatch import (
    Activation,
    March,
    cp_density,
    cp_features,
    cp_march_density,
    vm_density,
    vm_features,
    vm_march_density,
)
from backbones.kernels.encode import encode, encode_together
from backbones.kernels.encoded import Block, encoded_mlp
from backbones.kernels.linear import Layer, mlp, product_dtype

__all__ = [
    "Activation",
    "Block",
    "Layer",
    "March",
    "accumulate_into_grad",
    "cp_density",
    "cp_features",
    "cp_march_density",
    "encode",
    "encode_together",
    "encoded_mlp",
    "mlp",
    "product_dtype",
    "vm_density",
    "vm_features",
    "vm_march_density",
]

composite.register()
