"""A scene that has been read: posed images, the box they look at, and where they came from."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg.errors import InputError

__all__ = ["Scene", "Views", "background_colour"]

# Fraction of the edge that is looked at for a backdrop, and of its pixels that must have the colour up to a bound.
_FRAME, _AGREEING, _CLOSE = 0.02, 0.9, 0.05

_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def background_colour(background: str | Sequence[float] | Tensor) -> Tensor:
    """Return a background as a ``(3,)`` float32 tensor.

    Args:
        background: ``"white"``, ``"black"`` or three numbers in [0, 1].

    Raises:
        InputError: for an unknown name or anything that is not three numbers in [0, 1].

    >>> background_colour("white")
    tensor([1., 1., 1.])
    """
    if isinstance(background, str):
        if background not in _COLOURS:
            raise InputError(
                f"background: found {background!r}, expected one of {sorted(_COLOURS)} or three numbers"
            )
        return torch.tensor(_COLOURS[background])
    colour = torch.as_tensor(background, dtype=torch.float32)
    if colour.shape != (3,) or not bool(((colour >= 0) & (colour <= 1)).all()):
        raise InputError(f"background: found {background!r}, expected three numbers in [0, 1]")
    return colour


@dataclass(frozen=True)
class Views:
    """Images of one size with their cameras.

    Attributes:
        rgba: ``(V, H, W, 4)`` float32 in [0, 1], straight (not premultiplied) alpha.
        poses: ``(V, 4, 4)`` float32 camera-to-world matrices, camera looking along its -z, y up.
        intrinsics: ``(V, 4)`` float32: fx, fy, cx, cy in pixels of these images.
        names: ``V`` names fit for file names, one of a kind.
        ids: ``V`` indices into the frame list of the file that the views were selected from.
    """

    rgba: Tensor
    poses: Tensor
    intrinsics: Tensor
    names: tuple[str, ...]
    ids: tuple[int, ...]

    def __post_init__(self) -> None:
        count = self.rgba.shape[0]
        if self.rgba.ndim != 4 or self.rgba.shape[-1] != 4:
            raise InputError(f"rgba: found shape {tuple(self.rgba.shape)}, expected (V, H, W, 4)")
        if tuple(self.poses.shape) != (count, 4, 4):
            raise InputError(f"poses: found shape {tuple(self.poses.shape)}, expected ({count}, 4, 4)")
        if tuple(self.intrinsics.shape) != (count, 4):
            raise InputError(f"intrinsics: found shape {tuple(self.intrinsics.shape)}, expected ({count}, 4)")
        if len(self.names) != count or len(self.ids) != count:
            raise InputError(
                f"names, ids: found {len(self.names)} and {len(self.ids)}, expected {count} each"
            )

    def __len__(self) -> int:
        return int(self.rgba.shape[0])

    @property
    def height(self) -> int:
        """Rows of every image."""
        return int(self.rgba.shape[1])

    @property
    def width(self) -> int:
        """Columns of every image."""
        return int(self.rgba.shape[2])

    @functools.cached_property
    def backdrop(self) -> Tensor | None:
        """The one colour that opaque images have along their edges (a sheet of paper, a studio), ``(3,)``.

        None where images are transparent, so that nobody needs to guess, and where they show a room.

        Example:
            >>> rgba = torch.ones(1, 50, 50, 4)
            >>> rgba[:, 10:40, 10:40, :3] = 0.2
            >>> views = Views(rgba, torch.eye(4)[None], torch.ones(1, 4), ("a",), (0,))
            >>> views.backdrop.tolist()
            [1.0, 1.0, 1.0]
        """
        if not len(self) or bool((self.rgba[..., 3] < 1).any()):
            return None
        edge = max(1, round(_FRAME * min(self.height, self.width)))
        rgb = self.rgba[..., :3]
        sides = rgb[:, :edge], rgb[:, -edge:], rgb[:, :, :edge], rgb[:, :, -edge:]
        pixels = torch.cat([side.reshape(-1, 3) for side in sides])
        colour = pixels.median(dim=0).values
        agreeing = ((pixels - colour).abs().amax(dim=-1) < _CLOSE).float().mean()
        return colour if float(agreeing) >= _AGREEING else None

    def composited(self, background: str | Sequence[float] | Tensor) -> Tensor:
        """Return the images over one background colour.

        Args:
            background: see :func:`background_colour`.

        Returns:
            ``(V, H, W, 3)`` float32: ``alpha * rgb + (1 - alpha) * background``.
        """
        colour = background_colour(background).to(self.rgba.device)
        alpha = self.rgba[..., 3:]
        return self.rgba[..., :3] * alpha + colour * (1 - alpha)

    def to(self, device: torch.device | str) -> Views:
        """Return the same views with their tensors on ``device``."""
        return Views(
            self.rgba.to(device), self.poses.to(device), self.intrinsics.to(device), self.names, self.ids
        )


@dataclass(frozen=True)
class Scene:
    """A scene under a protocol, ready for training.

    Attributes:
        name: the folder's name, or ``"builtin"``.
        protocol: name of the protocol that selected the views.
        train: views to train on.
        test: views to score on.
        near: distance along a ray, world units, before which nothing is looked for.
        far: distance along a ray, world units, beyond which nothing is looked for.
        bounds: ``(2, 3)`` float32, lower and upper corner of the box that holds the scene, world units.
        background: ``(3,)`` float32, the colour behind renders and targets; that of opaque images' `Views.backdrop`.
        fingerprint: hash of what training sees: the training images' pixels, ids, size and cameras. It does
            not depend on which test or validation views were read, so a checkpoint can be scored on others.
        builtin: whether this is the built-in scene, which no published figure is about.
        validation: views outside both, for tuning, when they were asked for.
        ndc: whether rays are to be mapped to normalised device coordinates (forward-facing scenes).
    """

    name: str
    protocol: str
    train: Views
    test: Views
    near: float
    far: float
    bounds: Tensor
    background: Tensor
    fingerprint: str
    builtin: bool = False
    validation: Views | None = None
    ndc: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.near < self.far:
            raise InputError(f"near, far: found {self.near} and {self.far}, expected 0 <= near < far")
        if tuple(self.bounds.shape) != (2, 3) or not bool((self.bounds[0] < self.bounds[1]).all()):
            raise InputError(
                f"bounds: found {self.bounds.tolist()}, expected (2, 3) with lower corner below upper"
            )
