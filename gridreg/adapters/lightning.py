"""A callback for Lightning that attaches regularizers to a module, or to a field in it, for training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

import gridreg
from gridreg.base import Regularizer
from gridreg.errors import InputError


class Regularization(Callback):  # type: ignore[misc]
    """Sets the step before each batch, adds the penalties to the loss, logs them, and is part of the checkpoint.

    `training_step` gives the samples of its rays under the key "samples", which may be left out where no penalty
    reads them. The handle stays after the fit, so that masks which are not open act when the module is tested;
    `callback.handle.remove()` takes everything off.

    Args:
        regularizers: as for `gridreg.apply`.
        field: dotted path of the field from the module; "": the module itself.
        total_steps: length of the run, optimizer steps; None: as Lightning estimates it.

    Attributes:
        handle: from the start of the fit on.
    """

    def __init__(self, *regularizers: Regularizer, field: str = "", total_steps: int | None = None) -> None:
        self.handle: gridreg.Handle | None = None
        self._regularizers, self._field, self._total_steps = regularizers, field, total_steps
        self._saved: Mapping[str, Any] | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Attach, and go on from a checkpoint that was loaded.

        Raises:
            InputError: of `gridreg.apply`, or the length of the run is not known.
        """
        if self.handle is None:
            total = trainer.estimated_stepping_batches if self._total_steps is None else self._total_steps
            if total in (-1, float("inf")):
                raise InputError(
                    "total_steps=None: the trainer has no end; say how many steps schedules count"
                )
            field = pl_module.get_submodule(self._field)
            self.handle = gridreg.apply(field, *self._regularizers, total_steps=int(total))
        if self._saved is not None:
            self.handle.load_state_dict(self._saved)
            self._saved = None
        vars(pl_module)["training_step"] = self._with_penalties(pl_module, pl_module.training_step)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give the module its own `training_step` back."""
        vars(pl_module).pop("training_step", None)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """The same after a fit that failed."""
        self.on_fit_end(trainer, pl_module)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Set the step: optimizer steps done."""
        assert self.handle is not None
        self.handle.step(trainer.global_step)

    def _with_penalties(self, module: LightningModule, step: Callable[..., Any]) -> Callable[..., Any]:
        """The module's `training_step` with the penalties in its loss."""

        def training_step(*arguments: Any, **keywords: Any) -> Any:
            found, handle = step(*arguments, **keywords), self.handle
            if found is None or handle is None:
                return found
            whole = dict(found) if isinstance(found, Mapping) else {"loss": found}
            whole["loss"] = whole["loss"] + handle.loss(whole.pop("samples", None))
            module.log_dict({f"gridreg/{name}": term for name, term in handle.terms.items()})
            return whole

        return training_step

    def state_dict(self) -> dict[str, Any]:
        """That of the handle, for Lightning's checkpoint."""
        return {} if self.handle is None else self.handle.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Keep it until the fit starts, when the handle is made."""
        self._saved = state_dict or None
