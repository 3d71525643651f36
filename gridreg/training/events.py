"""What happens to the grids between iterations: resampling, occupancy, shrinking, carving, ray filtering."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from gridreg.errors import InputError
from gridreg.rendering import MarchSettings, OccupancyGrid, visual_hull
from gridreg.training.rays import meets

if TYPE_CHECKING:
    from gridreg.scenes import Scene
    from gridreg.training.settings import TrainSettings
    from gridreg.training.trainer import Trainer

__all__ = [
    "carve",
    "carved_box",
    "cell_size",
    "filter_rays",
    "march_of",
    "occupancy_resolution",
    "resample",
    "resolution_of",
    "run",
    "shrink",
    "update_occupancy",
]


def cell_size(field: Any) -> float:
    """Mean edge of a grid cell, world units; a field without a resolution counts as 128 cells across."""
    resolution = getattr(field, "resolution", None)
    nodes = torch.tensor(resolution if resolution is not None else (129, 129, 129))
    return float(((field.bounds[1] - field.bounds[0]).cpu() / (nodes - 1)).mean())


def march_of(field: Any, settings: TrainSettings, near: float, far: float) -> MarchSettings:
    """How rays are walked at a field's present resolution, between two distances, world units."""
    return MarchSettings(
        step=settings.step_ratio * cell_size(field),
        near=near,
        far=far,
        transmittance_bound=settings.transmittance_bound,
        weight_bound=settings.weight_bound,
        merge_weight=settings.pool_weight,
    )


def occupancy_resolution(field: Any, settings: TrainSettings) -> tuple[int, int, int]:
    """Occupancy cells along x, y, z: about as long as the field's, at most ``settings.occupancy_resolution``."""
    size = (field.bounds[1] - field.bounds[0]).cpu()
    edge = max(cell_size(field), float(size.max()) / settings.occupancy_resolution)
    x, y, z = (max(1, math.ceil(float(s) / edge - 1e-3)) for s in size)
    return x, y, z


def carved_box(scene: Scene, resolution: int = 128) -> torch.Tensor:
    """The box ``(2, 3)`` around the visual hull of the training views, inside the scene's own box.

    Raises:
        InputError: if the silhouettes leave nothing.
    """
    grid = OccupancyGrid.full(scene.bounds, (resolution, resolution, resolution))
    hull = visual_hull(grid, scene.train.rgba[..., 3], scene.train.poses, scene.train.intrinsics)
    if not bool(hull.any()):
        raise InputError(
            f"scene {scene.name}: the silhouettes of the training views leave no cell of the box "
            f"{scene.bounds.tolist()}; expected an object inside it: check alpha, poses and box"
        )
    return OccupancyGrid(grid.bounds, hull).tight_bounds()


def carve(trainer: Trainer) -> None:
    """Start from the cells that no training view's alpha proves empty."""
    views, grid = trainer.scene.train, trainer.occupancy
    hull = visual_hull(grid, views.rgba[..., 3], views.poses, views.intrinsics)
    trainer.occupancy = OccupancyGrid(grid.bounds, hull, hull)
    _require_occupied(trainer, "the silhouettes of the training views leave no cell")


def shrink(trainer: Trainer) -> None:
    """Crop the field to the occupied cells."""
    field = trainer.field
    with trainer.handle.suspended():
        field.shrink(trainer.occupancy.tight_bounds())
    _rebuild(trainer)


def resample(trainer: Trainer) -> None:
    """Give the field the schedule's next resolution."""
    settings, field = trainer.settings, trainer.field
    done = sum(s <= trainer.step for s in settings.resample_at)
    with trainer.handle.suspended():
        field.resample(resolution_of(settings.voxels_at(done), field.bounds))
    _rebuild(trainer)


def _rebuild(trainer: Trainer) -> None:
    resolution = occupancy_resolution(trainer.field, trainer.settings)
    trainer.occupancy = trainer.occupancy.at(trainer.field.bounds, resolution)
    if trainer.carves:
        hull = OccupancyGrid.full(trainer.field.bounds, resolution)
        views = trainer.scene.train
        hull.cells = visual_hull(hull, views.rgba[..., 3], views.poses, views.intrinsics)
        trainer.occupancy = OccupancyGrid(hull.bounds, trainer.occupancy.cells * hull.cells, hull.cells)
    trainer.restart_optimizer()


def resolution_of(voxels: float, bounds: torch.Tensor) -> tuple[int, int, int]:
    """Nodes along x, y, z of a grid with cubic cells and about ``voxels`` of them (TensoRF ``N_to_reso``).

    Example:
        >>> resolution_of(8e3, torch.tensor([[0., 0., 0.], [1., 1., 1.]]))
        (20, 20, 20)
    """
    size = (bounds[1] - bounds[0]).double()
    edge = float((size.prod() / voxels) ** (1 / 3))
    x, y, z = (max(2, int(round(float(s) / edge, 6))) for s in size)
    return x, y, z


def update_occupancy(trainer: Trainer) -> None:
    """Find the empty cells.

    Raises:
        InputError: if no cell is left, which is a training that has died.
    """
    trainer.occupancy.update(
        trainer.field.density, trainer.march.step, threshold=trainer.settings.occupancy_threshold
    )
    _require_occupied(trainer, "the density has vanished everywhere")


def _require_occupied(trainer: Trainer, why: str) -> None:
    if not bool(trainer.occupancy.cells.any()):
        raise InputError(
            f"step {trainer.step}: the occupancy grid is empty ({why}); expected something inside the box "
            f"{trainer.field.bounds.tolist()}: check the box, or start from a higher initial opacity"
        )


def filter_rays(trainer: Trainer) -> None:
    """Draw only rays that meet an occupied cell, or whose pixel is not transparent."""
    near, far = trainer.scene.near, trainer.scene.far
    trainer.bank.restrict(lambda rays: meets(rays, trainer.occupancy, near, far))


def run(trainer: Trainer) -> None:
    """The events that are due after iteration ``trainer.step``."""
    step, settings = trainer.step, trainer.settings
    if step >= settings.steps:
        return
    started = bool(settings.occupancy_at) and step > min(settings.occupancy_at)
    regular = settings.occupancy_every and started and step % settings.occupancy_every == 0
    if step in settings.occupancy_at or regular:
        update_occupancy(trainer)
    # A field without a grid, such as a coordinate network, has nothing to crop or to refine.
    if step in settings.shrink_at and hasattr(trainer.field, "shrink"):
        shrink(trainer)
    if step in settings.filter_rays_at:
        filter_rays(trainer)
    if step in settings.resample_at and hasattr(trainer.field, "resample"):
        resample(trainer)
