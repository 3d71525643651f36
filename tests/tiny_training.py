"""A schedule for tests that need a trained field, not a good one."""

from gridreg.training import TrainSettings

__all__ = ["NO_EVENTS"]

NO_EVENTS = TrainSettings(
    steps=1,
    rays=64,
    voxels_start=1000,
    voxels_end=1000,
    resample_at=(),
    occupancy_at=(),
    shrink_at=(),
    filter_rays_at=(),
)
"""One small grid from beginning to end."""
