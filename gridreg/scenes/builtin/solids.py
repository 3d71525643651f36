"""Convex solids with exact ray intersections, distances and normals, each in a frame of its own.

The distance formulas are those of I. Quilez, "Distance functions" (sdSphere, sdBox, sdCappedCone);
the intersections follow from the implicit equations.
Ray directions need no unit length: parameters scale with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ball", "Cuboid", "Frustum", "Solid", "rotate"]

Array = NDArray[np.float64]

_TINY = 1e-12
_ON_SURFACE = 1e-9


def rotate(vectors: Array, matrix: Array) -> Array:
    """Return ``vectors @ matrix`` for ``(N, 3)`` and ``(3, 3)``.

    Written out because waking the threads of a BLAS for three columns costs more than the product.
    """
    x, y, z = vectors[:, :1], vectors[:, 1:2], vectors[:, 2:]
    return np.asarray(x * matrix[0] + y * matrix[1] + z * matrix[2])


def _nearest(*candidates: Array) -> Array:
    """Return the smallest positive candidate."""
    best = np.full_like(candidates[0], np.inf)
    for candidate in candidates:
        np.minimum(best, np.where(candidate > 0, candidate, np.inf), out=best)
    return best


def _away_from_zero(values: Array) -> Array:
    return np.where(np.abs(values) < _TINY, _TINY, values)


@dataclass(frozen=True)
class Ball:
    """A sphere of ``radius`` around the origin."""

    radius: float

    @property
    def middle(self) -> tuple[float, float, float]:
        """Centre of a ball that contains the body."""
        return (0.0, 0.0, 0.0)

    @property
    def reach(self) -> float:
        """Radius of that ball."""
        return self.radius

    @property
    def area(self) -> float:
        """Surface area, square world units."""
        return 4 * np.pi * self.radius**2

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the smallest positive ray parameter at the surface, ``inf`` where there is none.

        Args:
            origin: ``(3,)``, common to all rays.
            direction: ``(3, ...)``, of any length.

        Returns:
            ``(...)``.
        """
        a = (direction * direction).sum(axis=0)
        b = np.tensordot(origin, direction, axes=1)
        inside_root = b * b - a * (origin @ origin - self.radius**2)
        root = np.sqrt(np.maximum(inside_root, 0))
        t = _nearest((-b - root) / a, (-b + root) / a)
        return np.where(inside_root < 0, np.inf, t)

    def distance(self, points: Array) -> Array:
        """Return the signed distance of ``(N, 3)`` points, ``(N,)``, negative inside."""
        return np.asarray(np.linalg.norm(points, axis=-1) - self.radius)

    def normal(self, points: Array) -> Array:
        """Return the outward unit normals at ``(N, 3)`` points on the surface."""
        return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Return ``(count, 3)`` points uniform on the surface."""
        return self.radius * self.normal(rng.standard_normal((count, 3)))


@dataclass(frozen=True)
class Cuboid:
    """A box of half extents ``half`` around the origin."""

    half: tuple[float, float, float]

    @property
    def middle(self) -> tuple[float, float, float]:
        """Centre of a ball that contains the body."""
        return (0.0, 0.0, 0.0)

    @property
    def reach(self) -> float:
        """Radius of that ball."""
        return float(np.linalg.norm(self.half))

    @property
    def area(self) -> float:
        """Surface area, square world units."""
        x, y, z = self.half
        return 8 * (x * y + y * z + z * x)

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the smallest positive ray parameter at the surface, ``inf`` where there is none.

        Args:
            origin: ``(3,)``, common to all rays.
            direction: ``(3, ...)``, of any length.

        Returns:
            ``(...)``.
        """
        entry: Array = np.full(direction.shape[1:], -np.inf)
        leave: Array = np.full(direction.shape[1:], np.inf)
        for axis in range(3):
            inverse = 1 / _away_from_zero(direction[axis])
            low = (-self.half[axis] - origin[axis]) * inverse
            high = (self.half[axis] - origin[axis]) * inverse
            entry = np.maximum(entry, np.minimum(low, high))
            leave = np.minimum(leave, np.maximum(low, high))
        return np.where(entry > leave, np.inf, _nearest(entry, leave))

    def distance(self, points: Array) -> Array:
        """Return the signed distance of ``(N, 3)`` points, ``(N,)``, negative inside."""
        gap = np.abs(points) - self.half
        outside = np.linalg.norm(np.maximum(gap, 0), axis=-1)
        return np.asarray(outside + np.minimum(gap.max(axis=-1), 0))

    def normal(self, points: Array) -> Array:
        """Return the outward unit normals at ``(N, 3)`` points on the surface."""
        axis = (np.abs(points) - self.half).argmax(axis=-1)
        rows = np.arange(len(points))
        normals = np.zeros_like(points)
        normals[rows, axis] = np.sign(points[rows, axis])
        return normals

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Return ``(count, 3)`` points uniform on the surface."""
        half = np.array(self.half)
        faces = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        axis = rng.choice(3, count, p=faces / faces.sum())
        points = rng.uniform(-1, 1, (count, 3)) * half
        rows = np.arange(count)
        points[rows, axis] = rng.choice([-1.0, 1.0], count) * half[axis]
        return np.asarray(points)


@dataclass(frozen=True)
class Frustum:
    """A cylinder or cone about z, from radius ``low`` at z = 0 to radius ``high`` at z = ``height``."""

    low: float
    high: float
    height: float

    @property
    def middle(self) -> tuple[float, float, float]:
        """Centre of a ball that contains the body."""
        return (0.0, 0.0, self.height / 2)

    @property
    def reach(self) -> float:
        """Radius of that ball."""
        return float(np.hypot(self.height / 2, max(self.low, self.high)))

    @property
    def _slant(self) -> float:
        return float(np.hypot(self.height, self.high - self.low))

    @property
    def area(self) -> float:
        """Surface area, square world units."""
        return float(np.pi * (self.low**2 + self.high**2 + (self.low + self.high) * self._slant))

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the smallest positive ray parameter at the surface, ``inf`` where there is none.

        Args:
            origin: ``(3,)``, common to all rays.
            direction: ``(3, ...)``, of any length.

        Returns:
            ``(...)``.
        """
        slope = (self.high - self.low) / self.height
        x, y, z = direction
        ring = self.low + slope * origin[2]
        a = _away_from_zero(x * x + y * y - slope**2 * z * z)
        b = origin[0] * x + origin[1] * y - ring * slope * z
        inside_root = b * b - a * (origin[0] ** 2 + origin[1] ** 2 - ring**2)
        # A line through the body meets its endless cone, and few lines of a window around a narrow rod do.
        meets = np.nonzero(inside_root >= 0)
        a, b, x, y, z = a[meets], b[meets], x[meets], y[meets], z[meets]
        root = np.sqrt(inside_root[meets])
        candidates = []
        for t in ((-b - root) / a, (-b + root) / a):
            level = origin[2] + t * z
            candidates.append(np.where((level >= 0) & (level <= self.height), t, np.inf))
        inverse = 1 / _away_from_zero(z)
        for level, radius in ((0.0, self.low), (self.height, self.high)):
            t = (level - origin[2]) * inverse
            on_cap = (origin[0] + t * x) ** 2 + (origin[1] + t * y) ** 2 <= radius**2
            candidates.append(np.where(on_cap, t, np.inf))
        nearest: Array = np.full(inside_root.shape, np.inf)
        nearest[meets] = _nearest(*candidates)
        return nearest

    def distance(self, points: Array) -> Array:
        """Return the signed distance of ``(N, 3)`` points, ``(N,)``, negative inside."""
        radius, level = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
        half = self.height / 2
        cap_x = radius - np.minimum(radius, np.where(level < half, self.low, self.high))
        cap_y = np.abs(level - half) - half
        along = np.array([self.high - self.low, self.height])
        fraction = np.clip(((radius - self.low) * along[0] + level * along[1]) / (along @ along), 0, 1)
        side_x, side_y = radius - self.low - along[0] * fraction, level - along[1] * fraction
        inside = (side_x < 0) & (cap_y < 0)
        squared = np.minimum(cap_x**2 + cap_y**2, side_x**2 + side_y**2)
        return np.asarray(np.where(inside, -1, 1) * np.sqrt(squared))

    def normal(self, points: Array) -> Array:
        """Return the outward unit normals at ``(N, 3)`` points on the surface."""
        radius = np.hypot(points[:, 0], points[:, 1])
        outward = np.where(
            radius[:, None] > _TINY, points[:, :2] / _away_from_zero(radius)[:, None], [1.0, 0.0]
        )
        normals = np.empty_like(points)
        normals[:, :2] = outward * (self.height / self._slant)
        normals[:, 2] = (self.low - self.high) / self._slant
        # How far below the side's line a point lies says whether it is on a cap.
        slope = (self.high - self.low) / self.height
        sunk = (self.low + slope * points[:, 2] - radius) * self.height / self._slant
        for level, up in ((0.0, -1.0), (self.height, 1.0)):
            on_cap = (np.abs(points[:, 2] - level) <= _ON_SURFACE) & (sunk > _ON_SURFACE)
            normals[on_cap] = [0.0, 0.0, up]
        return normals

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Return ``(count, 3)`` points uniform on the surface."""
        parts = np.array([self.low**2, self.high**2, (self.low + self.high) * self._slant])
        part = rng.choice(3, count, p=parts / parts.sum())
        u, angle = rng.uniform(size=count), rng.uniform(0, 2 * np.pi, count)
        on_side = np.sqrt(self.low**2 + u * (self.high**2 - self.low**2))
        radius = np.choose(part, [self.low * np.sqrt(u), self.high * np.sqrt(u), on_side])
        grown = self.high - self.low
        fraction = (on_side - self.low) / grown if grown else u
        level = np.choose(part, [np.zeros(count), np.full(count, self.height), fraction * self.height])
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), level], axis=-1)


Solid = Ball | Cuboid | Frustum
"""A convex body, on or around the origin of its frame."""
