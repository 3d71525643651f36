"""Regularizers for grid radiance fields, attached from the outside."""

from gridreg.apply import apply
from gridreg.attach import open_channels, strip
from gridreg.base import REGISTRY, Clock, Context, LocalTerm, Regularizer, overrides, register
from gridreg.channel_masks import Mask
from gridreg.compose import from_config, to_config
from gridreg.dropout import ComponentDropout, component_dropout
from gridreg.encodings import PositionalEncoding, octaves_of_channels, positional_encoding
from gridreg.errors import InputError
from gridreg.finding import register_adapter, sites_of
from gridreg.handle import Handle
from gridreg.level_masks import LevelMask, ViewDependenceMask
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
from gridreg.sites import Grid, Place, Selector, Site, inputs, outputs, parameters

__all__ = [
    "REGISTRY",
    "Clock",
    "ComponentDropout",
    "Context",
    "Cosine",
    "CosineMask",
    "FixedMask",
    "FrequencyMask",
    "Geometric",
    "Grid",
    "Handle",
    "InputError",
    "LevelMask",
    "Linear",
    "LocalTerm",
    "Mask",
    "Numeric",
    "Piecewise",
    "Place",
    "PositionalEncoding",
    "RaySamples",
    "Regularizer",
    "Schedule",
    "Selector",
    "Site",
    "ViewDependenceMask",
    "apply",
    "authors_frequency_mask",
    "component_dropout",
    "cosine_mask",
    "fixed_mask",
    "frequency_mask",
    "from_config",
    "inputs",
    "level_mask",
    "octaves_of_channels",
    "open_channels",
    "outputs",
    "overrides",
    "parameters",
    "positional_encoding",
    "printed_frequency_mask",
    "register",
    "register_adapter",
    "register_schedule",
    "resolve",
    "sites_of",
    "spherical_bands",
    "strip",
    "to_config",
]
