"""Regularizers for grid radiance fields, attached from the outside."""

from gridreg.apply import apply
from gridreg.attach import open_channels, strip
from gridreg.base import REGISTRY, Clock, Context, LocalTerm, Regularizer, overrides, register
from gridreg.channel_masks import Mask
from gridreg.compose import from_config, to_config
from gridreg.compositions import composition, composition_names, register_composition
from gridreg.dropout import ComponentDropout, component_dropout
from gridreg.encodings import PositionalEncoding, octaves_of_channels, positional_encoding
from gridreg.errors import InputError
from gridreg.filters import fourier_low_pass, gaussian_blur
from gridreg.finding import register_adapter, sites_of
from gridreg.gradient_scaling import DistanceGradientScaling, scale_gradients_by_distance
from gridreg.grid_penalties import L1, Orthogonality, TotalVariation, l1, orthogonality, total_variation
from gridreg.handle import Handle
from gridreg.level_masks import LevelMask, ViewDependenceMask
from gridreg.lowpass import FourierLowPass, SpatialAnnealing, annealed_radius
from gridreg.mask_regularizers import CosineMask, FixedMask, FrequencyMask
from gridreg.masks import (
    authors_frequency_mask,
    cosine_mask,
    fixed_mask,
    frequency_mask,
    level_mask,
    printed_frequency_mask,
    spherical_bands,
)
from gridreg.optimization import LearningRate, WeightDecay, split_groups
from gridreg.patch_penalties import DepthSmoothness, RayKL, depth_smoothness, ray_kl
from gridreg.penalties import CauchySparsity, OcclusionLoss, cauchy_sparsity, occlusion_loss
from gridreg.ray_penalties import (
    Distortion,
    OpacityEntropy,
    RayEntropy,
    distortion,
    opacity_entropy,
    ray_entropy,
)
from gridreg.samples import RaySamples
from gridreg.sampling import (
    ExpectedBackground,
    RandomBackground,
    SpaceAnnealing,
    anneal_space,
    opacity_error,
    random_background,
)
from gridreg.schedules import (
    Cosine,
    Geometric,
    Linear,
    Numeric,
    Piecewise,
    Schedule,
    register_schedule,
    resolve,
)
from gridreg.segments import optical_depth_to_weights
from gridreg.sites import Grid, Place, Selector, Site, inputs, outputs, parameters

__all__ = [
    "CauchySparsity",
    "Clock",
    "ComponentDropout",
    "Context",
    "Cosine",
    "CosineMask",
    "DepthSmoothness",
    "DistanceGradientScaling",
    "Distortion",
    "ExpectedBackground",
    "FixedMask",
    "FourierLowPass",
    "FrequencyMask",
    "Geometric",
    "Grid",
    "Handle",
    "InputError",
    "L1",
    "LearningRate",
    "LevelMask",
    "Linear",
    "LocalTerm",
    "Mask",
    "Numeric",
    "OcclusionLoss",
    "OpacityEntropy",
    "Orthogonality",
    "Piecewise",
    "Place",
    "PositionalEncoding",
    "REGISTRY",
    "RandomBackground",
    "RayEntropy",
    "RayKL",
    "RaySamples",
    "Regularizer",
    "Schedule",
    "Selector",
    "Site",
    "SpaceAnnealing",
    "SpatialAnnealing",
    "TotalVariation",
    "ViewDependenceMask",
    "WeightDecay",
    "anneal_space",
    "annealed_radius",
    "apply",
    "authors_frequency_mask",
    "cauchy_sparsity",
    "component_dropout",
    "composition",
    "composition_names",
    "cosine_mask",
    "depth_smoothness",
    "distortion",
    "fixed_mask",
    "fourier_low_pass",
    "frequency_mask",
    "from_config",
    "gaussian_blur",
    "inputs",
    "l1",
    "level_mask",
    "occlusion_loss",
    "octaves_of_channels",
    "opacity_entropy",
    "opacity_error",
    "open_channels",
    "optical_depth_to_weights",
    "orthogonality",
    "outputs",
    "overrides",
    "parameters",
    "positional_encoding",
    "printed_frequency_mask",
    "random_background",
    "ray_entropy",
    "ray_kl",
    "register",
    "register_adapter",
    "register_composition",
    "register_schedule",
    "resolve",
    "scale_gradients_by_distance",
    "sites_of",
    "spherical_bands",
    "split_groups",
    "strip",
    "to_config",
    "total_variation",
]
