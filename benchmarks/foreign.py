"""What a composition gains on fields of other people's, and what it costs: a bare field beside one with gridreg.

    python benchmarks/foreign.py choose --data DIR --scenes builtin lego --steps 200
    python benchmarks/foreign.py compare --data DIR --scenes builtin lego --seeds 0 1 2
    python benchmarks/foreign.py cost

The fields are nerfstudio's TensoRFField, NerfactoField (hash grid, its torch implementation) and NeRFField, and
K-Planes as `kplanes-nerfstudio` has it; needs both packages. Fields that are compared start alike and see the same
rays, in turns, a step of the one and a step of the other, in a loop that knows of gridreg only `handle.step`,
`handle.background` and `handle.loss`. `choose` scores pieces alone on validation views (seed 0), then those together
that gained; `compare` scores the best of all, in the mean of the scenes, on test views. `cost` times steps with masks
that are all open. Seconds are of processor time, so other programs do not count; give it one thread.
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
from foreign_fields import composition, make, pieces
from torch import Tensor, nn
from torch.nn import functional as F

import gridreg
from gridreg.cli import run_cli
from gridreg.rendering.rays import box_intersection, camera_rays
from gridreg.scenes import Scene, builtin_scene, load_scene
from gridreg.training.versions import versions

STUDY = "foreign"
SIZE, RAYS, SAMPLES, STEPS = 100, 192, 32, 400
FIELDS = ("tensorf", "kplanes", "hash", "mlp")
BARE, OPEN = "bare", "open"


class Training:
    """A field, its optimizer and its handle; one step at a time."""

    def __init__(self, field: str, name: str, scene: Scene, steps: int, seed: int) -> None:
        self.foreign, self.scene, self.steps = make(field, scene.bounds, seed), scene, steps
        self.generator = torch.Generator().manual_seed(seed)
        self.opened = name == OPEN
        self.regularizers = [*self.foreign.masks] if self.opened else []
        if name not in (BARE, OPEN):
            self.regularizers = composition(self.foreign, name)
        self.handle = None
        if self.regularizers:
            self.handle = gridreg.apply(self.foreign.field, *self.regularizers, total_steps=steps)
        self.optimizer = self._optimizer()
        views = scene.train
        rays = [camera_rays(p, k, SIZE, SIZE) for p, k in zip(views.poses, views.intrinsics, strict=True)]
        self.origins = torch.cat([r.origins for r in rays])
        self.directions = torch.cat([r.directions for r in rays])
        self.rgba = views.rgba.reshape(-1, 4)
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
        self, rays: tuple[Tensor, Tensor], jitter: Tensor | float, background: Tensor, alpha: Tensor | None
    ) -> tuple[Tensor, gridreg.RaySamples]:
        """Colours `(R, 3)` and the samples of rays, at equal distances inside the box."""
        origins, directions = rays
        both = types.SimpleNamespace(origins=origins, directions=directions)
        start, end = box_intersection(both, self.scene.bounds, self.scene.near, self.scene.far)  # type: ignore[arg-type]
        delta = ((end - start).clamp_min(0) / SAMPLES)[:, None].expand(-1, SAMPLES)
        t = start[:, None] + (torch.arange(SAMPLES) + jitter) * delta
        density, colour = self.query(origins[:, None] + t[..., None] * directions[:, None], directions)
        samples = gridreg.RaySamples.from_dense(t, delta, density, target_opacity=alpha)
        weights = samples.weights.view_as(t)
        left = 1 - weights.sum(1, keepdim=True)
        return (weights[..., None] * colour).sum(1) + left * background, samples

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
        begin = time.process_time()
        if self.foreign.grow and step in (self.steps // 4, self.steps // 2):
            with self.handle.suspended() if self.handle else torch.no_grad():
                for name in self.foreign.grow:
                    self.foreign.field.get_submodule(name).upsample_grid(72 if step < self.steps // 2 else 96)
            self.optimizer = self._optimizer()
        chosen = torch.randint(len(self.origins), (RAYS,), generator=self.generator)
        jitter = torch.rand(RAYS, 1, generator=self.generator)
        background, rgba = self.scene.background, self.rgba[chosen]
        if self.handle:
            # Past every end, masks are open.
            self.handle.step(step + 10**6 * self.opened)
            background = self.handle.background(RAYS, self.generator, background)
        rays = self.origins[chosen], self.directions[chosen]
        colour, samples = self.render(rays, jitter, background, rgba[:, 3])
        loss = F.mse_loss(colour, background + rgba[:, 3:] * (rgba[:, :3] - background))
        if self.handle:
            loss = loss + self.handle.loss(samples)
        for group in self.optimizer.param_groups:
            group["lr"] *= 0.1 ** (1 / self.steps)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.seconds.append(time.process_time() - begin)

    @torch.no_grad()
    def psnr(self, split: str) -> list[float]:
        """Of at most eight views, evenly spread, every second pixel of every second row, dB."""
        views, found = getattr(self.scene, split), []
        targets = views.composited(self.scene.background)
        for i in range(0, len(views), -(-len(views) // 8)):
            rays = camera_rays(views.poses[i], views.intrinsics[i], SIZE, SIZE)
            both = [x.view(SIZE, SIZE, 3)[::2, ::2].reshape(-1, 3) for x in (rays.origins, rays.directions)]
            chunks = zip(*(x.split(512) for x in both), strict=True)
            image = [self.render(chunk, 0.5, self.scene.background, None)[0] for chunk in chunks]
            error = F.mse_loss(torch.cat(image).clamp(0, 1), targets[i, ::2, ::2].reshape(-1, 3))
            found.append(-10 * float(error.log10()))
        return found


def cost(field: str, scene: Scene, options: argparse.Namespace) -> None:
    """Time steps of a field with open masks against bare ones, in turns, and store the quotient of each pair."""
    pair = [Training(field, name, scene, options.steps, 0) for name in (BARE, OPEN)]
    for step in range(options.steps):
        for training in pair[:: 1 if step % 2 else -1]:
            training.step(step)
    seconds = [statistics.median(training.seconds) for training in pair]
    record = {
        "field": field,
        "split": "cost",
        "steps": options.steps,
        "step_seconds": dict(zip((BARE, "attached"), seconds, strict=True)),
        "percent": 100 * (seconds[1] / seconds[0] - 1),
        "versions": versions(),
        "command": stored.command_line("benchmarks/foreign.py"),
    }
    stored.save(STUDY, f"{field}-open-masks", record, options.results)
    print(f"{field}: step {1000 * seconds[0]:.2f} ms bare, open masks {record['percent']:+.1f} %", flush=True)


def open_scene(name: str, data: Path | None) -> Scene:
    """The built-in scene or one of ``data``, at 100x100, with validation views."""
    if name == "builtin":
        folder = builtin_scene(Path(tempfile.gettempdir()) / f"gridreg-builtin-{SIZE}", size=SIZE)
        return load_scene(folder, "builtin8", validation=4)
    if data is None:
        raise gridreg.InputError(f"--scenes {name}: expected --data, the folder that holds it")
    return load_scene(data / name, "dietnerf8", size=SIZE, validation=4)


def train(
    names: Sequence[str], split: str, field: str, label: str, seed: int, options: argparse.Namespace
) -> None:
    """Train a field bare and with each composition that has no record yet, in turns, and store what they gain."""
    length = "" if options.steps == STEPS else f"-{options.steps}steps"
    keys = {name: f"{label}-{field}-{name}-{split}-seed{seed}{length}" for name in names}
    names = [name for name in names if not stored.find(STUDY, keys[name], options.results)]
    if not names:
        return
    scene = open_scene(label, options.data)
    trainings = {name: Training(field, name, scene, options.steps, seed) for name in (BARE, *names)}
    for step in range(options.steps):
        for training in list(trainings.values())[:: 1 if step % 2 else -1]:
            training.step(step)
    psnr = {name: training.psnr(split) for name, training in trainings.items()}
    seconds = {name: statistics.median(training.seconds) for name, training in trainings.items()}
    for name in names:
        record = {
            "scene": label,
            "field": field,
            "composition": name,
            "regularizers": gridreg.to_config(trainings[name].regularizers),
            "split": split,
            "seed": seed,
            "steps": options.steps,
            "psnr": {"bare": psnr[BARE], "attached": psnr[name]},
            "step_seconds": {"bare": seconds[BARE], "attached": seconds[name]},
            "versions": versions(),
            "command": stored.command_line("benchmarks/foreign.py"),
        }
        stored.save(STUDY, keys[name], record, options.results)
        gain, cost = mean_gain(record), 100 * (seconds[name] / seconds[BARE] - 1)
        bare = statistics.fmean(psnr[BARE])
        print(f"{keys[name]}: {bare:.2f} dB bare, {gain:+.2f} dB; step {cost:+.0f} %", flush=True)


def mean_gain(record: stored.Record) -> float:
    """Mean over the images, dB."""
    psnr = record["psnr"]
    return statistics.fmean(a - b for a, b in zip(psnr["attached"], psnr["bare"], strict=True))


def gains(field: str, options: argparse.Namespace) -> dict[str, list[float]]:
    """Gains on validation views by composition, dB: one for each scene, after however many steps."""
    found: dict[str, list[float]] = {}
    for record in stored.load(STUDY, options.results):
        if (record["field"], record["split"]) == (field, "validation"):
            found.setdefault(record["composition"], []).append(mean_gain(record))
    return found


def together(found: dict[str, list[float]]) -> list[str]:
    """Pieces that gained, joined: those that did in the mean, and those that did on every scene.

    Of each kind of piece the better strength.
    """
    best: dict[str, str] = {}
    for name in sorted(found, key=lambda name: statistics.fmean(found[name])):
        if "+" not in name:
            best[name.partition(":")[0]] = name
    means = [name for name in best.values() if statistics.fmean(found[name]) > 0]
    every = [name for name in means if min(found[name]) > 0]
    return list(dict.fromkeys("+".join(sorted(names)) for names in (means, every) if len(names) > 1))


def chosen(field: str, options: argparse.Namespace) -> str:
    """Return the composition that gained most on validation views, in the mean of the scenes.

    Raises:
        InputError: if nothing is stored for this field.
    """
    found = gains(field, options)
    if not found:
        raise gridreg.InputError(f"--fields {field}: no composition is chosen yet; run `choose` first")
    return max(found, key=lambda name: statistics.fmean(found[name]))


def main(words: Sequence[str] | None = None) -> int:
    """Parse the command line, and choose or compare."""
    parser = stored.parser_of(__doc__, threads=True)
    parser.add_argument("do", choices=("choose", "compare", "cost"))
    parser.add_argument("--data", type=Path, help="folder that holds the scenes")
    parser.add_argument("--scenes", nargs="+", default=["builtin"])
    parser.add_argument("--fields", nargs="+", choices=FIELDS, default=list(FIELDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of `compare`")
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args(words)
    if options.threads:
        torch.set_num_threads(options.threads)
    if options.do == "cost":
        for field in options.fields:
            cost(field, open_scene("builtin", None), options)
    elif options.do == "choose":
        for field in options.fields:
            alone = list(pieces(make(field, torch.tensor([[-1.0] * 3, [1.0] * 3]), 0)))
            for label in options.scenes:
                train(alone, "validation", field, label, 0, options)
            for label in options.scenes:
                train(together(gains(field, options)), "validation", field, label, 0, options)
    else:
        names = {field: chosen(field, options) for field in options.fields}
        for seed in options.seeds:
            for field, name in names.items():
                for label in options.scenes:
                    train([name], "test", field, label, seed, options)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
