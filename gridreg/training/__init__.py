"""The training loop and what it leaves behind: checkpoints, metrics, renders, curves."""

from gridreg.training.ensemble import save_ensemble
from gridreg.training.execute import Execution, Watch, execute
from gridreg.training.loading import LoadedRun, load_run
from gridreg.training.options import TrainOptions, configure, output_folder
from gridreg.training.presets import load_preset, preset_names
from gridreg.training.run import (
    build_trainer,
    open_scene,
    regularizers_of,
    resume_trainer,
    save_run,
)
from gridreg.training.settings import RunConfig, TrainSettings
from gridreg.training.trainer import StepReport, Trainer

__all__ = [
    "Execution",
    "LoadedRun",
    "RunConfig",
    "StepReport",
    "TrainOptions",
    "TrainSettings",
    "Trainer",
    "Watch",
    "build_trainer",
    "configure",
    "execute",
    "load_preset",
    "load_run",
    "open_scene",
    "output_folder",
    "preset_names",
    "regularizers_of",
    "resume_trainer",
    "save_ensemble",
    "save_run",
]
