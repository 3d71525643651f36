"""Optimizer settings by site: decoupled weight decay and learning rates of some parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, Grid, SiteLike, within
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.schedules import Numeric

Groups: TypeAlias = list[dict[str, Any]]

# A factor of 0 could not be undone by a later one.
_LOWEST_SCALE = 1e-6


def split_groups(groups: Groups, chosen: Iterable[Tensor]) -> tuple[Groups, Groups]:
    """Split optimizer parameter groups, so that some parameters are in groups of their own.

    Args:
        groups: as for a `torch.optim.Optimizer`; they stay as they are.
        chosen: parameters to set apart; those that are in no group are left out.

    Returns:
        All groups, in order, each followed by its chosen part with the same options; and the chosen parts
        alone (the same dicts).

    Raises:
        InputError: none of the chosen parameters is in a group.

    Example:
        >>> import torch
        >>> a, b = torch.zeros(1), torch.zeros(2)
        >>> groups, parts = split_groups([{"params": [a, b], "lr": 0.1}], [b])
        >>> [len(group["params"]) for group in groups], parts[0]["params"][0] is b, parts[0]["lr"]
        ([1, 1], True, 0.1)
    """
    wanted = {id(parameter) for parameter in chosen}
    result: Groups = []
    parts: Groups = []
    for group in groups:
        params = list(group["params"])
        rest = [entry for entry in params if id(_tensor(entry)) not in wanted]
        part = [entry for entry in params if id(_tensor(entry)) in wanted]
        if rest or not part:
            result.append({**group, "params": rest})
        if part:
            parts.append({**group, "params": part})
            result.append(parts[-1])
    if not parts:
        raise InputError("parameter groups: none holds a parameter of the site; pass all groups of the field")
    return result, parts


def _groups_of(groups: Groups, grids: Sequence[Grid]) -> Groups:
    """Groups that hold nothing but parameters of the site."""
    ours = {id(grid.parameter) for grid in grids}
    return [
        group for group in groups if group["params"] and all(id(_tensor(p)) in ours for p in group["params"])
    ]


def _tensor(entry: Any) -> Any:
    """The tensor of an entry of a group, which may stand there with its name."""
    return entry[1] if isinstance(entry, tuple) else entry


@register
@dataclass(frozen=True)
class WeightDecay(Regularizer):
    """Parameters of a site shrink by ``lr * decay`` of themselves at each step, apart from the gradient.

    Works through the option `weight_decay` of the parameter groups that `handle.parameter_groups` returns,
    so the optimizer must decay apart from the gradient, as `torch.optim.AdamW` does.

    Args:
        site: its `grids` decay.
        decay: fraction per unit of learning rate; ZeroRF: 0.2.

    Formula: ``p <- p - lr * decay * p``
    Unit: 1 / learning rate
    Source: AdamW (Loshchilov and Hutter 2019); on grids ZeroRF (Shi et al. 2024) and FourieRF

    Raises:
        InputError: the site or the decay is not one; the groups do not hold the site's parameters.
    """

    site: SiteLike
    decay: Numeric = 0.2
    shown = "decay"
    ranges = within(decay=NOT_NEGATIVE)
    example_arguments = ({}, {"decay": 0.0})

    def parameter_groups(self, groups: Groups, grids: Sequence[Grid], context: Context) -> Groups:
        """Set the site's parameters apart, with their decay."""
        result, parts = split_groups(groups, (grid.parameter for grid in grids))
        for part in parts:
            # The second option makes Adam of recent versions of torch decay as AdamW does.
            part.update(weight_decay=self.value(context), decoupled_weight_decay=True)
        return result

    def update_groups(self, groups: Groups, grids: Sequence[Grid], context: Context) -> None:
        """The decay of this step."""
        for group in _groups_of(groups, grids):
            group["weight_decay"] = self.value(context)


@register
@dataclass(frozen=True)
class LearningRate(Regularizer):
    """The learning rate of a site's parameters is multiplied by a factor.

    Works through the options `lr` and `initial_lr` of the parameter groups, so a trainer's own decay goes
    on as it was. A factor that changes from step to step needs `handle.update_groups` at each step, and a
    trainer that derives its rates from `initial_lr` or from the last ones. Of two on one site the last one
    counts.

    Args:
        site: the learning rate of its `grids`.
        scale: factor, above 0. (To freeze a parameter, set its `requires_grad` to False.)

    Formula: ``lr <- lr * scale``
    Unit: none
    Source: TensoRF (Chen et al. 2022) trains grids with 20 times the rate of its networks

    Raises:
        InputError: the site or the scale is not one; the groups lack a learning rate or the site's
            parameters.
    """

    site: SiteLike
    scale: Numeric = 1.0
    shown = "scale"
    ranges = within(scale=(_LOWEST_SCALE, float("inf")))
    example_arguments = ({}, {"scale": 0.5})

    def parameter_groups(self, groups: Groups, grids: Sequence[Grid], context: Context) -> Groups:
        """Set the site's parameters apart, with their learning rate."""
        result, parts = split_groups(groups, (grid.parameter for grid in grids))
        for part in parts:
            if "lr" not in part:
                raise InputError("parameter groups: expected an 'lr' in the groups of the site, found none")
            self._rescale(part, context)
        return result

    def update_groups(self, groups: Groups, grids: Sequence[Grid], context: Context) -> None:
        """Replace the factor of the last step by that of this one."""
        for group in _groups_of(groups, grids):
            self._rescale(group, context)

    def _rescale(self, group: dict[str, Any], context: Context) -> None:
        key = f"lr_scale of {self.site}"
        scale = self.value(context)
        ratio = scale / group.get(key, 1.0)
        group[key] = scale
        for name in ("lr", "initial_lr"):
            if name in group and ratio != 1:
                group[name] = group[name] * ratio
