"""Selectors: tensors of a field by name, as parameters, outputs or inputs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from torch import Tensor, nn

from gridreg.errors import InputError

Kind: TypeAlias = Literal["parameters", "outputs", "inputs"]


@dataclass(frozen=True)
class Selector:
    """Tensors of a field by name: parameters (or buffers), outputs of submodules, or inputs of submodules.

    Made by `parameters`, `outputs` and `inputs`; compares by value and goes to plain data and back.
    """

    kind: Kind
    pattern: str
    dim: int
    channels: tuple[int, ...] | str | None = None
    octaves: tuple[int, ...] | None = None
    spatial: tuple[int, ...] | None = None
    item: int | str | None = None
    stack: int | None = None

    def __str__(self) -> str:
        """As the user wrote it, without what is at its default."""
        text = f"{self.kind}({self.pattern!r}, dim={self.dim}"
        if self.channels is not None:
            text += f", channels={abridged(self.channels)}"
        if self.stack is not None:
            text += f", stack={self.stack}" + ("" if self.item is None else f", item={self.item}")
        return text + (")" if self.octaves is None else ", octaves=...)")


def parameters(
    glob: str,
    dim: int,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    spatial: Sequence[int] | None = None,
    stack: int | None = None,
    item: int | None = None,
) -> Selector:
    """Site: parameters (or, where no parameter matches, buffers) whose dotted names match `glob`.

    A channel mask on a grid parameter equals the mask on the features interpolated from it.

    Args:
        glob: `*` and `?` stay within one dotted part; where nothing matches so, they cross dots.
        dim: the channel axis.
        channels: channels that take part, as a slice or indices; all by default.
        octaves: octave of each channel that takes part (-1: the identity), where channels are an encoding.
        spatial: spatial axes; by default those after a leading `dim`, those before a trailing one, without
            axes of length 1. Tables, `(entries, features)` or with an axis of more than 4,096 entries, have none by
            default: what lies side by side in memory need not be neighbours in space, as in a hash grid.
        stack: axis along which a tensor holds several grids, such as 0 for three lines in one tensor
            `(3, C, M, 1)`: penalties then see three grids, and no axis of the stack is spatial.
        item: with `stack`, the one grid that takes part, such as the factor of a product that a mask is to multiply.

    >>> print(parameters("density_line.*", dim=1), parameters("line_coef", dim=1, stack=0, item=0))
    parameters('density_line.*', dim=1) parameters('line_coef', dim=1, stack=0, item=0)
    """
    if item is not None and stack is None:
        raise InputError(
            f"parameters({glob!r}, item={item!r}): expected the axis of the grids as well, stack=..."
        )
    return _selector(
        "parameters", glob, dim, channels=channels, octaves=octaves, spatial=spatial, item=item, stack=stack
    )


def outputs(
    glob: str,
    dim: int = -1,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    item: int | str | None = None,
) -> Selector:
    """Site: what submodules return whose dotted names match `glob` (`""` is the field itself).

    Only calls count (`encoder(x)`), not `encoder.forward(x)`. Arguments as in `parameters`; `item` is the
    index or key where a module returns a tuple or a dict.
    """
    return _selector("outputs", glob, dim, channels=channels, octaves=octaves, item=item)


def inputs(
    glob: str,
    dim: int = -1,
    *,
    channels: slice | Sequence[int] | str | None = None,
    octaves: Sequence[int] | None = None,
    item: int | str | None = None,
) -> Selector:
    """Site: what submodules are called with, for encodings that are computed in a plain function.

    Arguments as in `outputs`; `item` is the position or keyword of the argument, by default the first tensor.

    >>> print(inputs("mlp.0", channels=slice(30, 150)))
    inputs('mlp.0', dim=-1, channels='30:150')
    """
    return _selector("inputs", glob, dim, channels=channels, octaves=octaves, item=item)


def _selector(kind: Kind, glob: str, dim: int, **options: Any) -> Selector:
    """Check and normalise the arguments of the three functions above, which have the types."""
    stack, channels = options.pop("stack", None), options.pop("channels")
    if not isinstance(glob, str):
        raise InputError(f"{kind}({glob!r}): expected a name or glob as text")
    for name, axis, what in (("dim", dim, "the channel axis"), ("stack", stack, "the axis of the grids")):
        if isinstance(axis, bool) or not isinstance(axis, int if name == "dim" else int | None):
            raise InputError(f"{kind}({glob!r}, {name}={axis!r}): expected {what} as an int")
    for name in ("octaves", "spatial"):
        if options.get(name) is not None:
            options[name] = tuple(int(number) for number in options[name])
    return Selector(kind, glob, dim, channels=_normalised_channels(channels), stack=stack, **options)


def _normalised_channels(channels: slice | Sequence[int] | str | None) -> tuple[int, ...] | str | None:
    """A slice as text ("30:150", so that it goes to plain data), indices as a tuple."""
    if channels is None:
        return None
    if isinstance(channels, slice):
        parts = ["" if part is None else str(part) for part in (channels.start, channels.stop, channels.step)]
        return ":".join(parts if parts[2] else parts[:2])
    if isinstance(channels, str):
        if not re.fullmatch(r"(-?\d+)?:(-?\d+)?(:(-?\d+)?)?", channels):
            raise InputError(f"channels={channels!r}: expected a slice as text, such as '30:150'")
        return channels
    indices = tuple(int(channel) for channel in channels)
    if not indices or len(set(indices)) != len(indices) or min(indices) < 0:
        raise InputError(f"channels={abridged(indices)}: expected distinct indices from 0")
    return indices


def abridged(value: object) -> str:
    """One short line about a value, for an error or a table: never the numbers in a tensor or the parts of a module."""
    if isinstance(value, Tensor):
        return f"{type(value).__name__} of shape {tuple(value.shape)}"
    text = type(value).__name__ if isinstance(value, nn.Module) else " ".join(repr(value).split())
    return text if len(text) <= 40 else text[:36] + "..." + text[-1]
