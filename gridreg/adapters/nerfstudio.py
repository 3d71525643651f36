"""The method ``gridreg-tensorf`` for nerfstudio, and sites of its fields.

    ns-train gridreg-tensorf --data DIR blender-data

Importing this module registers adapters for `TensoRFField`, `NerfactoField` and `NeRFField`, so that compositions by
name attach to a field of nerfstudio's. Tested with nerfstudio 1.1.5.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.fields.nerfacto_field import NerfactoField
from nerfstudio.fields.tensorf_field import TensoRFField
from nerfstudio.fields.vanilla_nerf_field import NeRFField
from nerfstudio.models.tensorf import TensoRFModel, TensoRFModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification
from torch import Tensor, nn

import gridreg
from gridreg.attach.selectors import Selector
from gridreg.encodings import octaves_of_channels


def ray_samples(samples: Any, density: Tensor, directions: Tensor | None = None) -> gridreg.RaySamples:
    """nerfstudio's `RaySamples` of shape `(R, S)` with their densities `(R, S, 1)`, as penalties read them.

    `t` is the middle of a sample's interval, world units.
    """
    starts, ends = samples.frustums.starts.squeeze(-1), samples.frustums.ends.squeeze(-1)
    return gridreg.RaySamples.from_dense(
        (starts + ends) / 2, ends - starts, density.squeeze(-1), directions=directions
    )


def _octaves(encoding: Any, dimensions: int) -> tuple[int, ...]:
    """Octaves of a `NeRFEncoding`: coordinate by coordinate, the input itself at the end."""
    include: Any = "last" if encoding.include_input else False
    return octaves_of_channels(dimensions, encoding.num_frequencies, "coordinate", include)


def _encoded(pattern: str, encoding: Any, dimensions: int, start: int) -> Selector:
    """Channels of an input from ``start`` on that are a `NeRFEncoding`."""
    octaves = _octaves(encoding, dimensions)
    return gridreg.inputs(pattern, channels=slice(start, start + len(octaves)), octaves=octaves)


def _tensorf_sites(module: Any) -> dict[str, gridreg.Site]:
    """Few TensoRF's five sites; the position is no input of this decoder."""
    found = {}
    for name, owner in (("density", "density_encoding"), ("appearance", "color_encoding")):
        grids = {
            part: gridreg.parameters(f"{owner}.{part}_coef", dim=1, stack=0)
            for part in ("plane", "line")
            if hasattr(getattr(module, owner), f"{part}_coef")
        }
        mask = grids.get("line") or next(iter(grids.values()))
        found[name] = gridreg.Site((mask,), tuple(grids.values()))
        found |= {f"{name}.{part}s": gridreg.Site((grid,), (grid,)) for part, grid in grids.items()}
    features = module.B.out_features
    begin = features + 3
    found["encoding.features"] = gridreg.Site(
        (_encoded("mlp_head", module.feature_encoding, features, begin),)
    )
    begin += module.feature_encoding.get_out_dim()
    found["encoding.direction"] = gridreg.Site((_encoded("mlp_head", module.direction_encoding, 3, begin),))
    return found


def _nerfacto_sites(module: nn.Module) -> dict[str, gridreg.Site]:
    """Levels of the hash grid, coarse ones first, as `LevelMask` opens them."""
    names = [name for name, part in module.named_modules() if isinstance(part, HashEncoding)]
    return {"levels": gridreg.Site((gridreg.outputs(names[0], dim=-1),))} if names else {}


def _nerf_sites(module: Any) -> dict[str, gridreg.Site]:
    """FreeNeRF's two sites."""
    return {
        f"encoding.{name}": gridreg.Site(
            (gridreg.outputs(f"{name}_encoding", octaves=_octaves(getattr(module, f"{name}_encoding"), 3)),)
        )
        for name in ("position", "direction")
    }


gridreg.register_adapter(TensoRFField, _tensorf_sites)
gridreg.register_adapter(NerfactoField, _nerfacto_sites)
gridreg.register_adapter(NeRFField, _nerf_sites)


@dataclass
class GridregTensoRFConfig(TensoRFModelConfig):  # type: ignore[misc]
    """TensoRF with a composition of gridreg's attached."""

    _target: type = field(default_factory=lambda: GridregTensoRF)
    composition: str = "few_tensorf"
    """a composition by name; what has no site on this field is left out"""
    total_steps: int = 30_000
    """steps that schedules count; the length of the run"""


class GridregTensoRF(TensoRFModel):  # type: ignore[misc]
    """nerfstudio's TensoRF, unedited, with a handle: `step` before each iteration, the loss among its losses."""

    config: GridregTensoRFConfig

    def populate_modules(self) -> None:
        """Attach the composition, and keep masks out of the grids while they are upsampled."""
        super().populate_modules()
        composition = gridreg.composition(self.config.composition, missing="skip")
        self.handle = gridreg.apply(self.field, *composition, total_steps=self.config.total_steps)
        if self.config.composition != "none":
            self.handle.suspends("density_encoding.upsample_grid")
            self.handle.suspends("color_encoding.upsample_grid")
        self._last: tuple[Any, Tensor] | None = None
        self.field.register_forward_hook(self._keep, with_kwargs=True)

    def _keep(self, module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], found: Any) -> None:
        self._last = (args[0] if args else kwargs["ray_samples"], found[FieldHeadNames.DENSITY])

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[TrainingCallback]:
        """nerfstudio's own, after one that tells the handle the step."""
        step = TrainingCallback(
            where_to_run=[TrainingCallbackLocation.BEFORE_TRAIN_ITERATION],
            update_every_num_iters=1,
            func=lambda step: self.handle.step(step),
        )
        return [step, *super().get_training_callbacks(training_callback_attributes)]

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Tensor]:
        """nerfstudio's losses and the composition's, by name."""
        losses: dict[str, Tensor] = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self._last is not None:
            losses["gridreg"] = self.handle.loss(ray_samples(*self._last))
        self._last = None
        return losses


def _group(rate: float) -> dict[str, Any]:
    decay = ExponentialDecaySchedulerConfig(lr_final=rate / 10, max_steps=30_000)
    return {"optimizer": AdamOptimizerConfig(lr=rate), "scheduler": decay}


gridreg_tensorf = MethodSpecification(
    config=TrainerConfig(
        method_name="gridreg-tensorf",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30_000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=ParallelDataManagerConfig(
                dataparser=BlenderDataParserConfig(),
                train_num_rays_per_batch=4096,
                eval_num_rays_per_batch=4096,
            ),
            model=GridregTensoRFConfig(
                regularization="none", camera_optimizer=CameraOptimizerConfig(mode="off")
            ),
        ),
        optimizers={
            "fields": _group(0.001),
            "encodings": _group(0.02),
            "camera_opt": _group(0.0001),
        },
    ),
    description="TensoRF with gridreg's regularizers for few views (masks, occlusion loss, total variation).",
)
"""What nerfstudio finds through the entry point ``nerfstudio.method_configs``."""
