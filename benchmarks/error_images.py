"""Draw one image a scene: a test view, what several runs make of it, and their error maps.

    python benchmarks/quality.py --data DIR --scenes lego --runs tensorf best --keep RUNS
    python benchmarks/error_images.py --data DIR --scene lego --kept RUNS --runs tensorf best --into IMAGES

Writes IMAGES/SCENE-VIEW.png. The view is the one with the median PSNR of the first run, unless it is named. What the
images show of other people's scenes is theirs, so none of them is in this repository; docs/results.md describes them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from quality import record_name

from gridreg.cli import run_cli
from gridreg.errors import InputError
from gridreg.scenes import load_scene
from gridreg.training.files import check_output_folder
from gridreg.training.images import labelled, row, save_png, scale_bar, thumbnail, to_uint8
from gridreg.training.outputs import MAX_ERROR, error_map

LEAST = 64
"""Pixels that the scale of the error takes."""


def kept_run(folder: Path, scene: str, run: str, seed: int, protocol: str) -> Path:
    """Return the output folder of a run.

    Raises:
        InputError: if `benchmarks/quality.py --keep` has not left it here.
    """
    found = folder / record_name(scene, run, seed, None, protocol, ())
    if not (found / "metrics.json").is_file():
        raise InputError(f"{found}: found no finished run, expected what benchmarks/quality.py --keep leaves")
    return found


def scores(folder: Path) -> dict[str, float]:
    """PSNR by test view, dB."""
    images = json.loads((folder / "metrics.json").read_text())["images"]
    return {name: float(values["psnr"]) for name, values in images.items()}


def median_view(values: dict[str, float]) -> str:
    """The view in the middle."""
    return sorted(values, key=lambda name: values[name])[len(values) // 2]


def compose(target: torch.Tensor, renders: dict[str, tuple[torch.Tensor, float]], size: int) -> np.ndarray:
    """Target and renders above, the error's scale and the error maps below; images ``(H, W, 3)`` in [0, 1]."""
    upper = [labelled(thumbnail(to_uint8(target), size), "target")]
    lower = [np.full_like(labelled(thumbnail(to_uint8(target), size), " "), 255)]
    bar = scale_bar(lower[0].shape[0], 0.0, MAX_ERROR)
    lower[0][:, -bar.shape[1] :] = bar
    for name, (image, value) in renders.items():
        upper.append(labelled(thumbnail(to_uint8(image), size), f"{name}  {value:.2f} dB"))
        lower.append(labelled(thumbnail(error_map(image, target), size), "error (RMS of channels)"))
    return np.concatenate([row(upper), row(lower)])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the scenes")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--kept", type=Path, required=True, help="as given to quality.py --keep")
    parser.add_argument("--runs", nargs="+", required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--protocol", default="dietnerf8")
    parser.add_argument("--view", help="name of a test view")
    parser.add_argument(
        "--size", type=int, default=400, help="edge of an image, pixels (default: %(default)s)"
    )
    parser.add_argument("--into", type=Path, required=True, help="folder for the image")
    arguments = parser.parse_args()
    if arguments.size < LEAST:
        raise InputError(f"--size: found {arguments.size}, expected at least {LEAST}, the width of the scale")
    folders = {
        run: kept_run(arguments.kept, arguments.scene, run, arguments.seed, arguments.protocol)
        for run in arguments.runs
    }
    values = {run: scores(folder) for run, folder in folders.items()}
    view = arguments.view or median_view(values[arguments.runs[0]])
    if view not in values[arguments.runs[0]]:
        names = ", ".join(values[arguments.runs[0]])
        raise InputError(f"--view: found {view!r}, expected one of {names}")
    scene = load_scene(arguments.data / arguments.scene, arguments.protocol)
    target = scene.test.composited(scene.background)[scene.test.names.index(view)]
    renders = {
        run: (
            torch.from_numpy(imageio.imread(folder / "test" / f"{view}.png") / 255.0).float(),
            values[run][view],
        )
        for run, folder in folders.items()
    }
    target_file = check_output_folder(arguments.into) / f"{arguments.scene}-{view}.png"
    save_png(target_file, compose(target, renders, arguments.size))
    print(target_file)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
