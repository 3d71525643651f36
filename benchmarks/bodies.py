"""Reconstruct a body from 8 and from 50 views, and measure its mesh against the true one.

    python benchmarks/bodies.py --data DIR

DIR holds the subjects' folders, each with transforms and mesh_gt.ply. One record a run in
benchmarks/results/bodies.jsonl; meshes, and an image of them beside the truth, in outputs/bodies. Runs that are stored
already are not computed again; `python benchmarks/bodies.py --table` prints the table from the stored figures.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import stored
import torch
from mesh_image import mesh_image
from stored import Record

from gridreg.cli import run_cli
from gridreg.export import (
    Camera,
    Lens,
    Mesh,
    compare_meshes,
    orbit_of_box,
    read_mesh,
    save_mesh,
    write_mesh,
)
from gridreg.export.images import to_image
from gridreg.training import TrainOptions, configure, execute, open_scene
from gridreg.training.files import check_output_folder
from gridreg.training.images import labelled, row, save_png

STUDY = "bodies"
MESHES = Path("outputs/bodies")
TRUTH = "mesh_gt.ply"
# From the front (bodies face -y), from the side, and from behind; degrees around z.
AZIMUTHS = (0.0, 90.0, 180.0)


def record_name(subject: str, protocol: str, arguments: argparse.Namespace) -> str:
    length = "" if arguments.steps is None else f"-{arguments.steps}steps"
    return f"{subject}-{protocol}-{arguments.preset}{length}-seed{arguments.seed}"


def reconstruct(subject: Path, protocol: str, arguments: argparse.Namespace) -> None:
    """Train, cut out the mesh, compare it, store figures and mesh."""
    name = record_name(subject.name, protocol, arguments)
    target = arguments.meshes / f"{name}.ply"
    if stored.find(STUDY, name, arguments.results) and target.exists():
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
    scene = open_scene(config, cache=stored.SCENES)
    with tempfile.TemporaryDirectory() as out:
        run, metrics = execute(config, scene, out)
        if metrics is None:
            raise KeyboardInterrupt
        trainer = run.trainer
        mesh = write_mesh(
            trainer.field, Path(out) / "mesh.ply", trainer.occupancy, resolution=arguments.resolution
        )
        model = trainer.model
        renders = [to_image(model.render(camera), "rgb") for camera in cameras(truth)]  # type: ignore[arg-type]
    comparison = compare_meshes(mesh, truth)
    metrics["config"] = {**metrics["config"], "scene": subject.name}
    metrics["command"] = stored.command_line("benchmarks/bodies.py")
    metrics["mesh"] = {
        **comparison.to_dict(),
        "watertight": mesh.watertight,
        "volume": mesh.volume,
        "faces": len(mesh.faces),
        "density_threshold": mesh.threshold,
        "resolution": arguments.resolution,
    }
    save_mesh(mesh, target)
    save_png(target.with_suffix(".png"), row(renders))
    stored.save(STUDY, name, metrics, arguments.results)
    print(table_row(metrics), flush=True)


def cameras(truth: Mesh, width: int = 220, height: int = 420) -> list[Camera]:
    """Return where the images are taken from: around the true mesh, the same for every run."""
    low, high = truth.vertices.min(axis=0), truth.vertices.max(axis=0)
    orbit = orbit_of_box(torch.tensor(np.stack([low, high]), dtype=torch.float32), elevation=5.0, angle=38.0)
    lens = Lens.from_angle(20.0, height, width)
    return [Camera(orbit.pose(azimuth), lens) for azimuth in AZIMUTHS]


def draw(subject: Path, protocols: list[str], arguments: argparse.Namespace) -> Path:
    """Draw one image: a row for each number of views and one for the truth; shape, colours, renders."""
    truth = read_mesh(subject / TRUTH)
    places = cameras(truth)
    rows = []
    for protocol in protocols:
        name = record_name(subject.name, protocol, arguments)
        metrics = stored.find(STUDY, name, arguments.results)
        assert metrics is not None
        mesh = read_mesh(arguments.meshes / f"{name}.ply")
        figures = metrics["mesh"]
        title = (
            f"{protocol}: PSNR {metrics['mean']['psnr']:.2f} dB, Chamfer {figures['chamfer_relative']:.2%} of the "
            f"diagonal, F-score {figures['f_score']:.3f}, normals {figures['normal_consistency']:.3f}"
        )
        rows.append(labelled(_shown(mesh, places), title))
    rows.append(labelled(_shown(truth, places), f"{subject.name}: the true mesh"))
    width = max(r.shape[1] for r in rows)
    padded = [np.pad(r, ((0, 6), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    views = "+".join(p.removeprefix("human") for p in protocols)
    target: Path = arguments.meshes / f"{subject.name}-{views}views-{arguments.preset}.png"
    save_png(target, np.concatenate(padded))
    return target


def _shown(mesh: Mesh, places: list[Camera]) -> np.ndarray:
    shapes = [mesh_image(mesh, camera, colours=False) for camera in places]
    if mesh.colours is None:
        return row(shapes)
    return row([*shapes, *(mesh_image(mesh, camera, colours=True) for camera in places)])


def table_row(metrics: Record) -> str:
    mesh, mean = metrics["mesh"], metrics["mean"]
    return (
        f"| {metrics['scene']} | {metrics['protocol']} | {metrics['steps']} | {metrics['seed']} | {mean['psnr']:.2f} "
        f"| {mean['ssim_gaussian']:.4f} | {mesh['chamfer_relative']:.2%} | {mesh['accuracy_relative']:.2%} "
        f"| {mesh['completeness_relative']:.2%} | {mesh['f_score']:.3f} | {mesh['normal_consistency']:.3f} "
        f"| {metrics['seconds']['train']:.0f} |"
    )


def table(results: Path) -> None:
    print(
        "| body | protocol | steps | seed | PSNR (dB) | SSIM 11x11 | Chamfer | mesh to truth | truth to mesh "
        "| F-score (1 %) | normals | training (s) |"
    )
    print("|---" * 12 + "|")
    for record in stored.load(STUDY, results):
        print(table_row(record))


def main() -> int:
    parser = stored.parser_of(__doc__, threads=True)
    parser.add_argument("--data", type=Path, help="folder that holds the subjects")
    parser.add_argument("--subjects", nargs="+", default=["subject_a"])
    parser.add_argument("--protocols", nargs="+", default=["human8", "human50"])
    parser.add_argument("--preset", default="human")
    parser.add_argument("--steps", type=int, help="iterations; the schedule's events move in proportion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", type=int, default=256, help="lattice nodes of the mesh")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="such as train.rays=2048")
    parser.add_argument(
        "--meshes", type=Path, default=MESHES, help="folder of the meshes; default: %(default)s"
    )
    parser.add_argument("--table", action="store_true", help="print what is stored, and end")
    arguments = parser.parse_args()
    if arguments.table:
        table(arguments.results)
        return 0
    if arguments.data is None:
        parser.error("--data: expected the folder that holds the subjects")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    check_output_folder(arguments.meshes)
    for name in arguments.subjects:
        for protocol in arguments.protocols:
            reconstruct(arguments.data / name, protocol, arguments)
        print(draw(arguments.data / name, arguments.protocols, arguments))
    return 0


if __name__ == "__main__":
    raise SystemExit(run_cli(main))
