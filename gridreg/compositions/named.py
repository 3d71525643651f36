"""Compositions by name, with the settings of their papers, for the site names of gridreg's own fields."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from gridreg.base import Regularizer
from gridreg.errors import InputError, near_names
from gridreg.regularizers.frequency_masks import FixedMask, FrequencyMask
from gridreg.regularizers.grids import L1, Orthogonality
from gridreg.regularizers.level_masks import ViewDependenceMask
from gridreg.regularizers.low_pass import FourierLowPass, GridBlur
from gridreg.regularizers.occlusion import OcclusionLoss
from gridreg.regularizers.optimizer import WeightDecay
from gridreg.regularizers.total_variation import TotalVariation
from gridreg.schedules import Linear, Piecewise

RETIRED = {
    "few_tensorf_finetuned": "as published it is 'few_tensorf'; tuned here it is the preset of this name, "
    "in a study preset:few_tensorf_finetuned"
}
"""Names of compositions that went, with what to write instead."""

_COMPOSITIONS: dict[str, Callable[[], list[Regularizer]]] = {}

_GRIDS = ("density", "appearance")
_ENCODINGS = ("encoding.features", "encoding.direction", "encoding.position")


def register_composition(name: str, make: Callable[[], list[Regularizer]]) -> Callable[[], list[Regularizer]]:
    """Make a composition known by a name; a name that is known already is taken over.

    Args:
        name: as in configurations.
        make: returns the regularizers, in order.
    """
    _COMPOSITIONS[name] = make
    return make


def composition_names() -> list[str]:
    """Names that `composition` accepts."""
    return sorted(_COMPOSITIONS)


def composition_about(name: str) -> str:
    """Description of a composition: the docstring of the function that makes it."""
    return inspect.getdoc(_COMPOSITIONS[name]) or ""


def composition(name: str, missing: Literal["refuse", "skip"] = "refuse") -> list[Regularizer]:
    """The regularizers of a named composition, in order.

    Args:
        name: one of `composition_names`.
        missing: "skip": `gridreg.apply` leaves out what acts on a site that the field does not declare, such as the
            mask of a position encoding; such sites are written with a question mark, ``"encoding.position?"``.

    Raises:
        InputError: there is none of this name; lists those there are.

    >>> [type(regularizer).__name__ for regularizer in composition("freenerf")]
    ['FrequencyMask', 'FrequencyMask', 'OcclusionLoss']
    """
    if name in RETIRED:
        raise InputError(f"composition={name!r}: it is no composition any more; {RETIRED[name]}")
    if name not in _COMPOSITIONS:
        hint = near_names(name, composition_names())
        raise InputError(f"composition={name!r}: expected one of {', '.join(composition_names())}{hint}")
    if missing not in ("refuse", "skip"):
        raise InputError(f"missing={missing!r}: expected 'refuse' or 'skip'")
    found = _COMPOSITIONS[name]()
    return found if missing == "refuse" else [_optional(regularizer) for regularizer in found]


def _optional(regularizer: Regularizer) -> Regularizer:
    """The regularizer, left out where the field does not declare its site."""
    site = getattr(regularizer, "site", None)
    return replace(regularizer, site=f"{site}?") if isinstance(site, str) else regularizer  # type: ignore[call-arg]


def _none() -> list[Regularizer]:
    """No regularizer at all: the field alone."""
    return []


def _tensorf() -> list[Regularizer]:
    """TensoRF (Chen et al., ECCV 2022): L1 of the density grids, halved at the first occupancy mask."""
    return [L1("density", weight=Piecewise(values=(8e-5, 4e-5), steps=(2 / 15,)))]


def _few_tensorf() -> list[Regularizer]:
    """Few TensoRF: masks on all five sites over the whole run, occlusion loss, and TensoRF's penalties.

    The fine-tuned row of the paper differs in the length of the run and its resampling, not in the regularizers.
    """
    return [
        *(FrequencyMask(site, until=1.0) for site in (*_GRIDS, *_ENCODINGS)),
        OcclusionLoss(weight=0.01, samples=20),
        *_penalties(),
    ]


def _few_tensorf_printed() -> list[Regularizer]:
    """Few TensoRF with the masks as the equation in the papers has them, which close channels again."""
    return [replace(r, variant="printed") if isinstance(r, FrequencyMask) else r for r in _few_tensorf()]


def _few_tensorf_fixed() -> list[Regularizer]:
    """Few TensoRF as on human bodies: the first 0.8 of the channels are open throughout, the rest closed."""
    return [
        FixedMask(r.site, visible_ratio=0.8) if isinstance(r, FrequencyMask) else r for r in _few_tensorf()
    ]


def _few_tensorf_authors() -> list[Regularizer]:
    """Few TensoRF's program: blocks of 5, tail of 3, on planes and lines; no occlusion loss."""
    factors = [f"{grid}.{part}" for grid in _GRIDS for part in ("planes", "lines")]
    masks = [FrequencyMask(site, until=1.0, variant="authors") for site in (*factors, *_ENCODINGS)]
    return [*masks, *_penalties()]


def _penalties() -> list[Regularizer]:
    """TensoRF's penalties at Few TensoRF's weights; its total variation of 0.01 is 0.0002 in our unit, on planes."""
    return [
        *_tensorf(),
        *(Orthogonality(site, weight=0.01) for site in _GRIDS),
        *(TotalVariation(f"{site}.planes", weight=2e-4) for site in _GRIDS),
    ]


def _freenerf() -> list[Regularizer]:
    """FreeNeRF (Yang et al., CVPR 2023): masks on both encodings of an MLP, and occlusion loss."""
    return [
        FrequencyMask("encoding.position", until=0.9),
        FrequencyMask("encoding.direction", until=0.9),
        OcclusionLoss(weight=0.01, samples=20),
    ]


def _fourierf() -> list[Regularizer]:
    """FourieRF (Gomez et al. 2025) on synthetic scenes: Fourier low-pass of all grids, and weight decay."""
    return [
        *(FourierLowPass(site, keep=Linear(0.3, 1.0, until=2000)) for site in _GRIDS),
        *(WeightDecay(site, decay=0.2) for site in _GRIDS),
    ]


def _sanerf() -> list[Regularizer]:
    """In the style of SANeRF (2024): blurred grids that sharpen, and no bands of the direction from 2 on."""
    return [
        *(GridBlur(site) for site in _GRIDS),
        ViewDependenceMask("encoding.direction", bands=2),
        *_tensorf(),
    ]


register_composition("none", _none)
register_composition("tensorf", _tensorf)
register_composition("few_tensorf", _few_tensorf)
register_composition("few_tensorf_printed", _few_tensorf_printed)
register_composition("few_tensorf_fixed", _few_tensorf_fixed)
register_composition("few_tensorf_authors", _few_tensorf_authors)
register_composition("freenerf", _freenerf)
register_composition("fourierf", _fourierf)
register_composition("sanerf", _sanerf)
