"""Comparisons of `own_photographs.py --sheet`: what was made of the built-in photographs, and the truth about them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates

from gridreg.export import Mesh, compare_meshes, read_mesh
from gridreg.scenes import photograph_mesh
from gridreg.training.files import write_json

Array = NDArray[np.float64]
Entry = dict[str, Any]


def entries(scene: Path) -> dict[str, Entry]:
    """Return the frames of a ``transforms.json`` by the names of their images, intrinsics in each."""
    content = json.loads((scene / "transforms.json").read_text())
    shared = {key: value for key, value in content.items() if not isinstance(value, (dict, list))}
    return {Path(frame["file_path"]).name: {**shared, **frame} for frame in content["frames"]}


def camera_errors(scene: Path, truth: Path) -> dict[str, float]:
    """Return how far cameras are off at most: degrees, percent of the distance to the sheet, percent of focal length.

    Nothing is aligned: both stand in metres above the sheet.
    """
    found, true = entries(scene), entries(truth)
    angles, places = [], []
    for name, entry in found.items():
        a, b = (np.array(each["transform_matrix"]) for each in (entry, true[name]))
        cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        places.append(100 * np.linalg.norm(a[:3, 3] - b[:3, 3]) / np.linalg.norm(b[:3, 3]))
    return {
        "rotation_degrees_max": float(max(angles)),
        "position_percent_max": float(max(places)),
        "rotation_degrees_median": float(np.median(angles)),
        "position_percent_median": float(np.median(places)),
    }


def cut_like(image: Array, own: Entry, crop: Entry, scale: float) -> Array:
    """Return an image ``(H, W, C)`` where a crop of it, reduced by ``scale``, has its pixels.

    Args:
        image: whole, of the camera ``own``.
        own: its intrinsics.
        crop: intrinsics of the crop.
        scale: pixels of the crop for one of the image.
    """
    columns, rows = np.meshgrid(np.arange(crop["w"]) + 0.5, np.arange(crop["h"]) + 0.5)
    x = (columns - crop["cx"]) / scale + own["cx"] - 0.5
    y = (rows - crop["cy"]) / scale + own["cy"] - 0.5
    channels = [
        map_coordinates(image[..., c], [y, x], order=1, mode="nearest") for c in range(image.shape[-1])
    ]
    return np.stack(channels, axis=-1)


def _read(path: Path) -> Array:
    pixels = np.asarray(Image.open(path), dtype=np.float64)
    return pixels if pixels.ndim == 3 else pixels[..., None]


def mask_overlap(scene: Path, truth: Path) -> dict[str, float]:
    """Return intersection over union of the scene's masks and the true ones: of each photograph, and the least."""
    true = entries(truth)
    overlaps = {}
    for name, entry in entries(scene).items():
        own = true[name]
        whole = _read(truth / own["mask_path"])
        expected = cut_like(whole, own, entry, entry["fl_x"] / own["fl_x"])[..., 0] > 127
        found = _read(scene / entry["mask_path"])[..., 0] > 127
        overlaps[name] = float((expected & found).sum() / (expected | found).sum())
    return {"least": min(overlaps.values()), "mean": float(np.mean([*overlaps.values()])), **overlaps}


def with_test_views(scene: Path, truth: Path, out: Path, *, true: bool) -> Path:
    """Write a copy of a prepared scene with the truth's test views, and with true cameras and masks if ``true``.

    A test view's crop is centred on the object, as those of the photographs are.
    """
    content = json.loads((scene / "transforms.json").read_text())
    known, found = entries(truth), entries(scene)
    shutil.copytree(scene / "images", out / "images")
    shutil.copytree(scene / "masks", out / "masks")
    size = next(iter(found.values()))
    frames: list[Entry] = []
    for name, entry in found.items():
        own, frame = known[name], dict(entry)
        if true:
            # Crops begin and end at whole pixels of the photograph, so the estimated camera tells which.
            scale = size["w"] / round(size["w"] * own["fl_x"] / entry["fl_x"])
            start = [round(own[key] - entry[key] / scale) for key in ("cx", "cy")]
            frame |= {
                "fl_x": own["fl_x"] * scale,
                "fl_y": own["fl_y"] * scale,
                "k1": own["k1"],
                "k2": own["k2"],
            }
            frame |= {"cx": (own["cx"] - start[0]) * scale, "cy": (own["cy"] - start[1]) * scale}
            frame["transform_matrix"] = own["transform_matrix"]
            mask = cut_like(_read(truth / own["mask_path"]), own, frame, scale)
            Image.fromarray(mask[..., 0].round().astype(np.uint8)).save(out / entry["mask_path"])
        frames.append(frame)
    tests = [name for name in known if name not in found and name.startswith("test_")]
    for name in tests:
        own = known[name]
        scale = size["fl_x"] / known[Path(size["file_path"]).name]["fl_x"]
        frame = {
            **own,
            "w": size["w"],
            "h": size["h"],
            "fl_x": own["fl_x"] * scale,
            "fl_y": own["fl_y"] * scale,
        }
        rows, columns = np.nonzero(_read(truth / own["mask_path"])[..., 0])
        frame["cx"] = size["w"] / 2 - scale * ((columns.min() + columns.max()) / 2 - own["cx"])
        frame["cy"] = size["h"] / 2 - scale * ((rows.min() + rows.max()) / 2 - own["cy"])
        for key in ("file_path", "mask_path"):
            cut = cut_like(_read(truth / own[key]), own, frame, scale)
            Image.fromarray(cut.squeeze().round().astype(np.uint8)).save(out / own[key])
        frames.append(frame)
    held = [known[name]["file_path"] for name in tests]
    write_json(
        out / "transforms.json", {"gridreg": content["gridreg"], "test_filenames": held, "frames": frames}
    )
    return out


def mesh_errors(path: Path) -> dict[str, float]:
    """Return Chamfer distance over the diagonal and the error of the size, in percent, of a mesh in metres."""
    mesh, truth = read_mesh(path), Mesh(*photograph_mesh())
    compared = compare_meshes(mesh, truth)
    edges = [np.ptp(each.vertices, axis=0) for each in (mesh, truth)]
    return {
        "chamfer_percent": 100 * compared.chamfer_relative,
        "accuracy_percent": 100 * compared.accuracy_relative,
        "completeness_percent": 100 * compared.completeness_relative,
        "size_percent": 100 * float(np.linalg.norm(edges[0]) / np.linalg.norm(edges[1]) - 1),
        "faces": len(mesh.faces),
    }
