"""Regularizers for grid radiance fields, attached from the outside."""

import os
from types import ModuleType
from typing import Any

# Read by OpenMP as torch is loaded: by default its idle threads wait in a loop, and where other programs want their
# processors, a step on two threads takes ten times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from gridreg.attach._hooks import open_channels as open_channels
from gridreg.attach._hooks import strip as strip
from gridreg.attach._resolve import register_adapter as register_adapter
from gridreg.attach._resolve import sites_of as sites_of
from gridreg.attach.apply import apply as apply
from gridreg.attach.handle import Handle as Handle
from gridreg.attach.selectors import Selector as Selector
from gridreg.attach.selectors import inputs as inputs
from gridreg.attach.selectors import outputs as outputs
from gridreg.attach.selectors import parameters as parameters
from gridreg.attach.sites import Grid as Grid
from gridreg.attach.sites import Place as Place
from gridreg.attach.sites import Site as Site
from gridreg.attach.sites import SiteLike as SiteLike
from gridreg.base import REGISTRY as REGISTRY
from gridreg.base import Clock as Clock
from gridreg.base import Context as Context
from gridreg.base import LocalTerm as LocalTerm
from gridreg.base import Regularizer as Regularizer
from gridreg.base import overrides as overrides
from gridreg.base import register as register
from gridreg.compositions.named import composition as composition
from gridreg.compositions.named import composition_names as composition_names
from gridreg.compositions.named import register_composition as register_composition
from gridreg.compositions.plain_data import from_config as from_config
from gridreg.compositions.plain_data import to_config as to_config
from gridreg.encodings import PositionalEncoding as PositionalEncoding
from gridreg.encodings import octaves_of_channels as octaves_of_channels
from gridreg.encodings import positional_encoding as positional_encoding
from gridreg.errors import RENAMED
from gridreg.errors import InputError as InputError
from gridreg.regularizers.backgrounds import ExpectedBackground as ExpectedBackground
from gridreg.regularizers.backgrounds import RandomBackground as RandomBackground
from gridreg.regularizers.backgrounds import opacity_error as opacity_error
from gridreg.regularizers.backgrounds import random_background as random_background
from gridreg.regularizers.density import CauchySparsity as CauchySparsity
from gridreg.regularizers.density import Eikonal as Eikonal
from gridreg.regularizers.density import cauchy_sparsity as cauchy_sparsity
from gridreg.regularizers.density import eikonal as eikonal
from gridreg.regularizers.depth_prior import DepthPrior as DepthPrior
from gridreg.regularizers.depth_prior import depth_correlation as depth_correlation
from gridreg.regularizers.depth_prior import depth_ranking as depth_ranking
from gridreg.regularizers.depth_prior import depth_residual as depth_residual
from gridreg.regularizers.dropout import ComponentDropout as ComponentDropout
from gridreg.regularizers.dropout import component_dropout as component_dropout
from gridreg.regularizers.filters import fourier_low_pass as fourier_low_pass
from gridreg.regularizers.filters import gaussian_blur as gaussian_blur
from gridreg.regularizers.frequency_masks import CosineMask as CosineMask
from gridreg.regularizers.frequency_masks import FixedMask as FixedMask
from gridreg.regularizers.frequency_masks import FrequencyMask as FrequencyMask
from gridreg.regularizers.functions import GridFunction as GridFunction
from gridreg.regularizers.functions import SamplesFunction as SamplesFunction
from gridreg.regularizers.functions import from_function as from_function
from gridreg.regularizers.gradient_scaling import DistanceGradientScaling as DistanceGradientScaling
from gridreg.regularizers.gradient_scaling import scale_gradients_by_distance as scale_gradients_by_distance
from gridreg.regularizers.grids import L1 as L1
from gridreg.regularizers.grids import L2 as L2
from gridreg.regularizers.grids import Orthogonality as Orthogonality
from gridreg.regularizers.grids import l1 as l1
from gridreg.regularizers.grids import l2 as l2
from gridreg.regularizers.grids import orthogonality as orthogonality
from gridreg.regularizers.level_masks import LevelMask as LevelMask
from gridreg.regularizers.level_masks import ViewDependenceMask as ViewDependenceMask
from gridreg.regularizers.low_pass import FourierLowPass as FourierLowPass
from gridreg.regularizers.low_pass import GridBlur as GridBlur
from gridreg.regularizers.low_pass import annealed_radius as annealed_radius
from gridreg.regularizers.mask_base import Mask as Mask
from gridreg.regularizers.mask_functions import authors_frequency_mask as authors_frequency_mask
from gridreg.regularizers.mask_functions import cosine_mask as cosine_mask
from gridreg.regularizers.mask_functions import fixed_mask as fixed_mask
from gridreg.regularizers.mask_functions import frequency_mask as frequency_mask
from gridreg.regularizers.mask_functions import level_mask as level_mask
from gridreg.regularizers.mask_functions import printed_frequency_mask as printed_frequency_mask
from gridreg.regularizers.mask_functions import spherical_bands as spherical_bands
from gridreg.regularizers.occlusion import OcclusionLoss as OcclusionLoss
from gridreg.regularizers.occlusion import occlusion_loss as occlusion_loss
from gridreg.regularizers.optimizer import LearningRate as LearningRate
from gridreg.regularizers.optimizer import WeightDecay as WeightDecay
from gridreg.regularizers.optimizer import split_groups as split_groups
from gridreg.regularizers.patches import DepthSmoothness as DepthSmoothness
from gridreg.regularizers.patches import NormalSmoothness as NormalSmoothness
from gridreg.regularizers.patches import RayKL as RayKL
from gridreg.regularizers.patches import depth_smoothness as depth_smoothness
from gridreg.regularizers.patches import normal_smoothness as normal_smoothness
from gridreg.regularizers.patches import ray_kl as ray_kl
from gridreg.regularizers.proposals import ProposalLoss as ProposalLoss
from gridreg.regularizers.proposals import proposal_loss as proposal_loss
from gridreg.regularizers.rays import DistortionLoss as DistortionLoss
from gridreg.regularizers.rays import OpacityEntropy as OpacityEntropy
from gridreg.regularizers.rays import RayEntropy as RayEntropy
from gridreg.regularizers.rays import distortion as distortion
from gridreg.regularizers.rays import opacity_entropy as opacity_entropy
from gridreg.regularizers.rays import ray_entropy as ray_entropy
from gridreg.regularizers.sample_space import SampleSpaceAnnealing as SampleSpaceAnnealing
from gridreg.regularizers.sample_space import anneal_space as anneal_space
from gridreg.regularizers.total_variation import TimeSmoothness as TimeSmoothness
from gridreg.regularizers.total_variation import TotalVariation as TotalVariation
from gridreg.regularizers.total_variation import time_smoothness as time_smoothness
from gridreg.regularizers.total_variation import total_variation as total_variation
from gridreg.samples import RaySamples as RaySamples
from gridreg.schedules import Cosine as Cosine
from gridreg.schedules import Geometric as Geometric
from gridreg.schedules import Linear as Linear
from gridreg.schedules import Numeric as Numeric
from gridreg.schedules import Piecewise as Piecewise
from gridreg.schedules import Schedule as Schedule
from gridreg.schedules import register_schedule as register_schedule
from gridreg.schedules import resolve as resolve
from gridreg.segments import optical_depth_to_weights as optical_depth_to_weights

__version__ = "0.1.0"

__all__ = sorted(
    name
    for name, value in globals().items()
    if not name.startswith("_")
    and not isinstance(value, ModuleType)
    and value not in (ModuleType, Any, RENAMED)
)


def __getattr__(name: str) -> Any:
    """Refuse a name that went with the one that took its place."""
    if name in RENAMED:
        raise InputError(f"gridreg.{name}: it is called gridreg.{RENAMED[name]} now")
    raise AttributeError(f"module 'gridreg' has no attribute {name!r}")
