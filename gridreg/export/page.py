"""One HTML file that shows a run, with nothing beside it and nothing from a network."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup
from PIL import Image

from gridreg.errors import InputError
from gridreg.export.cameras import Orbit, orbit_of_box, orbit_of_views
from gridreg.export.html import encode, open_image, page_environment, spread_views, target_beside
from gridreg.export.images import MAX_DEVIATION, to_image
from gridreg.export.line_chart import Series, line_chart
from gridreg.export.mesh import Mesh
from gridreg.export.mesh_files import read_mesh
from gridreg.export.page_object import next_camera, object_data, small_photographs
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model
from gridreg.scenes import Scene
from gridreg.training.curves import History
from gridreg.training.files import write_bytes

FACES = 60_000
"""Of the mesh in the page, at most: about a megabyte."""

VIDEO_BYTES = 600_000
"""A larger video stays beside the page, which has a link to it."""

_VIEWS, _DOUBT = 8, 240


def write_page(
    folder: str | Path,
    scene: Scene | None = None,
    *,
    run: str | Path | None = None,
    model: Model | None = None,
) -> Path:
    """Write ``index.html`` into the folder of a run, from what lies there; whole or not at all.

    It has the mesh to turn, the training photographs at their cameras, test views beside renders, score, curve and
    video: what of it there is.

    Args:
        folder: where it goes to, and what it is made of.
        scene: what the run was trained on, for photographs and cameras.
        run: folder of the run, for what ``folder`` does not have; None: the same.
        model: of an ensemble, to show where its members differ; None, or that of one run: this is not shown.

    Returns:
        The path.

    Raises:
        InputError: if a file of the run cannot be read, or the place is not writable.
    """
    places = [Path(folder), Path(folder if run is None else run)]
    record = _record(places)
    mesh, reason = _mesh(places)
    if mesh is not None and scene is not None:
        mesh = replace(mesh, metric=scene.world.metric)
    orbit = _orbit(scene, mesh)
    photographs = [] if scene is None else small_photographs(scene.train, scene.background)
    score, note = _score(record)
    beyond = next_camera(_found(places, "next.json"))
    name = record.get("scene") or (scene.name if scene is not None else "scene")
    if name == "scene":
        # As gridreg reconstruct calls every scene.
        name = Path(folder).resolve().name
    text = (
        page_environment("gridreg.export")
        .get_template("run.html")
        .render(
            title=name,
            lead=_lead(record, scene),
            object=None
            if mesh is None
            else object_data(mesh, scene, orbit, len(photographs)) | {"next": beyond},
            no_object=reason,
            photographs=photographs,
            size="" if mesh is None else mesh.size,
            score=score,
            score_note=note,
            doubts=_doubts(model, scene),
            next=beyond,
            max_deviation=MAX_DEVIATION,
            trained_on=record.get("trained_on"),
            pairs=_pairs(places[0] / "test", record),
            chart=_chart(places),
            video=_video(places),
            provenance=_provenance(record),
        )
    )
    path = Path(folder) / "index.html"
    # Names of files that are not UTF-8 hold lone surrogates, which UTF-8 cannot write.
    write_bytes(path, text.encode("utf-8", "backslashreplace"))
    return path


def _found(places: Sequence[Path], *names: str) -> Path | None:
    return next((place / name for place in places for name in names if (place / name).is_file()), None)


def _record(places: Sequence[Path]) -> dict[str, Any]:
    path = _found(places, "metrics.json")
    if path is None:
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(record, dict) and isinstance(record.get("mean"), dict):
            return record
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read the score: {error}") from error
    raise InputError(f"{path}: found no score, expected what train or eval writes")


def _mesh(places: Sequence[Path]) -> tuple[Mesh | None, str]:
    """A mesh of at most `FACES`, or why there is none."""
    path = _found(places, "mesh.ply")
    if path is None:
        return None, "gridreg mesh makes one, if the field has a surface"
    return read_mesh(path).reduced(FACES), ""


def _orbit(scene: Scene | None, mesh: Mesh | None) -> Orbit:
    if scene is not None and len(scene.train):
        return orbit_of_views(scene.train, scene.bounds)
    box = np.array([[-1.0] * 3, [1.0] * 3]) if mesh is None else [mesh.vertices.min(0), mesh.vertices.max(0)]
    return orbit_of_box(torch.from_numpy(np.asarray(box)))


def _lead(record: Mapping[str, Any], scene: Scene | None) -> str:
    count = len(record.get("train_views") or ()) or (len(scene.train) if scene is not None else 0)
    return f"Made of {count} photographs by gridreg." if count else "Made by gridreg."


def _score(record: Mapping[str, Any]) -> tuple[list[tuple[str, str]], str]:
    if not record:
        return [], ""
    mean = {name: float(value) for name, value in record["mean"].items()}
    shown = [("PSNR", f"{mean.pop('psnr'):.2f} dB")] if "psnr" in mean else []
    shown += [("SSIM" if name == "ssim_gaussian" else name, f"{value:.4f}") for name, value in mean.items()]
    views, protocol = record.get("test_views"), record.get("protocol")
    what = "One view that was" if views == 1 else f"Mean of {views} views that were"
    return shown, f"{what} {'' if record.get('trained_on') else 'not '}trained on, protocol {protocol}."


def _pairs(folder: Path, record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Test views: photograph and render, and PSNR."""
    images = record.get("images") or {}
    found = []
    for name in spread_views(images, _VIEWS):
        render = open_image(folder / f"{name}.png")
        if render is None:
            continue
        target = target_beside(folder / f"{name}_compare.png", render)
        both = [("photograph", target), ("render", render)]
        psnr = float(images[name].get("psnr", "nan"))
        found.append(
            {
                "name": name,
                "psnr": "" if math.isnan(psnr) else f"{psnr:.2f} dB",
                "images": [(label, encode(image)) for label, image in both if image is not None],
            }
        )
    return found


def _doubts(model: Model | None, scene: Scene | None) -> list[tuple[str, str]]:
    """Renders of an ensemble from four sides, each beside how far its members differ."""
    if scene is None or model is None or not model.members or model.warp is not None:
        return []
    orbit = orbit_of_views(scene.train, scene.bounds)
    lens = Lens.from_tensor(scene.train.intrinsics[0], scene.train.height, scene.train.width)
    lens = lens.resized(min(_DOUBT, lens.width))
    found = []
    for azimuth in range(0, 360, 90):
        rendered = model.render(Camera(orbit.pose(azimuth), lens), deviation=True)
        assert rendered is not None
        render, deviation = (
            encode(Image.fromarray(to_image(rendered, mode))) for mode in ("rgb", "deviation")
        )
        found.append((render, deviation))
    return found


def _chart(places: Sequence[Path]) -> Markup:
    path = _found(places, "history.jsonl")
    if path is None:
        return Markup("")
    rows = History.load(path).rows
    series = []
    for name, label, style in (
        ("psnr", "training batches", (1, 0)),
        ("test_psnr", "test views", (2, 0)),
        ("validation_psnr", "validation views", (3, 0)),
    ):
        points = [
            (float(row["step"]), float(row[name])) for row in rows if math.isfinite(row.get(name, math.nan))
        ]
        series.append(Series(label, style, points))
    return line_chart("Training", series, x_label="iteration", y_label="PSNR (dB)", y_span=30.0)


def _video(places: Sequence[Path]) -> dict[str, str] | None:
    path = _found(places, "turntable.mp4", "spiral.mp4")
    if path is None:
        return None
    content = path.read_bytes() if path.stat().st_size <= VIDEO_BYTES else b""
    src = "data:video/mp4;base64," + base64.b64encode(content).decode() if content else ""
    # A link leads to a file beside the page, no further.
    return {"name": path.name, "src": src} if src or path.parent == places[0] else None


def _provenance(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    if not record:
        return []
    versions = record.get("versions") or {}
    entries = [
        ("command", " ".join(map(str, record.get("command") or ()))),
        ("iterations, seed", f"{record.get('steps')}, {record.get('seed')}"),
        (
            "seconds",
            ", ".join(f"{name} {value:.0f}" for name, value in (record.get("seconds") or {}).items()),
        ),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        *(record.get("conventions") or {}).items(),
    ]
    return [(name, text) for name, text in entries if text]
