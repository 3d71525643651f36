"""The callback for Lightning, in Lightning's own trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import gridreg

lightning = pytest.importorskip("lightning.pytorch", reason="needs lightning")
from gridreg.adapters.lightning import Regularization  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]
GRID = gridreg.parameters("grid", dim=0)


class Field(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.ones(6, 2))


class Module(lightning.LightningModule):  # type: ignore[misc, name-defined]
    def __init__(self) -> None:
        super().__init__()
        self.field = Field()
        self.seen: list[float] = []

    def training_step(self, batch: Any, index: int) -> Any:
        self.seen.append(float(self.field.grid[5, 0] / dict(self.named_parameters())["field.grid"][5, 0]))
        density = self.field.grid.square().mean() * torch.ones(1, 2)
        samples = gridreg.RaySamples.from_dense(torch.arange(2.0), torch.ones(2), density)
        return {"loss": 0.0 * self.field.grid.sum(), "samples": samples}

    def configure_optimizers(self) -> Any:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(callback: Regularization, folder: Path, steps: int, resume: Path | None = None) -> tuple[Any, Any]:
    module = Module()
    trainer = lightning.Trainer(
        max_steps=steps,
        callbacks=[callback],
        default_root_dir=folder,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
        accelerator="cpu",
    )
    data = torch.utils.data.DataLoader(torch.zeros(6, 1), batch_size=1)
    trainer.fit(module, data, ckpt_path=resume)
    return module, trainer


def test_steps_losses_logs_and_checkpoints(tmp_path: Path) -> None:
    regularizers = (
        gridreg.FrequencyMask(GRID, until=3),
        gridreg.L1(GRID, weight=1.2),
        gridreg.OcclusionLoss(weight=0.5, samples=5),
    )
    callback = Regularization(*regularizers, field="field", total_steps=6)
    module, trainer = fit(callback, tmp_path, 3)
    assert module.seen == pytest.approx([float(gridreg.frequency_mask(6, s, 3)[5]) for s in range(3)])
    assert module.seen[0] == 0.0
    assert "training_step" not in vars(module)
    assert set(trainer.callback_metrics) == {"gridreg/L1(grid)", "gridreg/OcclusionLoss"}
    raw = dict(module.named_parameters())["field.grid"]
    assert bool((raw[0] < raw[5]).all())  # closed channels have the gradient of L1 alone
    trainer.save_checkpoint(tmp_path / "saved.ckpt")

    again = Regularization(*regularizers, field="field", total_steps=6)
    resumed, _ = fit(again, tmp_path, 5, tmp_path / "saved.ckpt")
    assert resumed.seen == [1.0, 1.0]
    assert again.handle is not None
    assert again.handle.current_step == 4
    again.handle.remove()
    assert type(resumed.field) is Field


def test_the_length_of_the_run_is_lightning_s(tmp_path: Path) -> None:
    callback = Regularization(gridreg.L1(GRID, weight=1.2), field="field")
    module, _ = fit(callback, tmp_path, 4)
    # The gradient of 1.2 mean(|g|) over 12 values is 0.1, the rate 0.1.
    torch.testing.assert_close(module.field.grid.detach(), torch.full((6, 2), 1 - 4 * 0.01))
    assert callback.handle is not None
    assert callback.handle.total_steps == 4
