"""A scene that has been read: posed images, the box they look at, and where they came from."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering.cameras import Camera, cameras_of
from gridreg.scenes.gate import check_cameras, check_extent
from gridreg.scenes.notebook import card, thumbnails
from gridreg.scenes.pixels import as_floats
from gridreg.scenes.silhouettes import backdrop_of, is_opaque, silhouettes_before

__all__ = ["IN_PLACE", "Scene", "Views", "World", "background_colour"]

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


class World(NamedTuple):
    """World of a scene's files: ``files = origin + unit * scene``, so that neither unit nor origin of length
    matters.

    Attributes:
        origin: ``(3,)`` the scene's origin in the world of the files.
        unit: length of the scene's unit there.
        metric: whether the unit of the files is known to be the metre.

    Example:
        >>> World((10.0, 0.0, 0.0), 100.0).outward(np.array([[1.0, 2.0, 0.0]])).tolist()
        [[110.0, 200.0, 0.0]]
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: float = 1.0
    metric: bool = False

    def __str__(self) -> str:
        # Fingerprints of scenes hold it, so it never changes.
        return f"World(origin={self.origin}, unit={self.unit})"

    def outward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``(..., 3)`` points of the scene in the world of the files."""
        return np.asarray(self.unit * points + self.origin)

    def inward(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``(V, 4, 4)`` poses of the files' world in the scene; an identity leaves every bit."""
        moved: NDArray[np.float64] = poses.copy()
        if self != World():
            moved[:, :3, 3] = (poses[:, :3, 3] - self.origin) / self.unit
        return moved


IN_PLACE = World()
"""The world of a scene that stays where its files have it."""


@dataclass(frozen=True, repr=False)
class Views:
    """Images of one size with their cameras.

    Attributes:
        pixels: ``(V, H, W, 4)`` straight (not premultiplied) alpha; float32 in [0, 1], or uint8 where every value
            is a whole number of 255ths, which takes a quarter of the memory.
        poses: ``(V, 4, 4)`` float32 camera-to-world matrices, camera looking along its -z, y up.
        intrinsics: ``(V, 4)`` float32: fx, fy, cx, cy in pixels of these images.
        names: ``V`` names fit for file names, one of a kind.
        ids: ``V`` indices into the frame list of the file that the views were selected from.
    """

    pixels: Tensor
    poses: Tensor
    intrinsics: Tensor
    names: tuple[str, ...]
    ids: tuple[int, ...]

    def __post_init__(self) -> None:
        count = self.pixels.shape[0]
        if self.pixels.ndim != 4 or self.pixels.shape[-1] != 4:
            raise InputError(f"pixels: found shape {tuple(self.pixels.shape)}, expected (V, H, W, 4)")
        if self.pixels.dtype not in (torch.float32, torch.uint8):
            raise InputError(f"pixels: found {self.pixels.dtype}, expected float32 in [0, 1] or uint8")
        if tuple(self.poses.shape) != (count, 4, 4):
            raise InputError(f"poses: found shape {tuple(self.poses.shape)}, expected ({count}, 4, 4)")
        if tuple(self.intrinsics.shape) != (count, 4):
            raise InputError(f"intrinsics: found shape {tuple(self.intrinsics.shape)}, expected ({count}, 4)")
        if len(self.names) != count or len(self.ids) != count:
            raise InputError(
                f"names, ids: found {len(self.names)} and {len(self.ids)}, expected {count} each"
            )
        called = [f"view {name!r}" for name in self.names]
        check_cameras(self.poses.cpu(), self.intrinsics.cpu(), (self.width, self.height), called)

    def __len__(self) -> int:
        return int(self.pixels.shape[0])

    def __repr__(self) -> str:
        return f"Views({len(self)} of {self.width}x{self.height})"

    @property
    def height(self) -> int:
        """Rows of every image."""
        return int(self.pixels.shape[1])

    @property
    def width(self) -> int:
        """Columns of every image."""
        return int(self.pixels.shape[2])

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each image."""
        return cameras_of(self.poses, self.intrinsics, self.height, self.width)

    @property
    def rgba(self) -> Tensor:
        """All pixels as ``(V, H, W, 4)`` float32: a copy of all of them if they are stored as bytes."""
        return as_floats(self.pixels)

    def image(self, number: int) -> Tensor:
        """Return one image, ``(H, W, 4)`` float32."""
        return as_floats(self.pixels[number])

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
        return backdrop_of(self.pixels)

    @property
    def shows_room(self) -> bool:
        """Whether there is something behind the object: images are opaque, and not before a `backdrop`."""
        return self.backdrop is None and is_opaque(self.pixels)

    @functools.cached_property
    def silhouettes(self) -> Tensor:
        """Alpha as far as it is known, ``(V, H, W)``: that of the images; before a `backdrop`, what colours tell.

        NaN where they do not, see `gridreg.scenes.silhouettes`.
        """
        if self.backdrop is None:
            return as_floats(self.pixels[..., 3])
        return silhouettes_before(self.pixels, self.backdrop)

    @property
    def plain(self) -> list[str]:
        """Names of the images that show nothing but one colour."""
        found = []
        # One image after the other: copies of all of them would take as much memory as they do.
        for name, stored in zip(self.names, self.pixels, strict=True):
            rgba = as_floats(stored)
            alpha = rgba[..., 3:]
            pixels = torch.cat([rgba[..., :3] * alpha, alpha], dim=-1).flatten(0, 1)
            if bool((pixels.amax(dim=0) - pixels.amin(dim=0)).amax() < 1 / 255):
                found.append(name)
        return found

    def composited(self, background: str | Sequence[float] | Tensor) -> Tensor:
        """Return the images over one background colour.

        Args:
            background: see :func:`background_colour`.

        Returns:
            ``(V, H, W, 3)`` float32: ``alpha * rgb + (1 - alpha) * background``.
        """
        colour = background_colour(background).to(self.pixels.device)
        composited = colour.new_empty((*self.pixels.shape[:3], 3))
        for number, target in enumerate(composited):
            target.copy_(self.over(number, colour))
        return composited

    def over(self, number: int, colour: Tensor) -> Tensor:
        """Return one image ``(H, W, 3)`` over a colour ``(3,)``, see `composited`."""
        rgba, colour = self.image(number), colour.to(self.pixels.device)
        return rgba[..., :3] * rgba[..., 3:] + colour * (1 - rgba[..., 3:])

    def to(self, device: torch.device | str) -> Views:
        """Return the same views with their tensors on ``device``."""
        return Views(
            self.pixels.to(device), self.poses.to(device), self.intrinsics.to(device), self.names, self.ids
        )


@dataclass(frozen=True, repr=False)
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
        background: ``(3,)`` float32, the colour behind renders and targets; that of opaque images'
            `Views.backdrop`.
        fingerprint: hash of what training sees: the training images' pixels, ids, size and cameras. It does
            not depend on which test or validation views were read, so a checkpoint can be scored on others.
        builtin: whether this is the built-in scene, which no published figure is about.
        validation: views outside both, for tuning, when they were asked for.
        ndc: whether rays are to be mapped to normalised device coordinates (forward-facing scenes).
        world: where the scene lies in the world of its files; poses, box and distances here are those of the
            scene.
        notes: what a user should know about how the files were understood, a line each.
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
    world: World = IN_PLACE
    notes: tuple[str, ...] = ()

    def to(self, device: torch.device | str) -> Scene:
        """Return the same scene with what training reads on ``device``; views to score stay, as renders do."""
        return replace(
            self,
            train=self.train.to(device),
            bounds=self.bounds.to(device),
            background=self.background.to(device),
        )

    def __post_init__(self) -> None:
        positions = torch.cat([views.poses[:, :3, 3].cpu() for views in (self.train, self.test)])
        check_extent(self.near, self.far, self.bounds.cpu(), positions)

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {self.protocol}, train={self.train!r}, test={self.test!r})"

    def _repr_html_(self) -> str:
        """The training views as notebooks show them."""
        facts = f"{self.protocol}: {self.train!r} to train on, {self.test!r} to score on"
        return card(
            self.name, facts, thumbnails(self.train.over(i, self.background) for i in range(len(self.train)))
        )
