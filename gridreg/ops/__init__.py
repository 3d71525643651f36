"""The inner loops of our fields and renderer, each a function that a compiled version may stand in for.

Importing this package registers the compiled versions, if numba is there; see `gridreg.ops.dispatch`.
"""

from __future__ import annotations

import importlib

from gridreg.ops.composite import accumulate as accumulate
from gridreg.ops.composite import composite_weights as composite_weights
from gridreg.ops.composite import pixels as pixels
from gridreg.ops.composite import terminate as terminate
from gridreg.ops.cp import cp_density as cp_density
from gridreg.ops.cp import cp_features as cp_features
from gridreg.ops.cp import cp_march_density as cp_march_density
from gridreg.ops.dispatch import chosen_backend as chosen_backend
from gridreg.ops.dispatch import use_backend as use_backend
from gridreg.ops.fused_adam import FusedAdam as FusedAdam
from gridreg.ops.gradient_buffers import accumulate_into_grad as accumulate_into_grad
from gridreg.ops.merging import FeatureMeans as FeatureMeans
from gridreg.ops.merging import average_features as average_features
from gridreg.ops.merging import merge_samples as merge_samples
from gridreg.ops.merging import spread_to_samples as spread_to_samples
from gridreg.ops.perceptron import Block as Block
from gridreg.ops.perceptron import Layer as Layer
from gridreg.ops.perceptron import encoded_mlp as encoded_mlp
from gridreg.ops.perceptron import mlp as mlp
from gridreg.ops.perceptron import product_dtype as product_dtype
from gridreg.ops.ray_marching import Activation as Activation
from gridreg.ops.ray_marching import MarchArguments as MarchArguments
from gridreg.ops.ray_marching import RayMarchResult as RayMarchResult
from gridreg.ops.ray_marching import march as march
from gridreg.ops.ray_marching import march_density as march_density
from gridreg.ops.vm import vm_density as vm_density
from gridreg.ops.vm import vm_features as vm_features
from gridreg.ops.vm import vm_march_density as vm_march_density


def _register_compiled() -> None:
    try:
        importlib.import_module("numba")
    except ImportError:
        return
    importlib.import_module("gridreg.ops.cpu.registered")


_register_compiled()
