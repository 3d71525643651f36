"""Measure what estimating the cameras costs, from photographs without cameras to a score.

    python benchmarks/own_photographs.py
    python benchmarks/own_photographs.py --sheet --photographs 8

Takes photographs of the built-in scene on white, as a person would have them (JPEG of 1,200 pixels, focal length in
EXIF), throws the cameras away, lets `prepare` find them (pycolmap) and reduce the photographs, and trains on the same
ones with the estimated and with the true cameras, in the same world and box. With ``--sheet`` the photographs are the
built-in ones, of a cluttered room with the object on the sheet: `gridreg reconstruct` makes everything of them in one
command, which is timed; cameras, masks and mesh are compared with the truth, and a training on the estimated cameras
and masks with one on the true ones, on test views without noise. Stored in benchmarks/results/own_photographs.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import own_sheet
import stored
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image
from trimesh.registration import procrustes

from gridreg.cli import main as main_of_gridreg
from gridreg.cli import run_cli
from gridreg.scenes import builtin_photographs, load_scene, prepare
from gridreg.scenes.builtin.cameras import FIELD_OF_VIEW, RADIUS, look_at_origin
from gridreg.scenes.builtin.raycast import render_rgba
from gridreg.training import TrainOptions, configure, execute
from gridreg.training.files import write_json

STUDY = "own_photographs"
Array = NDArray[np.float64]


def poses_around(count: int) -> list[Array]:
    """Return cameras of a walk around, twice: rings at 20 and 42 degrees, the second between those of the first."""
    rings = ((20.0, count - count // 2), (42.0, count // 2))
    return [
        look_at_origin(360.0 * (k + 0.5 * ring) / number, elevation)
        for ring, (elevation, number) in enumerate(rings)
        for k in range(number)
    ]


def take_photographs(folder: Path, poses: list[Array], size: int) -> float:
    """Write one JPEG on white for each pose, with the focal length that a phone notes; return it in pixels."""
    folder.mkdir()
    focal = size / 2 / math.tan(FIELD_OF_VIEW / 2)
    exif = Image.Exif()
    # Equivalent by the diagonal, as of a film of 36 by 24 mm.
    equivalent = focal * math.hypot(36, 24) / math.hypot(size, size)
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(equivalent)}
    for k, pose in enumerate(poses):
        rgba = render_rgba(
            pose, np.array([focal, focal, size / 2, size / 2]), size, size, samples=1 if size > 800 else 2
        )
        image = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"photograph_{k:03d}.jpg", quality=95, exif=exif)
    return focal


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Return scale, rotation ``(3, 3)`` and shift ``(3,)`` that take points ``(N, 3)`` closest to others."""
    matrix = procrustes(source, target, reflection=False, return_cost=False)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return scale, matrix[:3, :3] / scale, matrix[:3, 3]


def robust_similarity(source: Array, target: Array, rounds: int = 6) -> tuple[float, Array, Array]:
    """Return the `similarity` of points that agree: a round leaves out those further off than 3 times the median."""
    kept = np.ones(len(source), dtype=bool)
    for _ in range(rounds):
        scale, rotation, shift = similarity(source[kept], target[kept])
        off = np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)
        kept = off <= 3 * np.median(off) + 1e-12
    return scale, rotation, shift


def with_true_cameras(scene: Path, out: Path, truth: dict[str, Array], focal: float) -> dict[str, float]:
    """Write a copy of a prepared scene with the true cameras in its world; return the errors of the estimated ones."""
    content = json.loads((scene / "transforms.json").read_text())
    names = [Path(frame["file_path"]).stem for frame in content["frames"]]
    estimated = np.array([frame["transform_matrix"] for frame in content["frames"]])
    true = np.stack([truth[name] for name in names])
    scale, rotation, shift = robust_similarity(true[:, :3, 3], estimated[:, :3, 3])
    moved = true.copy()
    moved[:, :3, :3] = rotation @ true[:, :3, :3]
    moved[:, :3, 3] = scale * true[:, :3, 3] @ rotation.T + shift
    size = int(content["w"])
    lens = {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2}
    frames = [
        {"file_path": frame["file_path"], "transform_matrix": pose.tolist()}
        for frame, pose in zip(content["frames"], moved, strict=True)
    ]
    out.mkdir()
    shutil.copytree(scene / "images", out / "images")
    write_json(out / "transforms.json", {**lens, "gridreg": content["gridreg"], "frames": frames})
    turns = np.einsum("nij,nij->n", estimated[:, :3, :3], moved[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((turns - 1) / 2, -1, 1)))
    off = np.linalg.norm(estimated[:, :3, 3] - moved[:, :3, 3], axis=1) / (RADIUS * scale)
    return {
        "rotation_degrees_median": float(np.median(angles)),
        "position_share_of_distance_median": float(np.median(off)),
        "misplaced": float((angles > 5).sum()),
        "focal_share": float(content["fl_x"] / focal - 1),
    }


def score(folder: Path, out: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    options = TrainOptions(
        scene=folder,
        protocol="holdout8",
        preset=arguments.preset,
        seed=arguments.seed,
        steps=arguments.steps,
    )
    config = configure(options)
    scene = load_scene(folder, "holdout8")
    _, metrics = execute(config, scene, out)
    if metrics is None:
        raise KeyboardInterrupt
    return {**metrics, "config": {**metrics["config"], "scene": folder.name}}


def run(arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    poses = poses_around(arguments.photographs)
    focal = (
        take_photographs(scratch / "photographs", poses, arguments.taken) * arguments.size / arguments.taken
    )
    made = prepare(
        scratch / "photographs",
        scratch / "estimated",
        longest_edge=arguments.size,
        progress=lambda stage: print(f"{stage} ...", file=sys.stderr, flush=True),
    )
    print(made, flush=True)
    truth = {f"photograph_{k:03d}": pose for k, pose in enumerate(poses)}
    errors = with_true_cameras(scratch / "estimated", scratch / "true", truth, focal)
    print("estimated cameras:", {name: f"{value:.2g}" for name, value in errors.items()}, flush=True)
    figures: dict[str, Any] = {
        "pictures": len(poses),
        "taken": arguments.taken,
        "size": arguments.size,
        "registered": len(made.registered),
        "camera_errors": errors,
        "command": stored.command_line("benchmarks/own_photographs.py"),
    }
    if arguments.cameras_only:
        return figures
    for name in ("estimated", "true"):
        figures[name] = score(scratch / name, scratch / f"run_{name}", arguments)
    means = {name: figures[name]["mean"]["psnr"] for name in ("estimated", "true")}
    figures["psnr_loss"] = means["true"] - means["estimated"]
    return figures


def run_on_sheet(arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    made = builtin_photographs(stored.SCENES, count=arguments.photographs, size=arguments.taken)
    out, truth = scratch / "out", made / "truth"
    words = ["reconstruct", str(made / "photographs"), str(out), "--longest-edge", str(arguments.size)]
    words += ["--preset", arguments.preset, "--seed", str(arguments.seed)]
    words += ["--steps", str(arguments.steps)] if arguments.steps else []
    began, worked = time.monotonic(), time.process_time()
    if main_of_gridreg(words):
        raise KeyboardInterrupt
    seconds = {"wall": time.monotonic() - began, "processor": time.process_time() - worked}
    figures: dict[str, Any] = {
        "photographs": arguments.photographs,
        "taken": arguments.taken,
        "size": arguments.size,
        "registered": len(own_sheet.entries(out / "scene")),
        "seconds": seconds,
        "camera_errors": own_sheet.camera_errors(out / "scene", truth),
        "mask_overlap": own_sheet.mask_overlap(out / "scene", truth),
        "mesh": own_sheet.mesh_errors(out / "mesh.ply"),
        "command": stored.command_line("benchmarks/own_photographs.py"),
    }
    for name in ("seconds", "camera_errors", "mask_overlap", "mesh"):
        print(f"{name}:", {key: f"{value:.3g}" for key, value in figures[name].items()}, flush=True)
    if not arguments.cameras_only:
        for name in ("estimated", "true"):
            folder = own_sheet.with_test_views(out / "scene", truth, scratch / name, true=name == "true")
            figures[name] = score(folder, scratch / f"run_{name}", arguments)
        means = {name: figures[name]["mean"]["psnr"] for name in ("estimated", "true")}
        figures["psnr_loss"] = means["true"] - means["estimated"]
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photographs", "--pictures", type=int, default=40)
    parser.add_argument("--taken", type=int, default=1200, help="pixels of the photographs that are taken")
    parser.add_argument("--size", type=int, default=400, help="pixels of the photographs that are trained on")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--steps", type=int, help="iterations; the schedule's events move in proportion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--cameras-only", action="store_true", help="find the cameras, and end")
    parser.add_argument("--keep", type=Path, help="new folder for photographs, scenes and runs")
    parser.add_argument("--results", type=Path, default=stored.RESULTS, help="folder of the stored figures")
    parser.add_argument(
        "--sheet", action="store_true", help="the built-in photographs of the object on the sheet"
    )
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        if arguments.keep is not None:
            scratch = arguments.keep
            scratch.mkdir(parents=True)
        figures = (run_on_sheet if arguments.sheet else run)(arguments, scratch)
    print(f"registered {figures['registered']} of {arguments.photographs} photographs")
    if arguments.cameras_only:
        return 0
    print(
        f"PSNR with estimated cameras {figures['estimated']['mean']['psnr']:.2f} dB, with true ones "
        f"{figures['true']['mean']['psnr']:.2f} dB: loss {figures['psnr_loss']:.2f} dB"
    )
    length = "" if arguments.steps is None else f"-{arguments.steps}steps"
    scene = "sheet" if arguments.sheet else "builtin"
    name = f"{scene}-{arguments.photographs}x{arguments.size}-{arguments.preset}{length}-seed{arguments.seed}"
    stored.save(STUDY, name, figures, arguments.results)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
