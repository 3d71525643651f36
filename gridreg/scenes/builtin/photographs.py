"""Photographs of the lighthouse on the sheet, as a telephone takes them, with everything about them known.

Perspective with lens distortion, noise, exposure and white balance that change, JPEG, and EXIF data, portrait beside
landscape; true cameras, masks and mesh lie beside them.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from gridreg.errors import InputError
from gridreg.scenes.builtin.lighthouse import lighthouse
from gridreg.scenes.builtin.raycast import cast, hit_colours
from gridreg.scenes.builtin.room import METRES, TABLE, room
from gridreg.scenes.builtin.surface import builtin_mesh
from gridreg.scenes.builtin.write import write_once
from gridreg.scenes.lens import LensDistortion, sample_bilinear

__all__ = ["builtin_photographs", "photograph_mesh"]

Array = NDArray[np.float64]

_VERSION = 1
# Lens of the telephone, in units of the image's longer edge; the principal point is off the middle.
_FOCAL, _OFF = 0.735, (0.004, -0.003)
_LENS = LensDistortion(k1=0.055, k2=-0.045)
_GAMMA = 2.2
_NOISE = 0.008
_SEEN = 8
"""Views without noise that the truth holds out to score on."""
_STRIP = 64
"""Rows that are cast together: what they take stays in the caches."""


def builtin_photographs(folder: str | Path, *, count: int = 8, size: int = 1200, paper: str = "a4") -> Path:
    """Write the built-in photographs (unless they are there already) and return their folder.

    ``photographs/`` holds JPEG files as a telephone stores them, every fourth of them in portrait. ``truth/`` is a
    scene of the same photographs, upright, with true cameras (metres, z up, the sheet's middle is the origin) and
    masks, and 8 views more, without noise and at one exposure, as test frames.

    Args:
        folder: an existing or new folder to put it in, such as a cache folder.
        count: how many photographs.
        size: longer edge in pixels.
        paper: of the sheet, see `gridreg board`.

    Raises:
        InputError: when the folder cannot be written, or something else is in its place.
    """
    if size < 64 or size % 4:
        raise InputError(f"size: found {size}, expected a multiple of 4 from 64 on")
    if count < 1:
        raise InputError(f"count: found {count}, expected at least 1 photograph")
    target = Path(folder) / f"photographs_{paper}_{count}x{size}"
    marker = {"scene": "built-in photographs of gridreg", "version": _VERSION, "count": count, "size": size}
    return write_once(
        target, marker, ["truth/transforms.json"], lambda fresh: _write(fresh, count, size, paper)
    )


def photograph_mesh(edge: float = 0.02) -> tuple[Array, NDArray[np.int64]]:
    """Return the true mesh in metres, see :func:`gridreg.scenes.builtin_mesh`."""
    vertices, faces = builtin_mesh(edge)
    return _to_metres(vertices), faces


def _to_metres(points: Array) -> Array:
    return np.asarray(METRES * (points - [0.0, 0.0, TABLE]))


def _cameras(count: int, rng: np.random.Generator | None) -> list[Array]:
    """Return camera-to-world matrices in metres: around the sheet, low and high; by hand, if there is a generator."""
    poses = []
    for k in range(count):
        azimuth, elevation, distance = 2 * math.pi * k / count, (24.0, 50.0, 36.0)[k % 3], 0.33
        target, roll = np.array([0.0, 0.0, 0.06]), 0.0
        if rng is None:
            azimuth += math.pi / count
        else:
            azimuth += 0.12 * rng.standard_normal()
            elevation += rng.uniform(-5, 5)
            distance *= rng.uniform(0.92, 1.12)
            target = target + rng.uniform(-0.012, 0.012, 3)
            roll = math.radians(rng.uniform(-5, 5))
        e = math.radians(elevation)
        back = np.array([math.cos(azimuth) * math.cos(e), math.sin(azimuth) * math.cos(e), math.sin(e)])
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        up = np.cross(back, right)
        pose = np.eye(4)
        pose[:3, 0] = math.cos(roll) * right + math.sin(roll) * up
        pose[:3, 1] = math.cos(roll) * up - math.sin(roll) * right
        pose[:3, 2], pose[:3, 3] = back, target + distance * back
        poses.append(pose)
    return poses


def _take(pose: Array, camera: dict[str, Any], paper: str) -> Array:
    """Return ``(h, w, 4)``: what falls on the sensor, and how much of it is the object, in [0, 1]."""
    width, height, focal = camera["w"], camera["h"], camera["fl_x"]
    world = pose.copy()
    world[:3, 3] = pose[:3, 3] / METRES + [0.0, 0.0, TABLE]
    # Two rays a pixel each way, a little past the edges, through a pinhole; then where the lens puts them.
    margin = 0.04 * width
    columns = np.arange(-margin, width + margin, 0.5) + 0.25
    rows = np.arange(-margin, height + margin, 0.5) + 0.25
    parts = (*lighthouse(), *room(paper))
    intrinsics = np.array([focal, focal, camera["cx"], camera["cy"]])
    pinhole = np.empty((len(rows), len(columns), 4), dtype=np.float32)
    for first in range(0, len(rows), _STRIP):
        hits = cast(world, intrinsics, columns, rows[first : first + _STRIP], parts)
        found, colours = hit_colours(hits, world, parts)
        strip = pinhole[first : first + _STRIP].reshape(-1, 4)
        strip[found, :3] = colours**_GAMMA
        strip[:, 3] = hits.part.ravel() < len(lighthouse())
    return np.concatenate(
        [
            _through_lens(pinhole, columns[0], rows[0], camera, slice(first, min(first + _STRIP, height)))
            for first in range(0, height, _STRIP)
        ]
    )


def _through_lens(
    pinhole: NDArray[np.float32], left: float, top: float, camera: dict[str, Any], rows: slice
) -> Array:
    """Return rows of a photograph, of four points a pixel, from a pinhole's image at twice its resolution.

    Args:
        pinhole: ``(H, W, C)``.
        left, top: where in the photograph the centre of its first pixel would lie without the lens.
        camera: of the photograph.
        rows: of the photograph.
    """
    focal, width, height = camera["fl_x"], camera["w"], rows.stop - rows.start
    across = np.arange(2 * width) / 2 + 0.25 - camera["cx"]
    along = np.arange(2 * height) / 2 + 0.25 + rows.start - camera["cy"]
    x, y = np.meshgrid(across / focal, along / focal)
    # The lens is radial: its inverse is a table.
    ideal, bent = np.linspace(0, 1.2, 4000), np.hypot(x, y)
    grown = np.interp(bent, _LENS.distort(ideal, np.zeros_like(ideal))[0], ideal) / np.maximum(bent, 1e-12)
    u, v = x * grown * focal + camera["cx"], y * grown * focal + camera["cy"]
    seen = sample_bilinear(pinhole, 2 * (u - left) + 0.5, 2 * (v - top) + 0.5)
    return np.asarray(seen.reshape(height, 2, width, 2, -1).mean(axis=(1, 3)), dtype=np.float64)


def _camera(size: int, portrait: bool) -> dict[str, Any]:
    """Return the camera of an upright photograph in nerfstudio's keys; a turned telephone turns its lens along."""
    width, height = size, 3 * size // 4
    cx, cy = width / 2 + _OFF[0] * size, height / 2 + _OFF[1] * size
    if portrait:
        width, height, cx, cy = height, width, height - cy, cx
    focal = _FOCAL * size
    return {
        "w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy, "k1": _LENS.k1, "k2": _LENS.k2,
    }  # fmt: skip


def _exif(portrait: bool) -> Image.Exif:
    exif = Image.Exif()
    exif.update({ExifTags.Base.Make: "gridreg", ExifTags.Base.Model: "built-in telephone"})
    exif[ExifTags.Base.Orientation] = 6 if portrait else 1
    # As telephones note it: rounded, by the diagonal of 36 x 24 mm.
    equivalent = round(_FOCAL * 0.8 * math.hypot(36, 24))
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: equivalent}
    return exif


def _bytes(image: Array) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


def _write(folder: Path, count: int, size: int, paper: str) -> None:
    for name in ("photographs", "truth/images", "truth/masks"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    frames, test = [], []
    for k, pose in enumerate([*_cameras(count, rng), *_cameras(_SEEN, None)]):
        held, portrait = k >= count, k % 4 == 3 and k < count
        camera = _camera(size, portrait)
        seen = _take(pose, camera, paper)
        light, mask = seen[..., :3], seen[..., 3]
        name = f"test_{k - count:02d}.png" if held else f"IMG_{k + 1:04d}.jpg"
        if held:
            Image.fromarray(_bytes(light ** (1 / _GAMMA))).save(folder / "truth/images" / name)
            test.append(f"images/{name}")
        else:
            gains = 2 ** rng.uniform(-0.3, 0.3) * (1 + 0.04 * rng.standard_normal(3))
            # Shot noise grows with the root of the light.
            light = light * gains + _NOISE * np.sqrt(light + 0.02) * rng.standard_normal(light.shape)
            upright = _bytes(np.clip(light, 0, 1) ** (1 / _GAMMA))
            stored = np.ascontiguousarray(np.rot90(upright)) if portrait else upright
            Image.fromarray(stored).save(folder / "photographs" / name, quality=92, exif=_exif(portrait))
            Image.fromarray(upright).save(folder / "truth/images" / name, quality=95)
        Image.fromarray(_bytes(mask)).save(folder / f"truth/masks/{name}.png")
        frames.append(
            {
                "file_path": f"images/{name}",
                "mask_path": f"masks/{name}.png",
                **camera,
                "transform_matrix": pose.tolist(),
            }
        )
    content = {"test_filenames": test, "frames": frames}
    (folder / "truth/transforms.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
