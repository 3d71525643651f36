"""The method ``gridreg`` and the few-view data sets ``gridreg-fewview`` for nerfbaselines.

    nerfbaselines train --method gridreg --data DIR --backend python

A folder is read under a few-view protocol where its
``nb-info.json`` says ``{"loader": "gridreg-fewview", "loader_kwargs": {"protocol": "dietnerf8"}}``; downloading
``external://gridreg-fewview/lego-dietnerf8`` writes such a folder. Tested with nerfbaselines 1.2.12.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Camera, Lens
from gridreg.scenes import Scene, Views, load_scene
from gridreg.scenes.extent import blender_extent, points_extent
from gridreg.scenes.views import background_colour
from gridreg.training import TrainOptions, configure, load_run
from gridreg.training.files import check_output_folder, write_bytes
from gridreg.training.run import build_trainer, resume_trainer, save_run

PRESET = "best"
# nerfbaselines' cameras look along +z with y down (OpenCV), ours along -z with y up.
_FLIP = np.array([1.0, -1.0, -1.0, 1.0])


def _poses(cameras: Any) -> np.ndarray[Any, Any]:
    """Camera-to-world matrices `(V, 4, 4)` in our convention."""
    poses = np.tile(np.eye(4), (len(cameras.poses), 1, 1))
    poses[:, :3] = cameras.poses
    return np.asarray(poses * _FLIP)


def _views(dataset: Any) -> Views:
    """The images of a data set, of one size, as `Views`; a mask is the alpha of images without one."""
    sizes = {tuple(size) for size in np.asarray(dataset["cameras"].image_sizes).tolist()}
    if len(sizes) != 1:
        raise InputError(f"images: found sizes {sorted(sizes)}, expected one size")
    kinds = set(np.asarray(dataset["cameras"].camera_models).tolist())
    if kinds != {0}:
        raise InputError(f"cameras: found models {sorted(kinds)}, expected pinhole cameras (0) alone")
    images = torch.from_numpy(np.stack([np.asarray(image) for image in dataset["images"]])).float() / 255
    if images.shape[-1] == 3:
        masks = dataset.get("masks")
        alpha = torch.ones(*images.shape[:3], 1) if masks is None else _alpha(masks)
        images = torch.cat([images, alpha], dim=-1)
    names = tuple(f"{i:04d}" for i in range(len(images)))
    intrinsics = torch.as_tensor(np.asarray(dataset["cameras"].intrinsics), dtype=torch.float32)
    poses = torch.as_tensor(_poses(dataset["cameras"]), dtype=torch.float32)
    return Views(images, poses, intrinsics, names, tuple(range(len(images))))


def _alpha(masks: Sequence[Any]) -> Tensor:
    return torch.from_numpy(np.stack([np.asarray(mask) > 0 for mask in masks]).astype(np.float32))[..., None]


def scene_of(dataset: Any) -> Scene:
    """A data set of nerfbaselines' as a scene; the box follows from its points, or from its cameras."""
    views, points = _views(dataset), dataset.get("points3D_xyz")
    poses, intrinsics = views.poses.double().numpy(), views.intrinsics.double().numpy()
    if points is None:
        extent = blender_extent(poses, intrinsics, (views.width, views.height))
    else:
        extent = points_extent(poses, np.asarray(points, dtype=np.float64))
    colour = dataset["metadata"].get("background_color")
    background = views.backdrop if colour is None else torch.as_tensor(np.asarray(colour) / 255.0)
    seen = [views.rgba.numpy().tobytes(), views.poses.numpy().tobytes(), views.intrinsics.numpy().tobytes()]
    return Scene(
        name=str(dataset["metadata"].get("scene", "nerfbaselines")),
        protocol=str(dataset["metadata"].get("id", "nerfbaselines")),
        train=views,
        test=views,
        near=extent.near,
        far=extent.far,
        bounds=torch.as_tensor(extent.bounds, dtype=torch.float32),
        background=background_colour("white" if background is None else background.float()),
        fingerprint=hashlib.sha256(b"".join(seen)).hexdigest(),
    )


class GridregMethod:
    """A run of gridreg's as nerfbaselines sees a method.

    Args:
        checkpoint: folder that `save` wrote.
        train_dataset: to train on; with a checkpoint, training goes on where it stopped.
        config_overrides: ``preset`` (default "best") and keys of the configuration, such as ``train.steps``.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Any = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        changes = dict(config_overrides or {})
        preset = str(changes.pop("preset", PRESET))
        self._checkpoint = None if checkpoint is None else Path(checkpoint)
        self._trainer, self._model, self._loaded_step = None, None, None
        config = configure(TrainOptions(preset=preset, set=tuple(f"{k}={v}" for k, v in changes.items())))
        if self._checkpoint is not None:
            self._model = load_run(self._checkpoint)
            config, self._loaded_step = self._model.config, self._model.step
        self._config = config
        if train_dataset is not None:
            scene = scene_of(train_dataset)
            if self._checkpoint is None:
                self._trainer = build_trainer(config, scene)
            else:
                self._trainer, _ = resume_trainer(self._checkpoint, config, scene)

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Facts that nerfbaselines needs before it reads a data set."""
        return {
            "method_id": "gridreg",
            "required_features": frozenset(("points3D_xyz",)),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", "accumulation", "depth"),
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """The method's facts and those of this run."""
        return {
            **self.get_method_info(),
            "num_iterations": self._config.train.steps,
            "loaded_step": self._loaded_step,
            "loaded_checkpoint": None if self._checkpoint is None else str(self._checkpoint),
            "batch_size": self._config.train.rays,
            "hparams": {"preset": self._config.preset},
        }

    def get_train_embedding(self, index: int) -> None:
        """There are none."""

    def train_iteration(self, step: int) -> dict[str, float]:
        """Train one iteration, and return its figures."""
        if self._trainer is None:
            raise InputError("train_dataset: found None, expected one for a method that is to be trained")
        return dict(self._trainer.train_step())

    def render(self, camera: Any, *, options: Any = None) -> dict[str, Any]:
        """Render one camera; depth is the distance along the ray, world units."""
        camera = camera.item()
        width, height = (int(edge) for edge in camera.image_sizes)
        pose = torch.as_tensor(_poses(camera[None])[0], dtype=torch.float32)
        lens = Lens.from_tensor(torch.as_tensor(np.asarray(camera.intrinsics)), height, width)
        model = self._model if self._trainer is None else self._trainer.model
        assert model is not None
        found = model.render(Camera(pose, lens))
        assert found is not None
        return {
            "color": found.colour.numpy(),
            "accumulation": found.opacity.numpy(),
            "depth": found.depth.numpy(),
        }

    def save(self, path: str) -> None:
        """Write a checkpoint; of a method that was only loaded, the same bytes again."""
        if self._trainer is not None:
            save_run(Path(path), self._trainer, self._config, {})
        elif self._checkpoint is not None:
            shutil.copytree(self._checkpoint, path, dirs_exist_ok=True)


def load_few_views(path: str, split: str, *, protocol: str = "dietnerf8", **_: Any) -> Any:
    """Read a scene folder under a few-view protocol, at the protocol's size.

    nerfbaselines opens images itself, so reduced ones are written beside the scene, in ``few-views-PROTOCOL``.

    Args:
        path: any scene folder that gridreg reads.
        split: "train" or "test".
        protocol: by name, see `gridreg.scenes.get_protocol`.
    """
    from nerfbaselines import camera_model_to_int, new_cameras, new_dataset

    scene = load_scene(path, protocol, test=None if split == "test" else ())
    views: Views = getattr(scene, split)
    count = len(views)
    folder = Path(path) / f"few-views-{protocol}"
    paths = [folder / split / f"{name}.png" for name in views.names]
    for file, rgba in zip(paths, views.rgba, strict=True):
        if not file.exists():
            check_output_folder(file.parent)
            pixels = (255 * rgba).round().byte().numpy()
            write_bytes(file, imageio.imwrite("<bytes>", pixels, extension=".png"))
    colour = (255 * scene.background).round().byte().numpy()
    return new_dataset(
        cameras=new_cameras(
            poses=(views.poses.numpy() * _FLIP)[:, :3].astype(np.float32),
            intrinsics=views.intrinsics.numpy(),
            camera_models=np.full(count, camera_model_to_int("pinhole"), dtype=np.int32),
            distortion_parameters=np.zeros((count, 0), dtype=np.float32),
            image_sizes=np.array([[views.width, views.height]] * count, dtype=np.int32),
            nears_fars=np.array([[scene.near, scene.far]] * count, dtype=np.float32),
        ),
        image_paths=[str(path) for path in paths],
        image_paths_root=str(folder),
        metadata={
            "color_space": "srgb",
            "type": "object-centric",
            "evaluation_protocol": "nerf",
            "expected_scene_scale": float(scene.far - scene.near),
            "depth_range": [scene.near, scene.far],
            "background_color": colour,
        },
    )


def download_few_views(path: str, output: str) -> None:
    """Fetch a scene of nerf_synthetic as nerfbaselines does, and say which views count.

    Args:
        path: ``gridreg-fewview/SCENE-PROTOCOL``, such as ``gridreg-fewview/lego-dietnerf8``.
        output: folder to write.
    """
    from nerfbaselines.datasets.blender import download_blender_dataset

    scene, dash, protocol = path.rpartition("/")[2].partition("-")
    if not dash:
        raise InputError(f"{path}: expected gridreg-fewview/SCENE-PROTOCOL, such as lego-dietnerf8")
    download_blender_dataset(f"blender/{scene}", output)
    info = {
        "loader": "gridreg-fewview",
        "loader_kwargs": {"protocol": protocol},
        "evaluation_protocol": "nerf",
    }
    info |= {"id": "gridreg-fewview", "scene": f"{scene}-{protocol}", "type": "object-centric"}
    (Path(output) / "nb-info.json").write_text(json.dumps(info), encoding="utf-8")
