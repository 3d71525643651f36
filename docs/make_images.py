"""Make docs/images/: renders, meshes and pages of the built-in scene, and sources.json with how they came about.

python docs/make_images.py                  make all of them, in about half an hour on two cores
python docs/make_images.py viewer.webp      make one, from the runs of an earlier call
python docs/make_images.py --check          exit with status 1 if one is missing, left over, too large, not shown in a
                                            page, or made by another recipe or file than sources.json says
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from mesh_image import mesh_image

from gridreg.cli.view import described
from gridreg.export import Camera, Model, Viewer, read_mesh, video_path
from gridreg.export.runs import smoothed
from gridreg.training import Execution, StepReport, TrainOptions, configure, execute, load_run, open_scene
from gridreg.training.files import write_bytes, write_json
from gridreg.training.images import ImageArray, labelled, row, thumbnail, to_uint8
from gridreg.training.versions import versions

DOCS = Path(__file__).resolve().parent
FOLDER, SOURCES = DOCS / "images", DOCS / "images" / "sources.json"
WORK = DOCS.parent / "outputs" / "docs"
PRESET, STUDY, STEPS = "quick", "builtin_pieces", 1200
LARGEST = {"reconstruction.webp": 1_500_000}
"""Bytes; of the others 250,000."""

RUN = f"gridreg train --preset {PRESET} --seed 0 --out outputs/docs/run"
RECIPES: dict[str, str] = {
    "reconstruction.webp": f"{RUN}, with a look at the field on the way",
    "stages.webp": f"{RUN}, with a look at the field on the way",
    "renders.webp": f"{RUN}: test/",
    "curves.webp": f"{RUN}: curves.png and masks.png",
    "mesh.webp": f"{RUN}: mesh.ply",
    "page.webp": f"{RUN}: index.html, in headless Chromium",
    "viewer.webp": "gridreg view outputs/docs/run, in headless Chromium",
    "report.webp": f"gridreg ablate --example {STUDY} --report, in headless Chromium",
}


class Recorder:
    """Looks at the field while it learns, from a camera that goes around it.

    Args:
        frames: images from the first iteration to the last; many early, when most happens.
    """

    def __init__(self, frames: int = 48) -> None:
        self.at = sorted({round(STEPS * (k / (frames - 1)) ** 1.8) for k in range(frames)} | {200})
        self.seen: list[tuple[int, ImageArray]] = []

    def start(self, run: Execution) -> None:
        """Stand still before the first iteration."""
        self.run, self.cameras = run, cameras_of(run.trainer.model, run.scene.train)
        self._look()

    def step(self, report: StepReport) -> None:
        """Look, where one is due."""
        if self.run.trainer.step in self.at:
            self._look()

    def _look(self) -> None:
        self.seen.append(
            (self.run.trainer.step, render(self.run.trainer.model, self.cameras[len(self.seen)]))
        )


def cameras_of(model: Model, views: Any) -> list[Camera]:
    """Cameras around the object."""
    return video_path(model, views, frames=96, width=300)


def render(model: Model, camera: Camera) -> ImageArray:
    """What a model looks like."""
    model.field.eval()
    rendered = model.render(camera)
    model.field.train()
    assert rendered is not None
    return to_uint8(rendered.colour)


def train() -> None:
    """The run that most images show, with its mesh, page, and frames of the moving image."""
    if (WORK / "frames.npz").is_file():
        return
    from gridreg.export import draw_run

    config = configure(TrainOptions(preset=PRESET))
    recorder = Recorder()
    run, _ = execute(config, open_scene(config, WORK), WORK / "run", watch=recorder, command=RUN.split())
    draw_run(run)
    photographs = [
        thumbnail(to_uint8(image), 73) for image in run.scene.train.composited(run.scene.background)
    ]
    first = len(recorder.seen)
    turning = [(STEPS, render(run.trainer.model, camera)) for camera in recorder.cameras[first : first + 44]]
    np.savez_compressed(
        WORK / "frames.npz",
        photographs=np.stack(photographs),
        steps=np.array([step for step, _ in recorder.seen + turning]),
        images=np.stack([image for _, image in recorder.seen + turning]),
    )


def reconstruction() -> bytes:
    """The moving image: eight photographs, and the field that learns from them."""
    train()
    with np.load(WORK / "frames.npz") as stored:
        photographs, steps, images = stored["photographs"], stored["steps"], stored["images"]
    pairs = [row([photographs[i], photographs[i + 1]], 2) for i in range(0, 8, 2)]
    left = labelled(_stack(pairs), "8 photographs")
    frames = []
    for step, image in zip(steps, images, strict=True):
        text = "fog" if step == 0 else f"iteration {step}" if step < STEPS else f"after {STEPS} iterations"
        frames.append(Image.fromarray(row([left, labelled(image, text)], 8)))
    file = io.BytesIO()
    times = [1200] + [110] * (len(frames) - 2) + [1500]
    frames[0].save(
        file, "WEBP", save_all=True, append_images=frames[1:], duration=times, loop=0, quality=68, method=6
    )
    return file.getvalue()


def stages() -> bytes:
    """Photographs, fog, 200 iterations, final, beside each other."""
    train()
    with np.load(WORK / "frames.npz") as stored:
        steps, images = stored["steps"].tolist(), stored["images"]
        photographs = [thumbnail(image, 146) for image in stored["photographs"][[0, 2, 4, 6]]]
    four = _stack([row(photographs[:2], 2), row(photographs[2:], 2)])
    tiles = [(four, "4 of 8 photographs"), (images[0], "fog"), (images[steps.index(200)], "200 iterations")]
    tiles.append((images[steps.index(STEPS)], f"{STEPS} iterations"))
    return webp(row([labelled(thumbnail(image, 300), text) for image, text in tiles], 8))


def renders() -> bytes:
    """Test views: photograph, render, error."""
    train()
    views = sorted((WORK / "run" / "test").glob("*_compare.png"))
    return webp(_stack([np.asarray(Image.open(path).convert("RGB")) for path in views[2::8][:3]]))


def curves() -> bytes:
    """Curves of the run."""
    train()
    images = [Image.open(WORK / "run" / name).convert("RGB") for name in ("curves.png", "masks.png")]
    return webp(row([thumbnail(np.asarray(image), 640) for image in images], 8))


def mesh() -> bytes:
    """The mesh of the run in its colours, and its shape."""
    train()
    found, run = read_mesh(WORK / "run" / "mesh.ply"), load_run(WORK / "run")
    scene = open_scene(run.config, WORK, test=())
    cameras = video_path(run, scene.train, frames=6, width=420)
    tiles = [mesh_image(found, cameras[i], colours=colours) for i in (0, 2) for colours in (True, False)]
    return webp(row(tiles, 0))


def page() -> bytes:
    """The page of the run."""
    train()
    return screenshot(f"file://{WORK / 'run' / 'index.html'}", (1200, 900), "true")


def viewer() -> bytes:
    """The viewer on the run."""
    train()
    run = load_run(WORK / "run")
    scene = open_scene(run.config, WORK, test=())
    title, curve = described(run, WORK / "run")
    with Viewer(run, scene.train, port=0, quiet=True, title=title) as shown:
        shown.curve(*smoothed(curve))
        return screenshot(shown.url, (1200, 750), _CLOSE_NOTICE, wait=12)


# Of viser, that this browser has no graphics card.
_CLOSE_NOTICE = (
    "[...document.querySelectorAll('.mantine-Notification-closeButton')].map(b => b.click()).length"
)


def report() -> bytes:
    """The report of a study."""
    out = WORK / "study"
    command = [sys.executable, "-m", "gridreg", "ablate", "--example", STUDY, "--report", "--out", str(out)]
    subprocess.run(command, check=True, cwd=DOCS.parent)
    return screenshot(f"file://{out / 'report.html'}", (1200, 1000), "true")


def screenshot(url: str, size: tuple[int, int], ready: str, wait: float = 3) -> bytes:
    """What `photographed` shows, as it is stored."""
    return webp(photographed(url, size, ready, wait))


def photographed(url: str, size: tuple[int, int], ready: str, wait: float = 3) -> ImageArray:
    """A page in headless Chromium, once a JavaScript expression holds, and some seconds later."""
    import tempfile
    import time

    from tests.chromium import open_page

    with tempfile.TemporaryDirectory() as folder, open_page(Path(folder), size) as tab:
        tab.open(url)
        tab.until(lambda: tab.evaluate(ready))
        time.sleep(wait)
        return np.asarray(tab.screenshot())


def webp(image: ImageArray) -> bytes:
    """An image as it is stored."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", quality=80, method=6)
    return file.getvalue()


def _stack(images: Sequence[ImageArray], gap: int = 2) -> ImageArray:
    turned = row([image.transpose(1, 0, 2) for image in images], gap)
    return np.ascontiguousarray(turned.transpose(1, 0, 2))


MAKERS: dict[str, Callable[[], bytes]] = {
    f"{maker.__name__}.webp": maker
    for maker in (reconstruction, stages, renders, curves, mesh, page, viewer, report)
}


def problems(folder: Path = FOLDER) -> list[str]:
    """What is wrong with the stored images, a line each."""
    stored: dict[str, Any] = json.loads((folder / SOURCES.name).read_text(encoding="utf-8"))["images"]
    pages = [DOCS.parent / "README.md", *DOCS.rglob("*.md")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in pages)
    shown = set(re.findall(r"images/([\w.-]+)", text))
    found = {path.name for path in folder.iterdir()} - {SOURCES.name}
    wrong = [f"{name}: left over" for name in sorted(found - RECIPES.keys())]
    for name, recipe in RECIPES.items():
        if name not in found or name not in stored:
            wrong.append(f"{name}: missing")
            continue
        content = (folder / name).read_bytes()
        if stored[name]["recipe"] != recipe:
            wrong.append(f"{name}: made by another recipe")
        if stored[name]["sha256"] != hashlib.sha256(content).hexdigest():
            wrong.append(f"{name}: another file than was made")
        if len(content) > LARGEST.get(name, 250_000):
            wrong.append(f"{name}: {len(content)} bytes")
        if name not in shown:
            wrong.append(f"{name}: in no page")
    return wrong


def main(words: Sequence[str] | None = None) -> int:
    """Make or check the images; return the exit status."""
    parser = argparse.ArgumentParser(prog="make_images.py")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RECIPES)}; default: all")
    parser.add_argument(
        "--check", action="store_true", help="only name what is wrong; status 1 if anything is"
    )
    options = parser.parse_args(words)
    if options.check:
        wrong = problems()
        print("\n".join(wrong) or "up to date")
        return int(bool(wrong))
    unknown = [name for name in options.names if name not in MAKERS]
    if unknown:
        parser.error(f"found {unknown[0]!r}, expected one of {', '.join(MAKERS)}")
    FOLDER.mkdir(exist_ok=True)
    WORK.mkdir(parents=True, exist_ok=True)
    record = json.loads(SOURCES.read_text(encoding="utf-8")) if SOURCES.is_file() else {"images": {}}
    for name in options.names or MAKERS:
        content = MAKERS[name]()
        write_bytes(FOLDER / name, content)
        digest = hashlib.sha256(content).hexdigest()
        kept = {key: value for key, value in versions().items() if key not in ("platform", "threads")}
        record["images"][name] = {"recipe": RECIPES[name], "sha256": digest, "versions": kept}
        print(f"{name}: {len(content)} bytes", flush=True)
        write_json(SOURCES, record)
    return 0


if __name__ == "__main__":
    sys.exit(main())
