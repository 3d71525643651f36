"""Whether a composition fits a field: found out on a small one, before hours of runs depend on it."""

from __future__ import annotations

import torch

import gridreg
from gridreg.errors import InputError
from gridreg.fields import make_field
from gridreg.training.run import regularizers_of
from gridreg.training.settings import RunConfig

__all__ = ["check_fits"]

_EDGE = 8


def check_fits(config: RunConfig) -> None:
    """Make a small field of this configuration and attach the composition to it.

    Raises:
        InputError: if the field refuses an option, or the composition names a site that the field does not have.

    Example:
        >>> check_fits(RunConfig(composition=[{"name": "L1", "site": "density"}]))
    """
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    generator = torch.Generator().manual_seed(0)
    field = make_field(config.backbone, bounds, (_EDGE,) * 3, generator=generator, **config.field)
    try:
        with gridreg.apply(field, *regularizers_of(config), total_steps=config.train.steps):
            pass
    except (TypeError, ValueError) as error:
        raise InputError(" ".join(str(error).split())) from error
