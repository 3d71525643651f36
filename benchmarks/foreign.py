"""What a composition gains on fields of other people's, and what it costs: a bare field beside one with gridreg.

    python benchmarks/foreign.py --data DIR --scenes builtin lego --fields tensorf kplanes hash mlp --seeds 0 1 2

The fields are nerfstudio's TensoRFField, NerfactoField (hash grid, its torch implementation) and NeRFField, and
K-Planes as `kplanes-nerfstudio` has it; needs both packages. Each is trained twice from the same start, in turns, one
step of the one and one of the other, in a loop that knows of gridreg only `handle.step` and `handle.loss`. With
`--candidates`, all compositions are scored on validation views instead of the chosen one on test views.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
import types
from collections.abc import Sequence
from pathlib import Path

import stored
import torch
from foreign_fields import compositions, make
from torch import Tensor, nn
from torch.nn import functional as F

import gridreg
from gridreg.cli import run_cli
from gridreg.rendering.rays import box_intersection, camera_rays
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.training.versions import versions

STUDY = "foreign"
SIZE, RAYS, SAMPLES = 100, 384, 64
FIELDS = ("tensorf", "kplanes", "hash", "mlp")


class Training:
    """A field, its optimizer and its handle; one step at a time."""

    def __init__(self, name: str, composition: str | None, scene: Scene, steps: int, seed: int) -> None:
        self.foreign, self.scene, self.steps = make(name, scene.bounds, seed), scene, steps
        self.generator = torch.Generator().manual_seed(seed)
        regularizers = [] if composition is None else compositions(self.foreign)[composition]
        self.handle = (
            gridreg.apply(self.foreign.field, *regularizers, total_steps=steps) if regularizers else None
        )
        self.optimizer = self._optimizer()
        views = scene.train
        rays = [camera_rays(p, k, SIZE, SIZE) for p, k in zip(views.poses, views.intrinsics, strict=True)]
        self.origins, self.directions = (
            torch.cat([getattr(r, key) for r in rays]) for key in ("origins", "directions")
        )
        self.target = views.composited(scene.background).reshape(-1, 3)
        self.seconds: list[float] = []

    def _optimizer(self) -> torch.optim.Optimizer:
        groups: dict[float, list[nn.Parameter]] = {}
        for key, parameter in self.foreign.field.named_parameters():
            rate = next((rate for start, rate in self.foreign.rates.items() if key.startswith(start)), 2e-3)
            groups.setdefault(rate, []).append(parameter)
        return torch.optim.Adam(
            [{"params": values, "lr": rate} for rate, values in groups.items()], eps=1e-15
        )

    def render(
        self, origins: Tensor, directions: Tensor, jitter: Tensor | float
    ) -> tuple[Tensor, gridreg.RaySamples]:
        """Colours `(R, 3)` and the samples of rays, at equal distances inside the box."""
        rays = types.SimpleNamespace(origins=origins, directions=directions)
        start, end = box_intersection(rays, self.scene.bounds, self.scene.near, self.scene.far)  # type: ignore[arg-type]
        delta = ((end - start).clamp_min(0) / SAMPLES)[:, None].expand(-1, SAMPLES)
        t = start[:, None] + (torch.arange(SAMPLES) + jitter) * delta
        density, colour = self.query(origins[:, None] + t[..., None] * directions[:, None], directions)
        samples = gridreg.RaySamples.from_dense(t, delta, density)
        weights = samples.weights.view_as(t)
        colour = (weights[..., None] * colour).sum(1) + (
            1 - weights.sum(1, keepdim=True)
        ) * self.scene.background
        return colour, samples

    def query(self, x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density `(R, S)` and colour `(R, S, 3)` at positions `(R, S, 3)`, by the field's own way of being called."""
        from nerfstudio.cameras.rays import Frustums, RaySamples
        from nerfstudio.field_components.field_heads import FieldHeadNames

        at = torch.zeros_like(x[..., :1])
        frustums = Frustums(x, directions[:, None].expand_as(x), at, at, torch.ones_like(at))
        found = self.foreign.field(RaySamples(frustums, camera_indices=at.long()))
        return found[FieldHeadNames.DENSITY].squeeze(-1), found[FieldHeadNames.RGB]

    def step(self, step: int) -> None:
        """Train on one batch; grids that grow do so at a quarter and at half of the run."""
        begin = time.perf_counter()
        if self.foreign.grow and step in (self.steps // 4, self.steps // 2):
            with self.handle.suspended() if self.handle else torch.no_grad():
                for name in self.foreign.grow:
                    self.foreign.field.get_submodule(name).upsample_grid(72 if step < self.steps // 2 else 96)
            self.optimizer = self._optimizer()
        chosen = torch.randint(len(self.origins), (RAYS,), generator=self.generator)
        if self.handle:
            self.handle.step(step)
        jitter = torch.rand(RAYS, 1, generator=self.generator)
        colour, samples = self.render(self.origins[chosen], self.directions[chosen], jitter)
        loss = F.mse_loss(colour, self.target[chosen])
        if self.handle:
            loss = loss + self.handle.loss(samples)
        for group in self.optimizer.param_groups:
            group["lr"] *= 0.1 ** (1 / self.steps)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.seconds.append(time.perf_counter() - begin)

    @torch.no_grad()
    def psnr(self, split: str) -> float:
        """Mean over at most eight views, evenly spread, dB."""
        views, found = getattr(self.scene, split), []
        for i in range(0, len(views), -(-len(views) // 8)):
            pose, intrinsics = views.poses[i], views.intrinsics[i]
            target = views.composited(self.scene.background)[i]
            rays = camera_rays(pose, intrinsics, SIZE, SIZE)
            chunks = zip(rays.origins.split(2048), rays.directions.split(2048), strict=True)
            image = torch.cat([self.render(*chunk, 0.5)[0] for chunk in chunks]).clamp(0, 1)
            found.append(-10 * float(F.mse_loss(image, target.reshape(-1, 3)).log10()))
        return statistics.fmean(found)


def open_scene(name: str, data: Path | None) -> Scene:
    """The built-in scene or one of ``data``, at 100x100, with validation views."""
    if name == "builtin":
        folder = builtin_scene(Path(tempfile.gettempdir()) / f"gridreg-builtin-{SIZE}", size=SIZE)
        return load_scene(folder, "builtin8", validation=6)
    if data is None:
        raise gridreg.InputError(f"--scenes {name}: expected --data, the folder that holds it")
    return load_scene(data / name, "dietnerf8", size=SIZE, validation=6)


def compare(
    name: str, composition: str, scene: Scene, label: str, seed: int, options: argparse.Namespace
) -> None:
    """Train the pair, and store it, unless it is stored already."""
    split = "validation" if options.candidates else "test"
    key = f"{label}-{name}-{composition}-{split}-seed{seed}" + (
        "" if options.steps == 600 else f"-{options.steps}steps"
    )
    if stored.find(STUDY, key, options.results):
        return
    pair = [Training(name, chosen, scene, options.steps, seed) for chosen in (None, composition)]
    for step in range(options.steps):
        for training in pair if step % 2 else reversed(pair):
            training.step(step)
    bare, attached = (training.psnr(split) for training in pair)
    first, second = (statistics.median(training.seconds) for training in pair)
    record = {
        "scene": label,
        "field": name,
        "composition": composition,
        "regularizers": gridreg.to_config(compositions(pair[1].foreign)[composition]),
        "split": split,
        "seed": seed,
        "steps": options.steps,
        "psnr": {"bare": bare, "attached": attached},
        "step_seconds": {"bare": first, "attached": second},
        "versions": versions(),
        "command": [
            "benchmarks/foreign.py",
            "--data",
            "DIR",
            "--scenes",
            label,
            "--fields",
            name,
            "--seeds",
            str(seed),
        ]
        + (["--candidates"] if options.candidates else [])
        + ([] if options.steps == 600 else ["--steps", str(options.steps)]),
    }
    stored.save(STUDY, key, record, options.results)
    print(f"{key}: {bare:.2f} -> {attached:.2f} dB, step {100 * (second / first - 1):+.0f} %", flush=True)


def chosen(name: str, results: Path) -> str:
    """Return the composition that gained most on validation views, in the mean of what `--candidates` stored.

    Raises:
        InputError: if nothing is stored for this field.
    """
    gains: dict[str, list[float]] = {}
    for record in stored.load(STUDY, results):
        if record["field"] == name and record["split"] == "validation":
            gains.setdefault(record["composition"], []).append(
                record["psnr"]["attached"] - record["psnr"]["bare"]
            )
    if not gains:
        raise gridreg.InputError(
            f"--fields {name}: no composition is chosen yet; run with --candidates first"
        )
    return max(gains, key=lambda composition: statistics.fmean(gains[composition]))


def main(words: Sequence[str] | None = None) -> int:
    """Parse the command line, and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder that holds the scenes")
    parser.add_argument("--scenes", nargs="+", default=["builtin"])
    parser.add_argument("--fields", nargs="+", choices=FIELDS, default=list(FIELDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--candidates", action="store_true", help="all compositions, on validation views")
    parser.add_argument("--results", type=Path, default=stored.RESULTS)
    options = parser.parse_args(words)
    torch.set_num_threads(options.threads)
    for label in options.scenes:
        scene = open_scene(label, options.data)
        for name in options.fields:
            names = (
                list(compositions(make(name, scene.bounds, 0)))
                if options.candidates
                else [chosen(name, options.results)]
            )
            for seed in options.seeds:
                for composition in names:
                    compare(name, composition, scene, label, seed, options)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
