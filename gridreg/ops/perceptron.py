"""Multi-layer perceptrons, on positional encodings or on numbers as they are.

The compiled version takes rows from their encodings through all layers in one kernel, and back in another.
Its products are float32, or bfloat16 with float32 sums: a value is then off by at most 2^-7 of the largest,
and gradients by 4 % in norm at random weights, most of that from units at the edge of their ReLU, without
bias. Weights stay float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.encodings import positional_encoding
from gridreg.errors import InputError
from gridreg.ops.dispatch import operation

Precision: TypeAlias = Literal["float32", "bfloat16", "auto"]
"""Of products: "auto" is bfloat16 on processors that multiply it (AVX-512 BF16, AMX), float32 on others."""

_PRECISIONS = ("float32", "bfloat16", "auto")


class Layer(NamedTuple):
    """Weight ``(out, in)`` and bias ``(out,)`` or None."""

    weight: Tensor
    bias: Tensor | None


class Block(NamedTuple):
    """One of the inputs of `encoded_mlp`.

    Args:
        x: ``(N, D)``, or ``(R, D)`` with ``rows``.
        octaves: of its positional encoding; 0: as it is.
        rows: ``(N,)`` int64, the row of ``x`` for each sample; None: its own.
    """

    x: Tensor
    octaves: int
    rows: Tensor | None = None

    @property
    def width(self) -> int:
        """Columns of the encoding."""
        return int(self.x.shape[1]) * (1 + 2 * self.octaves)


_Blocks: TypeAlias = Sequence[Block | tuple[Tensor, int]]
_Layers: TypeAlias = Sequence[Layer | tuple[Tensor, Tensor | None]]


def _check_precision(precision: str) -> None:
    if precision not in _PRECISIONS:
        raise InputError(f"precision: found {precision!r}, expected one of {', '.join(_PRECISIONS)}")


@operation(check=_check_precision)
def product_dtype(precision: Precision) -> torch.dtype:
    """Precision in which the CPU multiplies float32 tensors; the plain versions know float32 alone.

    Raises:
        InputError: for an unknown precision.
    """
    return torch.float32


def _check(blocks: _Blocks, layers: _Layers, *, precision: Precision = "auto") -> None:
    _check_precision(precision)
    if not blocks:
        raise InputError("blocks: found none, expected at least one")
    given = [Block(*block) for block in blocks]
    counts = [(x if rows is None else rows).shape[0] for x, _, rows in given]
    for place, (block, found) in enumerate(zip(given, counts, strict=True)):
        if block.x.dim() != 2 or found != counts[0] or block.octaves < 0:
            shape = tuple(block.x.shape)
            raise InputError(
                f"blocks[{place}]: found x {shape} with {found} samples and {block.octaves} octaves, expected "
                f"(N, D) with {counts[0]} samples and at least 0 octaves"
            )
    if not layers:
        raise InputError("layers: found none, expected at least one")
    width = sum(block.width for block in given)
    for place, (weight, bias) in enumerate(layers):
        if weight.dim() != 2 or weight.shape[1] != width:
            raise InputError(
                f"layers[{place}]: found a weight {tuple(weight.shape)}, expected (out, {width})"
            )
        width = weight.shape[0]
        if bias is not None and tuple(bias.shape) != (width,):
            raise InputError(f"layers[{place}]: found a bias {tuple(bias.shape)}, expected ({width},)")


@operation(check=_check)
def encoded_mlp(blocks: _Blocks, layers: _Layers, *, precision: Precision = "auto") -> Tensor:
    """Linear layers with ReLU between them, on the positional encodings of several inputs, side by side.

    Args:
        blocks: inputs; each is encoded in the order "octave", itself first. One alone and without octaves may
            be of `product_dtype`, and then its gradient is.
        layers: pairs of weight ``(out, in)`` and bias ``(out,)`` or None; the first reads all encodings.
        precision: of products; taken into account on the CPU, in float32, for layers of up to 512 units.

    Returns:
        ``(N, out)`` of the last layer, without activation; differentiable once.

    Raises:
        InputError: for an unknown precision, no blocks or layers, or shapes that do not fit.

    Example:
        >>> layer = Layer(torch.ones(1, 5), None)
        >>> rays = Block(torch.tensor([[1.0, 2.0]]), 0, torch.tensor([0, 0]))
        >>> encoded_mlp([(torch.zeros(2, 1), 1), rays], [layer], precision="float32").tolist()
        [[4.0], [4.0]]
    """
    parts = []
    for x, octaves, rows in (Block(*block) for block in blocks):
        encoded = positional_encoding(x, octaves) if octaves else x
        parts.append(encoded if rows is None else encoded.index_select(0, rows))
    value = parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
    value = value.to(layers[0][0].dtype)
    for place, (weight, bias) in enumerate(layers):
        value = F.linear(torch.relu(value) if place else value, weight, bias)
    return value


def mlp(x: Tensor, layers: _Layers, *, precision: Precision = "auto") -> Tensor:
    """Linear layers with ReLU between them.

    Args:
        x: ``(N, in)``, of the weights' dtype or of `product_dtype`, and then its gradient is.
        layers: pairs of weight ``(out, in)`` and bias ``(out,)`` or None.
        precision: see `encoded_mlp`.

    Returns:
        ``(N, out)`` of the last layer, without activation; differentiable once.

    Raises:
        InputError: for an unknown precision, no layers, or shapes that do not fit.

    Example:
        >>> layer = Layer(torch.tensor([[1.0], [-1.0]]), None), Layer(torch.ones(1, 2), torch.ones(1))
        >>> mlp(torch.tensor([[2.0], [-3.0]]), layer, precision="float32").tolist()
        [[3.0], [4.0]]
    """
    if x.dim() != 2:
        raise InputError(f"x: found shape {tuple(x.shape)}, expected (N, in)")
    return encoded_mlp([Block(x, 0)], layers, precision=precision)
