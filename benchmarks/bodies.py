"""Reconstruct a body from 8 and from 50 views, and measure its mesh against the true one.

    python benchmarks/bodies.py --data DIR

DIR holds the subjects' folders, each with transforms and mesh_gt.ply. One JSON file a run in
benchmarks/results/bodies/, and a picture of the meshes beside the truth. Runs that are stored already are not computed
again; `python benchmarks/bodies.py --table` prints the table from the stored files.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
from mesh_pictures import mesh_picture
from stored_command import stored_command

from gridreg.cli import run_cli
from gridreg.export import (
    Camera,
    Lens,
    Mesh,
    compare_meshes,
    model_of_trainer,
    orbit_of_box,
    read_mesh,
    save_mesh,
    write_mesh,
)
from gridreg.export.pictures import picture
from gridreg.training import TrainOptions, configure, execute, open_scene
from gridreg.training.files import check_output_folder, write_json
from gridreg.training.images import labelled, row, save_png

RESULTS = Path(__file__).parent / "results" / "bodies"
TRUTH = "mesh_gt.ply"
# From the front (bodies face -y), from the side, and from behind; degrees around z.
AZIMUTHS = (0.0, 90.0, 180.0)


def result_path(folder: Path, subject: str, protocol: str, arguments: argparse.Namespace) -> Path:
    length = "" if arguments.steps is None else f"-{arguments.steps}steps"
    return folder / f"{subject}-{protocol}-{arguments.preset}{length}-seed{arguments.seed}.json"


def reconstruct(subject: Path, protocol: str, arguments: argparse.Namespace) -> None:
    """Train, cut out the mesh, compare it, store figures and mesh."""
    target = result_path(arguments.results, subject.name, protocol, arguments)
    if target.exists() and target.with_suffix(".ply").exists():
        return
    truth = read_mesh(subject / TRUTH)
    options = TrainOptions(
        scene=subject,
        protocol=protocol,
        preset=arguments.preset,
        seed=arguments.seed,
        steps=arguments.steps,
        set=tuple(arguments.set),
    )
    config = configure(options)
    scene = open_scene(config, cache=Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory() as out:
        run, metrics = execute(config, scene, out)
        if metrics is None:
            raise KeyboardInterrupt
        trainer = run.trainer
        mesh = write_mesh(
            trainer.field, Path(out) / "mesh.ply", trainer.occupancy, resolution=arguments.resolution
        )
        model = model_of_trainer(trainer)
        renders = [picture(model.render(camera), "rgb") for camera in cameras(truth)]  # type: ignore[arg-type]
    comparison = compare_meshes(mesh, truth)
    metrics["config"] = {**metrics["config"], "scene": subject.name}
    metrics["command"] = stored_command("benchmarks/bodies.py")
    metrics["mesh"] = {
        **comparison.to_dict(),
        "watertight": mesh.watertight,
        "volume": mesh.volume,
        "faces": len(mesh.faces),
        "density_threshold": mesh.threshold,
        "resolution": arguments.resolution,
    }
    save_mesh(mesh, target.with_suffix(".ply"))
    save_png(target.with_suffix(".png"), row(renders))
    write_json(target, metrics)
    print(table_row(metrics), flush=True)


def cameras(truth: Mesh, width: int = 220, height: int = 420) -> list[Camera]:
    """Where the pictures are taken from: around the true mesh, the same for every run."""
    low, high = truth.vertices.min(axis=0), truth.vertices.max(axis=0)
    orbit = orbit_of_box(torch.tensor(np.stack([low, high]), dtype=torch.float32), elevation=5.0, angle=38.0)
    lens = Lens.from_angle(20.0, height, width)
    return [Camera(orbit.pose(azimuth), lens) for azimuth in AZIMUTHS]


def draw(subject: Path, protocols: list[str], arguments: argparse.Namespace) -> Path:
    """One picture: a row for each number of views and one for the truth; shape, colours, renders."""
    truth = read_mesh(subject / TRUTH)
    places = cameras(truth)
    rows = []
    for protocol in protocols:
        stored = result_path(arguments.results, subject.name, protocol, arguments)
        metrics = json.loads(stored.read_text())
        mesh = read_mesh(stored.with_suffix(".ply"))
        figures = metrics["mesh"]
        title = (
            f"{protocol}: PSNR {metrics['mean']['psnr']:.2f} dB, Chamfer {figures['chamfer_relative']:.2%} of the "
            f"diagonal, F-score {figures['f_score']:.3f}, normals {figures['normal_consistency']:.3f}"
        )
        rows.append(labelled(_shown(mesh, places), title))
    rows.append(labelled(_shown(truth, places), f"{subject.name}: the true mesh"))
    width = max(r.shape[1] for r in rows)
    padded = [np.pad(r, ((0, 6), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    name = "+".join(p.removeprefix("human") for p in protocols)
    target = arguments.results / f"{subject.name}-{name}views-{arguments.preset}.png"
    save_png(target, np.concatenate(padded))
    return target


def _shown(mesh: Mesh, places: list[Camera]) -> np.ndarray:
    shapes = [mesh_picture(mesh, camera, coloured=False) for camera in places]
    if mesh.colours is None:
        return row(shapes)
    return row([*shapes, *(mesh_picture(mesh, camera, coloured=True) for camera in places)])


def table_row(metrics: dict[str, Any]) -> str:
    mesh, mean = metrics["mesh"], metrics["mean"]
    return (
        f"| {metrics['scene']} | {metrics['protocol']} | {metrics['steps']} | {metrics['seed']} | {mean['psnr']:.2f} "
        f"| {mean['ssim_gaussian']:.4f} | {mesh['chamfer_relative']:.2%} | {mesh['accuracy_relative']:.2%} "
        f"| {mesh['completeness_relative']:.2%} | {mesh['f_score']:.3f} | {mesh['normal_consistency']:.3f} "
        f"| {metrics['seconds']['train']:.0f} |"
    )


def table(folder: Path) -> None:
    print(
        "| body | protocol | steps | seed | PSNR (dB) | SSIM 11x11 | Chamfer | mesh to truth | truth to mesh "
        "| F-score (1 %) | normals | training (s) |"
    )
    print("|---" * 12 + "|")
    for path in sorted(folder.glob("*.json")):
        print(table_row(json.loads(path.read_text())))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder that holds the subjects")
    parser.add_argument("--subjects", nargs="+", default=["subject_a"])
    parser.add_argument("--protocols", nargs="+", default=["human8", "human50"])
    parser.add_argument("--preset", default="human")
    parser.add_argument("--steps", type=int, help="iterations; the schedule's events move in proportion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--resolution", type=int, default=256, help="lattice nodes of the mesh")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="such as train.rays=2048")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--table", action="store_true", help="print what is stored, and end")
    arguments = parser.parse_args()
    if arguments.table:
        table(arguments.results)
        return 0
    if arguments.data is None:
        parser.error("--data: expected the folder that holds the subjects")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    check_output_folder(arguments.results)
    for name in arguments.subjects:
        for protocol in arguments.protocols:
            reconstruct(arguments.data / name, protocol, arguments)
        print(draw(arguments.data / name, arguments.protocols, arguments))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
