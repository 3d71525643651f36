"""Positional encodings that know the octave of every channel, in the three orders of published programs."""

from __future__ import annotations

from typing import Literal, TypeAlias, TypeVar

import torch
from torch import Tensor, nn

from gridreg.errors import InputError

Order: TypeAlias = Literal["octave", "sines_first", "coordinate"]
"""Order of the channels: see `positional_encoding`."""

IncludeInput: TypeAlias = bool | Literal["last"]
"""Whether the input itself is encoded too, and where."""

Part = TypeVar("Part")


def positional_encoding(
    x: Tensor, octaves: int, order: Order = "octave", include_input: IncludeInput = True, scale: float = 1.0
) -> Tensor:
    """Sines and cosines of `scale * 2^k * x` for the octaves k = 0, 1, ..., in one of three orders.

    * "octave": x, sin of octave 0, cos of octave 0, sin of octave 1, ...; a prefix is low frequencies.
    * "sines_first": x, all sines, octave by octave, then all cosines (FreeNeRF's program); half-way through a
      prefix mask, every sine is open.
    * "coordinate": x, all sines, coordinate by coordinate, then all cosines (TensoRF, nerfstudio, Few
      TensoRF); a prefix hides axes.

    Args:
        x: shape `(..., D)`.
        octaves: number of octaves, from 0.
        order: order of the channels.
        include_input: True: x itself comes first; "last": at the end, as in nerfstudio; False: not at all.
        scale: factor of all frequencies; pi in the papers, 1 in most programs.

    Returns:
        Shape `(..., 2 * D * octaves)`, and `D` more with the input.

    Raises:
        InputError: the order or the place of the input is unknown, or octaves is negative.

    Source: NeRF (Mildenhall et al., ECCV 2020), equation 4.

    >>> x = torch.tensor([0.5, 0.0])
    >>> positional_encoding(x, 1, "octave")
    tensor([0.5000, 0.0000, 0.4794, 0.0000, 0.8776, 1.0000])
    """
    _check(octaves, order, include_input)
    frequencies = scale * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    if order == "coordinate":
        angles = x[..., :, None] * frequencies  # (..., D, K)
        parts = [angles.sin().flatten(-2), angles.cos().flatten(-2)]
    else:
        angles = x[..., None, :] * frequencies[:, None]  # (..., K, D)
        if order == "sines_first":
            parts = [angles.sin().flatten(-2), angles.cos().flatten(-2)]
        else:
            parts = [torch.stack([angles.sin(), angles.cos()], dim=-2).flatten(-3)]
    return torch.cat(_with_input(parts, [x], include_input), dim=-1)


def octaves_of_channels(
    dimensions: int, octaves: int, order: Order = "octave", include_input: IncludeInput = True
) -> tuple[int, ...]:
    """Octave of every channel of `positional_encoding`, -1 for the input itself.

    Args:
        dimensions: number of coordinates, D.
        octaves, order, include_input: as in `positional_encoding`.

    >>> octaves_of_channels(2, 2, "octave")
    (-1, -1, 0, 0, 0, 0, 1, 1, 1, 1)
    >>> octaves_of_channels(2, 2, "coordinate")
    (-1, -1, 0, 1, 0, 1, 0, 1, 0, 1)

    Raises:
        InputError: the order or the place of the input is unknown, or octaves is negative.
    """
    _check(octaves, order, include_input)
    if order == "coordinate":
        found = list(range(octaves)) * (2 * dimensions)
    elif order == "octave":
        found = [octave for octave in range(octaves) for _ in range(2 * dimensions)]
    else:
        found = [octave for octave in range(octaves) for _ in range(dimensions)] * 2
    return tuple(_with_input(found, [-1] * dimensions, include_input))


class PositionalEncoding(nn.Module):
    """Module form of `positional_encoding`; `gridreg.outputs` on it knows the octave of every channel.

    Attributes:
        channels: number of output channels.
        channel_octaves: octave of each, -1 for the input itself.

    >>> encoding = PositionalEncoding(3, octaves=4)
    >>> encoding.channels, encoding(torch.zeros(5, 3)).shape
    (27, torch.Size([5, 27]))
    """

    def __init__(
        self,
        dimensions: int,
        octaves: int,
        order: Order = "octave",
        include_input: IncludeInput = True,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.channel_octaves = octaves_of_channels(dimensions, octaves, order, include_input)
        self.channels = len(self.channel_octaves)
        self.octaves = octaves
        self.order: Order = order
        self.include_input: IncludeInput = include_input
        self.scale = scale

    def forward(self, x: Tensor) -> Tensor:
        """Encode `(..., D)` as `(..., channels)`."""
        return positional_encoding(x, self.octaves, self.order, self.include_input, self.scale)

    def extra_repr(self) -> str:
        """Settings, for `print(module)`."""
        return f"octaves={self.octaves}, order={self.order!r}, channels={self.channels}"


def _with_input(parts: list[Part], identity: list[Part], include_input: IncludeInput) -> list[Part]:
    """The parts of an encoding with the input where it belongs."""
    if include_input == "last":
        return parts + identity
    return identity + parts if include_input else parts


def _check(octaves: int, order: str, include_input: object) -> None:
    if include_input not in (True, False, "last"):
        raise InputError(f"include_input={include_input!r}: expected True, False or 'last'")
    if order not in ("octave", "sines_first", "coordinate"):
        raise InputError(f"order={order!r}: expected 'octave', 'sines_first' or 'coordinate'")
    if isinstance(octaves, bool) or not isinstance(octaves, int) or octaves < 0:
        raise InputError(f"octaves={octaves!r}: expected a number of octaves, an int from 0")
