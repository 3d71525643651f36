"""The inner loops of our fields and renderer, each a function that a compiled version may stand in for.

Importing this package registers the compiled versions, if numba is there; see `gridreg.ops.dispatch`.
"""

from __future__ import annotations

import importlib

from gridreg.ops.composite import accumulate, composite_weights, pixels, terminate
from gridreg.ops.cp import cp_density, cp_features, cp_march_density
from gridreg.ops.dispatch import chosen_backend, use_backend
from gridreg.ops.fused_adam import FusedAdam
from gridreg.ops.gradient_buffers import accumulate_into_grad
from gridreg.ops.merging import FeatureMeans, average_features, merge_samples, spread_to_samples
from gridreg.ops.perceptron import Block, Layer, encoded_mlp, mlp, product_dtype
from gridreg.ops.ray_marching import Activation, MarchArguments, RayMarchResult, march, march_density
from gridreg.ops.vm import vm_density, vm_features, vm_march_density

__all__ = [
    "Activation",
    "Block",
    "FeatureMeans",
    "FusedAdam",
    "Layer",
    "MarchArguments",
    "RayMarchResult",
    "accumulate",
    "accumulate_into_grad",
    "average_features",
    "chosen_backend",
    "composite_weights",
    "cp_density",
    "cp_features",
    "cp_march_density",
    "encoded_mlp",
    "march",
    "march_density",
    "merge_samples",
    "mlp",
    "pixels",
    "product_dtype",
    "spread_to_samples",
    "terminate",
    "use_backend",
    "vm_density",
    "vm_features",
    "vm_march_density",
]


def _register_compiled() -> None:
    try:
        importlib.import_module("numba")
    except ImportError:
        return
    importlib.import_module("gridreg.ops.cpu.registered")


_register_compiled()
