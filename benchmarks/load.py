"""Time and peak memory of what is large: many images, many points, many runs, a fine mesh, many browsers.

    python benchmarks/load.py
    python benchmarks/load.py images mesh

Each is done in a process of its own; memory is the peak of that process (``ru_maxrss``) above what it holds at its
start, with everything imported. The bounds are those of docs/speed.md; exit status 1 if one is missed. Inputs are made
in another process before. Of the browsers, none may be sent more than twice as many images as another. The result goes
to benchmarks/results/load.jsonl.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import stored
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from timing.ball import ball_field

from gridreg.ablation.report import write_report
from gridreg.ablation.store import Store
from gridreg.ablation.study import study_from_text
from gridreg.ablation.workers import Worker
from gridreg.errors import InputError
from gridreg.export import Viewer, extract_mesh
from gridreg.export.cameras import look_at
from gridreg.rendering.model import Model
from gridreg.scenes import load_scene
from gridreg.training.rays import RayBank
from gridreg.training.versions import versions


def poses(count: int) -> list[np.ndarray]:
    """Return cameras around the origin."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [np.array([4 * np.cos(a), 4 * np.sin(a), 1.5]) for a in angles]
    return [look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])).double().numpy() for place in places]


def make_images(folder: Path, count: int = 200, size: int = 800) -> None:
    """Write a scene of so many images with alpha."""
    frames = []
    for k, pose in enumerate(poses(count)):
        pixels = np.zeros((size, size, 4), np.uint8)
        pixels[200:600, 200:600] = np.random.default_rng(k).integers(0, 256, 4, np.uint8) | 128
        pixels[200:600, 200:600, 3] = 255
        Image.fromarray(pixels).save(folder / f"{k}.png", compress_level=1)
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": 0.69, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def images(folder: Path) -> Any:
    """Read 200 images of 800x800, draw rays of those to train on, and put those to score on their background."""
    scene = load_scene(folder, "holdout8")
    RayBank(scene.train).draw(4096, torch.Generator().manual_seed(0))
    return len(scene.train), scene.train.pixels.dtype, scene.test.composited(scene.background).shape


def make_points(folder: Path, count: int = 1_000_000, views: int = 40, size: int = 64) -> None:
    """Write a COLMAP model in text form."""
    (folder / "images").mkdir()
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {size} {size} 88 88 {size / 2} {size / 2}\n")
    lines = []
    for k, pose in enumerate(poses(views)):
        Image.new("RGB", (size, size), (k, 99, 200)).save(folder / "images" / f"{k}.png")
        rotation = (pose[:3, :3] * [1, -1, -1]).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -rotation @ pose[:3, 3]
        lines.append(f"{k + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {k}.png\n1.0 2.0 -1\n")
    (model / "images.txt").write_text("".join(lines))
    values = np.random.default_rng(0).normal(0, 0.5, (count, 3))
    with (model / "points3D.txt").open("w") as stream:
        for k, (x, y, z) in enumerate(values):
            stream.write(f"{k} {x:.6f} {y:.6f} {z:.6f} 9 9 9 0.5 1 2\n")


def points(folder: Path) -> Any:
    """Read a COLMAP model of a million points and 40 views."""
    return load_scene(folder, "holdout8").near


def make_study(folder: Path, seeds: int = 1500) -> None:
    """Fill a store with results of runs, two rows of so many seeds."""
    study = study_from_text(f"compositions: [none, quick]\nseeds: {list(range(seeds))}", name="load")
    store, worker = Store.open(folder), Worker.current()
    store.add(study)
    for _ in study.runs:
        claim = store.claim(worker, study)
        assert claim is not None
        claim.folder.mkdir(parents=True)
        images = {f"r_{k}": {"psnr": 20.0 + k / 10, "ssim_gaussian": 0.8} for k in range(25)}
        mean = {"psnr": 21.0 + claim.spec.seed % 7 / 10, "ssim_gaussian": 0.8}
        store.finish(claim, {"mean": mean, "images": images, "seconds": {"train": 1.0}})


def study(folder: Path) -> Any:
    """Write the table and the report of a study of 3,000 runs."""
    store = Store.open(folder, create=False)
    store.export(folder / "table.csv")
    return write_report(store, store.study("load"), folder / "report.html").stat().st_size


def mesh(folder: Path) -> Any:
    """Cut a mesh at 512 nodes along an edge."""
    field = ball_field("vm", 128, (4, 6))
    return len(extract_mesh(field, resolution=512, threshold=100.0).faces)


def viewer(folder: Path) -> Any:
    """Let six browsers move before one viewer for half a minute; returns how many images each was sent."""
    with Viewer(Model.of_field(ball_field("vm", 64), resolution=64), port=0, size=256, quiet=True) as shown:
        command = [sys.executable, "-m", "timing.browsers", str(shown.port), "6", "30"]
        said = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    images = json.loads(said.stdout)
    (folder / "more.json").write_text(json.dumps({"images": images}))
    if max(images) > 2 * min(images):
        raise InputError(f"viewer: images sent to the browsers: {images}, expected a factor of 2 at most")
    return images


TASKS: dict[str, tuple[Callable[[Path], None] | None, Callable[[Path], Any], float, float]] = {
    "images": (make_images, images, 180.0, 1766.0),
    "points": (make_points, points, 60.0, 500.0),
    "study": (make_study, study, 300.0, 675.0),
    "mesh": (None, mesh, 45.0, 1500.0),
    "viewer": (None, viewer, 60.0, 300.0),
}
"""What makes the input of each, the task, and its bounds: seconds of the processor, and MB."""


def apart(act: Callable[[], Any]) -> tuple[int, float, float]:
    """Do something in a forked process; returns its exit status, seconds of the processor, and MB above its start."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.write(write, Path("/proc/self/statm").read_bytes())
            print(f"  {act()}", flush=True)
            status = 0
        finally:
            os._exit(status)
    _, status, used = os.wait4(child, 0)
    held = int(os.read(read, 1000).split()[1]) * resource.getpagesize() / 1e6
    os.close(read)
    os.close(write)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3 - held


def main() -> int:
    """Measure what was asked for, store it, and return 1 if a bound was missed."""
    parser = stored.parser_of(__doc__)
    parser.add_argument("tasks", nargs="*", default=[], help=", ".join(TASKS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    missed = 0
    for name in options.tasks or TASKS:
        make, task, most_seconds, most_megabytes = TASKS[name]
        with tempfile.TemporaryDirectory() as place:
            if make is not None and apart(partial(make, Path(place)))[0]:
                return 1
            began = time.perf_counter()
            status, seconds, megabytes = apart(partial(task, Path(place)))
            wall = time.perf_counter() - began
            told = Path(place) / "more.json"
            more = json.loads(told.read_text()) if told.is_file() else {}
        kept = status == 0 and seconds <= most_seconds and megabytes <= most_megabytes
        missed += not kept
        record = {
            "seconds": round(seconds, 1),
            "wall_seconds": round(wall, 1),
            "megabytes": max(0, round(megabytes)),
        }
        bound = {"most_seconds": most_seconds, "most_megabytes": most_megabytes, "kept": kept}
        stored.save("load", name, record | more | bound | {"versions": versions()}, options.results)
        print(f"{name}: {json.dumps(record | more | bound)}", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
