"""Bundle adjustment of photographs of the sheet: lenses and poses together, from the corners of markers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import least_squares  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from gridreg.scenes.board import Board
from gridreg.scenes.frames import Frame, StatedIntrinsics
from gridreg.scenes.lens import LensDistortion

__all__ = ["TURNED", "BundleAdjustment", "Photograph"]

Array = NDArray[np.float64]

# Of corners: noise that is assumed at first, and the least one, in longer edges.
_NOISE, _LEAST_NOISE = 0.3 / 1200, 0.02 / 1200
# How uncertain a lens is before photographs say more: logarithm of the focal length with and without EXIF data, the
# principal point in longer edges, and k1 and k2.
_FOCAL_KNOWN, _FOCAL_OPEN, _CENTRE, _RADIAL = 0.05, 0.5, 0.01, 0.1
# Focal lengths that are tried without EXIF data, in longer edges: from wide angle to tele.
_TRIED = (0.6, 0.75, 1.0, 1.5, 2.5)
_MOST_TOGETHER = 40

TURNED: dict[Image.Transpose | None, list[list[int]]] = {
    None: [[1, 0], [0, 1]],
    Image.Transpose.FLIP_LEFT_RIGHT: [[-1, 0], [0, 1]],
    Image.Transpose.ROTATE_180: [[-1, 0], [0, -1]],
    Image.Transpose.FLIP_TOP_BOTTOM: [[1, 0], [0, -1]],
    Image.Transpose.TRANSPOSE: [[0, 1], [1, 0]],
    Image.Transpose.ROTATE_270: [[0, -1], [1, 0]],
    Image.Transpose.TRANSVERSE: [[0, -1], [-1, 0]],
    Image.Transpose.ROTATE_90: [[0, 1], [-1, 0]],
}
"""Where a step in the stored image leads in the upright one, columns for its x and y."""


@dataclass
class Photograph:
    """A photograph of the sheet, and where its markers are.

    Attributes:
        name: of the file.
        size: width and height, upright.
        turn: how it was turned from what was stored.
        lens: what its lens has in common with that of others: telephone, focal length, size.
        focal: focal length in pixels that EXIF data note, if they do.
        markers: corners by number, see :func:`find_markers`.
    """

    name: str
    size: tuple[int, int]
    turn: Image.Transpose | None
    lens: tuple[Any, ...]
    focal: float | None
    markers: dict[int, Array]


class BundleAdjustment:
    """Lenses and poses, and what they are adjusted to: 5 numbers for a lens, 6 for a pose.

    A lens is ``log f``, its principal point's distance from the middle of the stored image, and ``k1, k2``.

    Args:
        board: the sheet.
        photographs: with their markers.
    """

    def __init__(self, board: Board, photographs: Sequence[Photograph]) -> None:
        self.photographs = photographs
        lenses = sorted({p.lens for p in photographs}, key=str)
        self.lens = np.array([lenses.index(p.lens) for p in photographs])
        self.longest = np.array([float(max(p.size)) for p in photographs])
        self.middle = np.array([p.size for p in photographs]) / 2
        self.turned = np.array([TURNED[p.turn] for p in photographs], dtype=np.float64)
        self.points = [
            np.concatenate([np.pad(board.corners[n], ((0, 0), (0, 1))) for n in p.markers])
            for p in photographs
        ]
        self.seen = [np.concatenate(list(p.markers.values())) for p in photographs]
        self.of = np.repeat(np.arange(len(photographs)), [len(points) for points in self.points])
        focal = [
            [p.focal / max(p.size) for p in photographs if p.lens == lens and p.focal] for lens in lenses
        ]
        self.known = np.array([bool(values) for values in focal])
        self.lenses = np.zeros((len(lenses), 5))
        self.lenses[:, 0] = [math.log(np.median(values)) if values else math.log(0.75) for values in focal]
        self.prior = self.lenses[:, 0].copy()
        self.poses = np.zeros((len(photographs), 6))
        self.noise = _NOISE

    def start(self) -> None:
        """Place each photograph by itself, at the focal length of its lens that fits best."""
        for lens, known in enumerate(self.known):
            own = np.flatnonzero(self.lens == lens)
            tried = [math.exp(self.prior[lens])] if known else list(_TRIED)
            results = [[_on_plane(self, k, focal) for k in own.tolist()] for focal in tried]
            best = min(range(len(tried)), key=lambda k: float(np.median([off for _, off in results[k]])))
            self.lenses[lens, 0] = math.log(tried[best])
            self.poses[own] = [pose for pose, _ in results[best]]

    def solve(self) -> None:
        """Adjust everything together; of many photographs, some give the lenses, and the others follow."""
        count = len(self.photographs)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_TOGETHER)).round().astype(int))
        self._adjust(chosen, with_lenses=True)
        # Once more, with lenses as sure as the corners turned out to be.
        self.noise = max(float(np.median((self.median_off() / self.longest)[chosen])), _LEAST_NOISE)
        self._adjust(chosen, with_lenses=True)
        for k in np.setdiff1d(np.arange(count), chosen):
            self._adjust(np.array([k]), with_lenses=False)

    def _adjust(self, chosen: NDArray[np.int64], *, with_lenses: bool) -> None:
        points, seen = (np.concatenate([each[k] for k in chosen]) for each in (self.points, self.seen))
        of = np.repeat(chosen, [len(self.points[k]) for k in chosen])
        head = self.lenses.size if with_lenses else 0

        def put(values: Array) -> None:
            if with_lenses:
                self.lenses = values[:head].reshape(-1, 5)
            self.poses[chosen] = values[head:].reshape(-1, 6)

        def residuals(values: Array) -> Array:
            put(values)
            off = (self._project(points, of) - seen) / (self.noise * self.longest[of, None])
            spread = np.where(self.known, _FOCAL_KNOWN, _FOCAL_OPEN)
            prior = (self.lenses - np.eye(5)[0] * self.prior[:, None]) / [
                1.0,
                _CENTRE,
                _CENTRE,
                _RADIAL,
                _RADIAL,
            ]
            prior[:, 0] /= spread
            return np.concatenate([off.ravel(), prior.ravel()])

        start = np.concatenate([self.lenses.ravel()[:head], self.poses[chosen].ravel()])
        put(least_squares(residuals, start, loss="soft_l1", f_scale=3.0, x_scale="jac", max_nfev=100).x)

    def _project(self, points: Array, of: NDArray[np.int64]) -> Array:
        """Return where ``(N, 3)`` points of the sheet lie in the photographs ``of`` them, ``(N, 2)`` pixels."""
        turns = Rotation.from_rotvec(self.poses[:, :3]).as_matrix()[of]
        x, y, z = (np.einsum("nij,nj->ni", turns, points) + self.poses[of, 3:]).T
        x, y = x / z, y / z
        lens = self.lenses[self.lens[of]]
        r2 = x * x + y * y
        grown = np.exp(lens[:, 0]) * self.longest[of] * (1 + r2 * (lens[:, 3] + r2 * lens[:, 4]))
        return np.stack([x * grown, y * grown], axis=-1) + self._centres()[of]

    def _centres(self) -> Array:
        """Return the principal point of each photograph, ``(V, 2)`` pixels."""
        shift = np.einsum("nij,nj->ni", self.turned, self.lenses[self.lens, 1:3])
        return np.asarray(self.middle + self.longest[:, None] * shift)

    def median_off(self) -> Array:
        """Return the median distance of each photograph's corners from where its camera puts them, ``(V,)`` pixels."""
        return np.array(
            [
                np.median(np.linalg.norm(self._project(points, np.full(len(points), k)) - seen, axis=1))
                for k, (points, seen) in enumerate(zip(self.points, self.seen, strict=True))
            ]
        )

    def frames(self) -> list[Frame]:
        """Return the photographs as frames."""
        made = []
        turns = Rotation.from_rotvec(self.poses[:, :3]).as_matrix()
        for k, (photograph, centre) in enumerate(zip(self.photographs, self._centres(), strict=True)):
            pose = np.eye(4)
            pose[:3, :3] = turns[k].T * [1, -1, -1]
            pose[:3, 3] = -turns[k].T @ self.poses[k, 3:]
            focal, _, _, k1, k2 = self.lenses[self.lens[k]]
            pixels = float(np.exp(focal) * self.longest[k])
            camera = StatedIntrinsics(
                fx=pixels,
                fy=pixels,
                cx=float(centre[0]),
                cy=float(centre[1]),
                width=photograph.size[0],
                height=photograph.size[1],
                distortion=LensDistortion(k1=float(k1), k2=float(k2)),
            )
            name = photograph.name
            made.append(Frame(f"images/{name}", pose, camera, f"photograph {name}"))
        return made


def _on_plane(adjustment: BundleAdjustment, k: int, focal: float) -> tuple[Array, float]:
    """Return rotation vector and translation of a photograph from a pinhole of this focal length, and how far off its
    corners are in the median, in longer edges."""
    import cv2

    points, size = adjustment.points[k], adjustment.longest[k]
    seen = (adjustment.seen[k] - adjustment.middle[k]) / size
    matrix = np.diag([focal, focal, 1.0])
    # Markers that somebody else printed are no inliers of the sheet's plane.
    _, inlier = cv2.findHomography(points[:, :2], seen, cv2.RANSAC, 0.01)
    kept = np.ones(len(points), dtype=bool) if inlier is None else inlier.ravel().astype(bool)
    if kept.sum() < 4:
        kept[:] = True
    _, turns, shifts, _ = cv2.solvePnPGeneric(points[kept], seen[kept], matrix, None, flags=cv2.SOLVEPNP_IPPE)
    pose = np.concatenate([turns[0].ravel(), shifts[0].ravel()])
    shown = cv2.projectPoints(points[kept], turns[0], shifts[0], matrix, None)[0].reshape(-1, 2)
    return pose, float(np.median(np.linalg.norm(shown - seen[kept], axis=1)))
