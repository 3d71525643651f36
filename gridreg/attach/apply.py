"""Attach regularizers to a field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import nn

from gridreg.attach._attachment import Attachment
from gridreg.attach._resolve import sites_of
from gridreg.attach.handle import Handle
from gridreg.base import Clock, Regularizer
from gridreg.errors import InputError


def apply(field: nn.Module, *regularizers: Regularizer, total_steps: int, seed: int = 0) -> Handle:
    """Attach regularizers to a field, which is neither edited nor copied.

    Args:
        field: any module.
        regularizers: in this order; two masks on one site multiply. One whose site is a name with a question mark
            (``"encoding.position?"``) is left out where the field declares no such site, and the handle shows that.
        total_steps: length of the training run, iterations; fractions in schedules refer to it.
        seed: of the handle's own random numbers.

    Returns:
        The handle, at step 0.

    Raises:
        InputError: naming the argument, what was found and what is expected.

    >>> import gridreg, torch
    >>> mlp = nn.Sequential(nn.Linear(6, 8), nn.ReLU(), nn.Linear(8, 1))
    >>> with gridreg.apply(mlp, gridreg.FrequencyMask(gridreg.inputs("0")), total_steps=100):
    ...     bool((mlp(torch.tensor([0.0, 0, 0, 1, 1, 1])) == mlp(torch.zeros(6))).all())
    True
    """
    if not isinstance(field, nn.Module):
        raise InputError(f"field={type(field).__name__}: expected a torch.nn.Module")
    for regularizer in regularizers:
        _check_regularizer(regularizer)
    if isinstance(total_steps, bool) or not hasattr(total_steps, "__index__") or total_steps <= 0:
        raise InputError(
            f"total_steps={total_steps!r}: expected the number of training steps, an int above 0"
        )
    kept, skipped = _without_missing(field, regularizers)
    return Handle(Attachment(field, kept, Clock(int(total_steps), seed)), skipped)


def _without_missing(
    field: nn.Module, regularizers: Sequence[Regularizer]
) -> tuple[list[Regularizer], list[Regularizer]]:
    """The regularizers without those whose site may be missing and is, and these."""
    kept, missing, found = [], [], False
    for regularizer in regularizers:
        site = getattr(regularizer, "site", None)
        if not isinstance(site, str) or not site.endswith("?"):
            kept.append(regularizer)
        elif site[:-1] in sites_of(field):
            kept.append(replace(regularizer, site=site[:-1]))  # type: ignore[call-arg]
            found = True
        else:
            missing.append(replace(regularizer, site=site[:-1]))  # type: ignore[call-arg]
    if missing and not found:
        names = ", ".join(dict.fromkeys(str(site) for skipped in missing for site in skipped.sites()))
        raise InputError(f"{type(field).__name__} declares none of the sites {names}; see gridreg.sites_of")
    return kept, missing


def _check_regularizer(value: object) -> None:
    if isinstance(value, Handle):
        raise InputError("regularizers: found a handle, which is applied already; pass regularizers to apply")
    if not isinstance(value, Regularizer):
        hint = "; unpack a list with *" if isinstance(value, (list, tuple)) else ""
        if isinstance(value, type) and issubclass(value, Regularizer):
            hint = f"; call it: {value.__name__}(...)"
        name = getattr(value, "__name__", None) or repr(value)[:60]
        raise InputError(f"regularizers: found {name}, expected instances of gridreg.Regularizer{hint}")
