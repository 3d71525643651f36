"""Everything that determines a run, as plain data."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from gridreg.errors import ConfigError

_AT_LEAST = {
    "steps": 1,
    "rays": 1,
    "patches": 1,
    "patch_size": 2,
    "voxels_start": 1,
    "voxels_end": 1,
    "occupancy_resolution": 1,
    "occupancy_every": 0,
}
# Of every integer above: more is a slip of the hand, and would end as an overflow somewhere.
_MOST = 10**9


@dataclass(frozen=True)
class TrainSettings:
    """The schedule of a run; the defaults are TensoRF's for the synthetic scenes.

    Args:
        steps: iterations.
        rays: per iteration.
        reshuffle: draw every pixel once before any is drawn again, in an order that is new each time; False: with
            replacement.
        patches, patch_size: further rays per iteration where a regularizer needs them (`DepthSmoothness`, `RayKL`): so
            many square patches of so many rays along each edge, from cameras between the training cameras.
        learning_rate_grid, learning_rate_network: Adam's, at the start (betas 0.9 and 0.99).
        learning_rate_decay: factor over the whole run, exponential in the iteration.
        reset_learning_rate: start the decay again at every resampling, as TensoRF does.
        voxels_start, voxels_end: cells of the grid; resampled in logarithmic steps.
        resample_at: iterations of the resamplings.
        occupancy_at: iterations at which empty cells are found.
        occupancy_every: also every so many iterations after the first of those; 0: never.
        occupancy_resolution: largest number of occupancy cells along an axis.
        occupancy_threshold: opacity over one step below which a cell is empty.
        shrink_at: iterations at which the box shrinks to the occupied cells; a subset of ``occupancy_at``.
        filter_rays_at: iterations from which rays that meet no occupied cell are not drawn any more.
        carve: start from the visual hull of the training views' alpha.
        step_ratio: ray step in cells.
        weight_bound: colour is evaluated where the weight exceeds this.
        merge_weight: low-weight samples, lighter than this, are merged with their neighbours on the ray and have the
            colour of one of them, in training drawn by weight (see `gridreg.ops.merging`); 0: every sample has its own.
        feature_weight: neighbours on a ray have one colour, that of their mean features, until they weigh this much, in
            a field that offers it (see `gridreg.ops.average_features`); 0: every one has its own.
        stochastic_rounding: gradients of densities below this fraction of their mean size are rounded at random, to 0
            or to it, so that their expectation stays; a field that does not offer it has all of them. 0: none.
        transmittance_bound: samples behind this transmittance are dropped.
        average_from: fraction of the run from which the mean of the iterates is kept (every fifth of them, none from
            before the last resampling); at the end of the run it takes the place of the last one. 1: the last stays.
        checkpoint_minutes: between checkpoints.
        evaluate_at: iterations at which the validation views (or, without them, some test views) are scored on the way.
        surroundings: learn what is outside the box in a coarse field of its own, see
            `gridreg.training.surroundings.wants_surroundings`.
        exposure: estimate a gain and a white balance of each training photograph, see `gridreg.training.exposure`.
    """

    steps: int = 15_000
    rays: int = 1024
    reshuffle: bool = False
    patches: int = 1
    patch_size: int = 8
    learning_rate_grid: float = 0.02
    learning_rate_network: float = 1e-3
    learning_rate_decay: float = 0.1
    reset_learning_rate: bool = True
    voxels_start: int = 128**3
    voxels_end: int = 300**3
    resample_at: tuple[int, ...] = (2000, 3000, 4000, 5500, 7000)
    occupancy_at: tuple[int, ...] = (2000, 4000)
    occupancy_every: int = 0
    occupancy_resolution: int = 128
    occupancy_threshold: float = 1e-4
    shrink_at: tuple[int, ...] = (2000,)
    filter_rays_at: tuple[int, ...] = (4000,)
    carve: bool = False
    step_ratio: float = 0.5
    weight_bound: float = 1e-4
    merge_weight: float = 0.0
    feature_weight: float = dataclasses.field(default=0.0, metadata={"unset": True})
    stochastic_rounding: float = 0.0
    transmittance_bound: float = 1e-4
    average_from: float = 1.0
    checkpoint_minutes: float = 2.0
    evaluate_at: tuple[int, ...] = ()
    surroundings: bool | Literal["auto"] = dataclasses.field(default="auto", metadata={"unset": True})
    exposure: bool = dataclasses.field(default=False, metadata={"unset": True})

    def __post_init__(self) -> None:
        for name, least in _AT_LEAST.items():
            value = getattr(self, name)
            if not least <= value <= _MOST:
                bound = f"at least {least}" if value < least else f"at most {_MOST:,}"
                raise ConfigError((name,), f"found {value}, expected an integer of {bound}")
        for name in ("learning_rate_grid", "learning_rate_network", "learning_rate_decay", "step_ratio"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ConfigError((name,), f"found {value}, expected a positive number")
        for name in ("occupancy_threshold", "weight_bound", "transmittance_bound", "feature_weight"):
            value = getattr(self, name)
            if not 0 <= value < 1:
                raise ConfigError((name,), f"found {value}, expected a number in [0, 1)")
        if not 0 <= self.average_from <= 1:
            raise ConfigError(("average_from",), f"found {self.average_from}, expected a fraction in [0, 1]")
        stray = [s for s in self.shrink_at if s not in self.occupancy_at]
        if stray:
            raise ConfigError(
                ("shrink_at",),
                f"found {stray[0]}, which is not in occupancy_at {self.occupancy_at}; "
                "the box can only shrink where the occupancy is known",
            )

    def scaled(self, steps: int) -> TrainSettings:
        """The same schedule over another number of iterations: every event moves in proportion."""

        def moved(events: tuple[int, ...]) -> tuple[int, ...]:
            return tuple(round(e * steps / self.steps) for e in events)

        return replace(
            self,
            steps=steps,
            resample_at=moved(self.resample_at),
            occupancy_at=moved(self.occupancy_at),
            occupancy_every=round(self.occupancy_every * steps / self.steps),
            shrink_at=moved(self.shrink_at),
            filter_rays_at=moved(self.filter_rays_at),
            evaluate_at=moved(self.evaluate_at),
        )

    def voxels_at(self, resampling: int) -> int:
        """Cells of the grid after the ``resampling``-th resampling (0: before the first)."""
        count = len(self.resample_at)
        if count == 0:
            return self.voxels_start
        share = resampling / count
        return round(math.exp((1 - share) * math.log(self.voxels_start) + share * math.log(self.voxels_end)))


@dataclass(frozen=True)
class RunConfig:
    """One run: what to reconstruct, with which field, regularizers and schedule.

    Args:
        preset: name of the preset that this started from, for the record.
        scene: folder in Blender format; None for the built-in scene.
        protocol: name, see `gridreg.scenes.PROTOCOLS`.
        backbone: name of a registered field (``vm``, ``cp``, ``mlp``).
        field: options of that field's constructor.
        train: the schedule.
        composition: regularizers as plain data, see `gridreg.from_config`; or the name of a composition.
        seed: of every random number.
        size: width of the images in pixels instead of the protocol's; see `gridreg.scenes.load_scene`.
        opaque: whether images without alpha are taken as opaque beside others that have it.
        modules: imported before the run is made, or read again: they register fields and regularizers of one's own.
    """

    preset: str = ""
    scene: str | None = None
    protocol: str | None = None
    backbone: str = "vm"
    field: dict[str, Any] = dataclasses.field(default_factory=dict)
    train: TrainSettings = dataclasses.field(default_factory=TrainSettings)
    composition: str | list[dict[str, Any]] = dataclasses.field(default_factory=list)
    seed: int = 0
    size: int | None = dataclasses.field(default=None, metadata={"unset": True})
    opaque: bool = dataclasses.field(default=False, metadata={"unset": True})
    modules: tuple[str, ...] = dataclasses.field(default=(), metadata={"unset": True})
