"""The training loop and what it leaves behind: checkpoints, metrics, renders, curves."""

from gridreg.training.ensemble import save_ensemble as save_ensemble
from gridreg.training.execute import Execution as Execution
from gridreg.training.execute import Watch as Watch
from gridreg.training.execute import execute as execute
from gridreg.training.loading import LoadedRun as LoadedRun
from gridreg.training.loading import load_run as load_run
from gridreg.training.options import TrainOptions as TrainOptions
from gridreg.training.options import configure as configure
from gridreg.training.options import output_folder as output_folder
from gridreg.training.presets import load_preset as load_preset
from gridreg.training.presets import preset_names as preset_names
from gridreg.training.run import build_trainer as build_trainer
from gridreg.training.run import open_scene as open_scene
from gridreg.training.run import regularizers_of as regularizers_of
from gridreg.training.run import resume_trainer as resume_trainer
from gridreg.training.run import save_run as save_run
from gridreg.training.settings import RunConfig as RunConfig
from gridreg.training.settings import TrainSettings as TrainSettings
from gridreg.training.trainer import StepReport as StepReport
from gridreg.training.trainer import Trainer as Trainer
