"""A TensoRF checkout of somebody's, on the same rays in the same process."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.rendering import Rays
from gridreg.training import Trainer

from .common import existing_folder
from .situations import require_grid

_FILE, _CLASS = "models/tensoRF.py", "TensorVMSplit"


def load_class(folder: Path) -> tuple[Any, Any]:
    """The class and the module it is in.

    Raises:
        InputError: if the folder does not hold them, or they cannot be imported.
    """
    existing_folder(folder, "--peer")
    if not (folder / _FILE).is_file():
        raise InputError(f"--peer {folder}: found no {_FILE}; expected a checkout of TensoRF")
    with _first_on_path(folder.resolve()):
        try:
            module = importlib.import_module("models.tensoRF")
        except Exception as error:
            raise InputError(f"--peer {folder}: {_FILE} cannot be imported: {_one_line(error)}") from error
    if not hasattr(module, _CLASS):
        raise InputError(f"--peer {folder}: {_FILE} has no class {_CLASS}; expected a checkout of TensoRF")
    return getattr(module, _CLASS), module


@contextmanager
def _first_on_path(folder: Path) -> Iterator[None]:
    """Its own ``models``, and no compiled files left in a folder that is not ours."""

    def forget() -> None:
        for name in [n for n in sys.modules if n == "models" or n.startswith("models.")]:
            del sys.modules[name]

    kept, path = sys.dont_write_bytecode, sys.path[:]
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(folder))
    forget()
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.dont_write_bytecode, sys.path[:] = kept, path
        forget()


def _one_line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__


class Peer:
    """A peer's field with the size, box and grids of ours, and its own way to render and to learn.

    Its step is that of its own program: colours, squared error, its L1 penalty on densities, backward pass, Adam. What
    its class does not offer is left out, and said in `facts`. Like ours it is held still.

    Args:
        folder: the checkout.
        trainer: of our field.
        occupancy: give it our occupied cells, as its ``alphaMask``.

    Raises:
        InputError: if it cannot be built.
    """

    def __init__(self, folder: Path, trainer: Trainer, *, occupancy: bool) -> None:
        require_grid(trainer, "--peer")
        self.folder = folder
        cls, module = load_class(folder)
        field, scene = trainer.field, trainer.scene
        with self._readable("be built"):
            self.model = cls(
                field.bounds.clone(),
                list(field.resolution),
                torch.device("cpu"),
                density_n_comp=[field.density_planes[0].shape[-1]] * 3,
                appearance_n_comp=[field.appearance_planes[0].shape[-1]] * 3,
                app_dim=27,
                near_far=[scene.near, scene.far],
                shadingMode="MLP_Fea",
                density_shift=field.density_shift,
                distance_scale=field.distance_scale,
                pos_pe=6,
                view_pe=2,
                fea_pe=2,
                featureC=128,
                step_ratio=trainer.settings.step_ratio,
                fea2denseAct="softplus",
            )
            groups = getattr(self.model, "get_optparam_groups", self.model.parameters)()
            self.optimizer = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99))
        for group in self.optimizer.param_groups:
            group["lr"] = 0.0
        with trainer.handle.suspended():
            same = self._copy_grids(field)
        mask = getattr(module, "AlphaGridMask", None)
        if occupancy and mask is not None:
            volume = trainer.occupancy.cells.permute(2, 1, 0).float().contiguous()
            self.model.alphaMask = mask(torch.device("cpu"), trainer.occupancy.bounds.clone(), volume)
        self.facts = {
            "same_grids": same,
            "occupancy": bool(occupancy and mask is not None),
            "l1": hasattr(self.model, "density_L1"),
        }

    @contextmanager
    def _readable(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise InputError(f"--peer {self.folder}: {_CLASS} cannot {what}: {_one_line(error)}") from error

    @torch.no_grad()
    def _copy_grids(self, field: Any) -> bool:
        """Our values in their order, channels first and axes swapped; False if its grids have other shapes."""
        pairs: list[tuple[Tensor, Tensor]] = []
        for ours, theirs in (("density", "density"), ("appearance", "app")):
            for k in range(3):
                plane, line = getattr(field, f"{ours}_planes")[k], getattr(field, f"{ours}_lines")[k]
                try:
                    to_plane = getattr(self.model, f"{theirs}_plane")[k]
                    to_line = getattr(self.model, f"{theirs}_line")[k]
                except (AttributeError, IndexError):
                    return False
                pairs.append((to_plane, plane.permute(2, 1, 0)[None]))
                pairs.append((to_line, line.T[None, :, :, None]))
        if any(to.shape != values.shape for to, values in pairs):
            return False
        for to, values in pairs:
            to.copy_(values)
        return True

    def step(self, rays: Rays, target: Tensor) -> None:
        """One iteration.

        Raises:
            InputError: if it fails.
        """
        with self._readable("do a step"):
            packed = torch.cat([rays.origins, rays.directions], dim=1)
            colour = self.model(packed, is_train=True, white_bg=True, N_samples=-1)[0]
            loss = (colour - target).square().mean()
            if self.facts["l1"]:
                loss = loss + 4e-5 * self.model.density_L1()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
