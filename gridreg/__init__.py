"""Regularizers for grid radiance fields, attached from the outside."""

from typing import Any

from gridreg.attach._hooks import open_channels, strip
from gridreg.attach._resolve import register_adapter, sites_of
from gridreg.attach.apply import apply
from gridreg.attach.handle import Handle
from gridreg.attach.sites import Grid, Place, Selector, Site, inputs, outputs, parameters
from gridreg.base import REGISTRY, Clock, Context, LocalTerm, Regularizer, overrides, register
from gridreg.compositions.named import composition, composition_names, register_composition
from gridreg.compositions.plain_data import from_config, to_config
from gridreg.encodings import PositionalEncoding, octaves_of_channels, positional_encoding
from gridreg.errors import RENAMED, InputError
from gridreg.regularizers.backgrounds import (
    ExpectedBackground,
    RandomBackground,
    opacity_error,
    random_background,
)
from gridreg.regularizers.channel_masks import CosineMask, FixedMask, FrequencyMask
from gridreg.regularizers.density import CauchySparsity, Eikonal, cauchy_sparsity, eikonal
from gridreg.regularizers.depth_prior import DepthPrior, depth_correlation, depth_ranking, depth_residual
from gridreg.regularizers.dropout import ComponentDropout, component_dropout
from gridreg.regularizers.filters import fourier_low_pass, gaussian_blur
from gridreg.regularizers.functions import GridFunction, SamplesFunction, from_function
from gridreg.regularizers.gradient_scaling import DistanceGradientScaling, scale_gradients_by_distance
from gridreg.regularizers.grids import L1, L2, Orthogonality, l1, l2, orthogonality
from gridreg.regularizers.level_masks import LevelMask, ViewDependenceMask
from gridreg.regularizers.low_pass import FourierLowPass, GridBlur, annealed_radius
from gridreg.regularizers.mask_base import Mask
from gridreg.regularizers.mask_functions import (
    authors_frequency_mask,
    cosine_mask,
    fixed_mask,
    frequency_mask,
    level_mask,
    printed_frequency_mask,
    spherical_bands,
)
from gridreg.regularizers.occlusion import OcclusionLoss, occlusion_loss
from gridreg.regularizers.optimizer import LearningRate, WeightDecay, split_groups
from gridreg.regularizers.patches import (
    DepthSmoothness,
    NormalSmoothness,
    RayKL,
    depth_smoothness,
    normal_smoothness,
    ray_kl,
)
from gridreg.regularizers.proposals import ProposalLoss, proposal_loss
from gridreg.regularizers.rays import (
    DistortionLoss,
    OpacityEntropy,
    RayEntropy,
    distortion,
    opacity_entropy,
    ray_entropy,
)
from gridreg.regularizers.sample_space import SampleSpaceAnnealing, anneal_space
from gridreg.regularizers.total_variation import (
    TimeSmoothness,
    TotalVariation,
    time_smoothness,
    total_variation,
)
from gridreg.samples import RaySamples
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

__version__ = "0.1.0"

__all__ = [
    "CauchySparsity",
    "Clock",
    "ComponentDropout",
    "Context",
    "Cosine",
    "CosineMask",
    "DepthPrior",
    "DepthSmoothness",
    "DistanceGradientScaling",
    "DistortionLoss",
    "Eikonal",
    "ExpectedBackground",
    "FixedMask",
    "FourierLowPass",
    "FrequencyMask",
    "Geometric",
    "Grid",
    "GridBlur",
    "GridFunction",
    "Handle",
    "InputError",
    "L1",
    "L2",
    "LearningRate",
    "LevelMask",
    "Linear",
    "LocalTerm",
    "Mask",
    "NormalSmoothness",
    "Numeric",
    "OcclusionLoss",
    "OpacityEntropy",
    "Orthogonality",
    "Piecewise",
    "Place",
    "PositionalEncoding",
    "ProposalLoss",
    "REGISTRY",
    "RandomBackground",
    "RayEntropy",
    "RayKL",
    "RaySamples",
    "Regularizer",
    "SampleSpaceAnnealing",
    "SamplesFunction",
    "Schedule",
    "Selector",
    "Site",
    "TimeSmoothness",
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
    "depth_correlation",
    "depth_ranking",
    "depth_residual",
    "depth_smoothness",
    "distortion",
    "eikonal",
    "fixed_mask",
    "fourier_low_pass",
    "frequency_mask",
    "from_config",
    "from_function",
    "gaussian_blur",
    "inputs",
    "l1",
    "l2",
    "level_mask",
    "normal_smoothness",
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
    "proposal_loss",
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
    "time_smoothness",
    "to_config",
    "total_variation",
]


def __getattr__(name: str) -> Any:
    """Refuse a name that went with the one that took its place."""
    if name in RENAMED:
        raise InputError(f"gridreg.{name}: it is called gridreg.{RENAMED[name]} now")
    raise AttributeError(f"module 'gridreg' has no attribute {name!r}")
