"""The inner loops of our fields: plain PyTorch versions, compiled ones for the CPU, and the choice between them."""

from __future__ import annotations

from gridreg.ops.cpu import composite
from gridreg.ops.cpu.autograd import accumulate_into_grad
from gridreg.ops.encode import encode, encode_together
from gridreg.ops.encoded_mlp import Block, encoded_mlp
from gridreg.ops.grid_lookup import (
    Activation,
    MarchArguments,
    cp_density,
    cp_features,
    cp_march_density,
    vm_density,
    vm_features,
    vm_march_density,
)
from gridreg.ops.linear import Layer, mlp, product_dtype

__all__ = [
    "Activation",
    "Block",
    "Layer",
    "MarchArguments",
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
