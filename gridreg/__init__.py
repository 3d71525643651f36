"""Regularizers for grid radiance fields, attached from the outside."""

from gridreg.base import REGISTRY, Clock, Context, LocalTerm, Regularizer, overrides, register
from gridreg.errors import InputError
from gridreg.finding import register_adapter, sites_of
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
    "Context",
    "Cosine",
    "Geometric",
    "Grid",
    "InputError",
    "Linear",
    "LocalTerm",
    "Numeric",
    "Piecewise",
    "Place",
    "Regularizer",
    "Schedule",
    "Selector",
    "Site",
    "inputs",
    "outputs",
    "overrides",
    "parameters",
    "register",
    "register_adapter",
    "register_schedule",
    "resolve",
    "sites_of",
]
