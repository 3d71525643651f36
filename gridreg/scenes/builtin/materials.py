"""Procedural colours and the shading of the built-in scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Material", "bricks", "checker", "plain", "shade", "speckle", "spiral", "strata"]

Array = NDArray[np.float64]
Colour = tuple[float, float, float]
Texture = Callable[[Array], Array]

_SUN = np.array([0.45, -0.6, 0.66])
_FILL = np.array([-0.7, 0.5, 0.2])


@dataclass(frozen=True)
class Material:
    """Appearance of a part.

    Attributes:
        texture: colour in [0, 1] at ``(N, 3)`` points in the part's frame.
        gloss: strength of the highlights, which move with the camera; 0 is matt.
        sharpness: exponent of the highlights.
    """

    texture: Texture
    gloss: float = 0.0
    sharpness: float = 40.0


def shade(material: Material, local: Array, normals: Array, to_camera: Array) -> Array:
    """Return ``(N, 3)`` colours in [0, 1]: Lambert under two lights and the sky, Blinn-Phong highlights.

    Args:
        material: what the points are made of.
        local: ``(N, 3)`` points in the part's frame, for the texture.
        normals: ``(N, 3)`` outward, world.
        to_camera: ``(N, 3)`` unit vectors towards the camera, world.
    """
    sun = _SUN / np.linalg.norm(_SUN)
    fill = _FILL / np.linalg.norm(_FILL)
    light = (
        0.42
        + 0.10 * normals[:, 2]
        + 0.56 * np.maximum(_dot(normals, sun), 0)
        + 0.2 * np.maximum(_dot(normals, fill), 0)
    )
    colour = material.texture(local) * light[:, None]
    if material.gloss:
        for direction, strength in ((sun, 1.0), (fill, 0.5)):
            halfway = to_camera + direction
            halfway /= np.linalg.norm(halfway, axis=-1, keepdims=True)
            spot = np.maximum(_dot(normals, halfway), 0) ** material.sharpness
            colour += (material.gloss * strength * spot)[:, None]
        # Schlick's approximation of Fresnel reflection of a white sky.
        grazing = (1 - np.clip(_dot(normals, to_camera), 0, 1)) ** 5
        colour += (0.6 * material.gloss * grazing)[:, None] * (1 - colour)
    return np.asarray(np.clip(colour, 0, 1))


def _dot(a: Array, b: Array) -> Array:
    """Return the dot products of ``(N, 3)`` and ``(N, 3)`` or ``(3,)``."""
    return np.asarray(a[:, 0] * b[..., 0] + a[:, 1] * b[..., 1] + a[:, 2] * b[..., 2])


def _choose(second: NDArray[np.bool_], a: Colour, b: Colour) -> Array:
    return np.where(second[:, None], np.array(b), np.array(a))


def plain(colour: Colour) -> Texture:
    """One colour everywhere."""
    return lambda points: np.broadcast_to(np.array(colour), points.shape).copy()


def checker(a: Colour, b: Colour, edge: float) -> Texture:
    """Cubes of ``edge`` world units in two colours."""

    def texture(points: Array) -> Array:
        # The shift keeps faces at multiples of the edge from flickering between two cells.
        cells = np.floor(points / edge + 0.3137).astype(np.int64).sum(axis=-1)
        return _choose(cells % 2 == 1, a, b)

    return texture


def spiral(a: Colour, b: Colour, *, pitch: float, starts: int = 1) -> Texture:
    """Bands that wind about z and rise by ``pitch`` world units per turn, ``starts`` of them side by side."""

    def texture(points: Array) -> Array:
        turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + points[:, 2] / pitch
        return _choose(np.floor(2 * starts * turn) % 2 == 1, a, b)

    return texture


def bricks(a: Colour, mortar: Colour, *, length: float, height: float) -> Texture:
    """Courses of bricks around z, each shifted by half a brick against the one below."""

    def texture(points: Array) -> Array:
        along = (points[:, 0] + points[:, 1]) / length
        course = points[:, 2] / height
        row = np.floor(course)
        joint = ((along + 0.5 * (row % 2)) % 1 < 0.12) | (course % 1 < 0.18)
        tint = 0.85 + 0.3 * _hash(np.floor(along + 0.5 * (row % 2)), row, np.zeros_like(row))
        return np.where(joint[:, None], np.array(mortar), np.array(a) * tint[:, None])

    return texture


def strata(a: Colour, b: Colour, *, thickness: float) -> Texture:
    """Wavy layers of rock across z."""

    def texture(points: Array) -> Array:
        wave = 0.35 * np.sin(7 * points[:, 0]) + 0.35 * np.sin(9 * points[:, 1] + 1)
        fraction = 0.5 + 0.5 * np.sin(2 * np.pi * (points[:, 2] / thickness + wave))
        return np.asarray(np.array(a) + fraction[:, None] * (np.array(b) - np.array(a)))

    return texture


def speckle(a: Colour, b: Colour, *, grain: float) -> Texture:
    """Cells of ``grain`` world units, each with a random mix of two colours."""

    def texture(points: Array) -> Array:
        fraction = _hash(*np.floor(points / grain + 0.3137).T)
        return np.asarray(np.array(a) + fraction[:, None] * (np.array(b) - np.array(a)))

    return texture


def _hash(x: Array, y: Array, z: Array) -> Array:
    """Return a number in [0, 1) for every integer cell, the same on every machine."""
    mixed = np.zeros(x.shape, dtype=np.uint32)
    for axis, factor in ((x, 73856093), (y, 19349663), (z, 83492791)):
        mixed ^= axis.astype(np.int64).astype(np.uint32) * np.uint32(factor)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(2246822519)
    mixed ^= mixed >> np.uint32(13)
    return mixed.astype(np.float64) / 2**32
