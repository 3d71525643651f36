"""The space that a field in training fills, and the events that change it between iterations."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch

from gridreg.errors import InputError
from gridreg.rendering import MarchSettings, OccupancyGrid, visual_hull
from gridreg.scenes import Scene
from gridreg.training.rays import RayBank, meets
from gridreg.training.settings import TrainSettings


class OccupiedSpace:
    """Box, occupied cells and visual hull of a field in training, and the schedule's events that change them.

    It knows nothing of the optimizer: `run` says whether it replaced the field's parameters.

    Args:
        field: ``resample(resolution)`` and ``shrink(bounds)`` are called if it has them; a field without a grid, such
            as a coordinate network, has nothing to crop or to refine.
        scene: training views, near and far.
        settings: when what is due.
        bank: of training rays, from which those that meet nothing are dropped.
        suspended: `gridreg.Handle.suspended` of what is attached to the field; parameters are replaced inside it.

    Raises:
        InputError: if the silhouettes leave no cell of the box.
    """

    def __init__(
        self,
        field: Any,
        scene: Scene,
        settings: TrainSettings,
        bank: RayBank,
        suspended: Callable[[], AbstractContextManager[Any]],
    ) -> None:
        self._field, self._scene, self._settings = field, scene, settings
        self._bank, self._suspended = bank, suspended
        self.occupancy = OccupancyGrid.full(field.bounds, occupancy_resolution(field, settings))
        if self.carves:
            hull = _hull(self.occupancy, self._scene)
            self.occupancy = OccupancyGrid(self.occupancy.bounds, hull, hull)
            self._require_occupied(0, "the silhouettes of the training views leave no cell")
        if 0 in settings.filter_rays_at:
            self.filter_rays()

    @property
    def carves(self) -> bool:
        """Whether the visual hull counts; cells of normalised device coordinates have no silhouettes."""
        return self._settings.carve and not self._scene.ndc

    @property
    def march(self) -> MarchSettings:
        """Settings of the march at the field's present resolution."""
        return march_of(self._field, self._settings, self._scene.near, self._scene.far)

    def run(self, step: int) -> bool:
        """Carry out the events that are due after ``step`` iterations; True if parameters were replaced.

        Raises:
            InputError: if no cell is left, which is a training that has died.
        """
        settings, replaced = self._settings, False
        if step >= settings.steps:
            return replaced
        started = bool(settings.occupancy_at) and step > min(settings.occupancy_at)
        regular = settings.occupancy_every and started and step % settings.occupancy_every == 0
        if step in settings.occupancy_at or regular:
            self.update(step)
        if step in settings.shrink_at and hasattr(self._field, "shrink"):
            self.shrink()
            replaced = True
        if step in settings.filter_rays_at:
            self.filter_rays()
        if step in settings.resample_at and hasattr(self._field, "resample"):
            self.resample(step)
            replaced = True
        return replaced

    def update(self, step: int) -> None:
        """Find the empty cells.

        Raises:
            InputError: if no cell is left.
        """
        threshold = self._settings.occupancy_threshold
        self.occupancy.update(self._field.density, self.march.step, threshold=threshold)
        self._require_occupied(step, "the density has vanished everywhere")

    def shrink(self) -> None:
        """Crop the field to the occupied cells."""
        with self._suspended():
            self._field.shrink(self.occupancy.tight_bounds())
        self._follow_field()

    def resample(self, step: int) -> None:
        """Give the field the resolution that the schedule has after ``step`` iterations (TensoRF's
        ``upsample_volume_grid``)."""
        done = sum(s <= step for s in self._settings.resample_at)
        with self._suspended():
            self._field.resample(resolution_of(self._settings.voxels_at(done), self._field.bounds))
        self._follow_field()

    def filter_rays(self) -> None:
        """Draw only rays that meet an occupied cell, or whose pixel is not transparent."""
        near, far = self._scene.near, self._scene.far
        self._bank.restrict(lambda rays: meets(rays, self.occupancy, near, far))

    def _follow_field(self) -> None:
        """The same cells in the field's new box, at its new resolution."""
        bounds, resolution = self._field.bounds, occupancy_resolution(self._field, self._settings)
        self.occupancy = self.occupancy.at(bounds, resolution)
        if self.carves:
            hull = _hull(OccupancyGrid.full(bounds, resolution), self._scene)
            self.occupancy = OccupancyGrid(self.occupancy.bounds, self.occupancy.cells * hull, hull)

    def _require_occupied(self, step: int, why: str) -> None:
        if not bool(self.occupancy.cells.any()):
            raise InputError(
                f"step {step}: the occupancy grid is empty ({why}); expected something inside the box "
                f"{self._field.bounds.tolist()}: check the box, or start from a higher initial opacity"
            )


def cell_size(field: Any) -> float:
    """Mean edge of a grid cell, world units; a field without a resolution counts as 128 cells across."""
    resolution = getattr(field, "resolution", None)
    nodes = torch.tensor(resolution if resolution is not None else (129, 129, 129))
    return float(((field.bounds[1] - field.bounds[0]).cpu() / (nodes - 1)).mean())


def march_of(field: Any, settings: TrainSettings, near: float, far: float) -> MarchSettings:
    """Settings of the march through a field of this resolution, between two distances, world units."""
    return MarchSettings(
        step=settings.step_ratio * cell_size(field),
        near=near,
        far=far,
        transmittance_bound=settings.transmittance_bound,
        weight_bound=settings.weight_bound,
        merge_weight=settings.merge_weight,
        feature_weight=settings.feature_weight,
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
    hull = _hull(grid, scene)
    if not bool(hull.any()):
        raise InputError(
            f"scene {scene.name}: the silhouettes of the training views leave no cell of the box "
            f"{scene.bounds.tolist()}; expected an object inside it: check alpha, poses and box"
        )
    return OccupancyGrid(grid.bounds, hull).tight_bounds()


def _hull(grid: OccupancyGrid, scene: Scene) -> torch.Tensor:
    """Cells that no silhouette of the training views proves empty; what is undecided may hold something."""
    views = scene.train
    return visual_hull(grid, views.silhouettes.nan_to_num(1.0), views.poses, views.intrinsics)


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
