"""DistributedDataParallel: two processes on halves of a batch give the gradients of one on the whole."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg.testing._subjects import points
from tests.fields import made

STEPS = (0, 4, 9)
COMPOSITION = (
    gridreg.FrequencyMask(gridreg.parameters("density_line.*", dim=1), until=10),
    gridreg.ComponentDropout(gridreg.parameters("app_line.*", dim=1), p=0.4),
    gridreg.FrequencyMask(gridreg.inputs("mlp.0", octaves=[-1] * 9 + [0, 1] * 18), until=8),
)


def loss_of(field: nn.Module, x: Tensor, d: Tensor) -> Tensor:
    density, colour = field(x, d)
    return density.square().mean() + colour.square().mean()


def gradients(field: nn.Module, model: nn.Module, handle: gridreg.Handle, part: slice) -> list[list[Tensor]]:
    """Gradients of all parameters at each step, on a part of the batch."""
    x, d = points(24)
    found = []
    for step in STEPS:
        handle.step(step)
        model.zero_grad()
        loss_of(model, x[part], d[part]).backward()
        found.append(
            [p.grad.clone() if p.grad is not None else torch.zeros_like(p) for p in field.parameters()]
        )
    return found


def work(rank: int, meeting: str, queue: Any) -> None:
    """One of two processes."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
    field = made("tensorf")
    handle = gridreg.apply(field, *COMPOSITION, total_steps=10, seed=7)
    model = nn.parallel.DistributedDataParallel(field)
    found = gradients(field, model, handle, slice(12 * rank, 12 * rank + 12))
    names = [name for name, _ in field.named_parameters()]
    if rank == 0:
        queue.put((names, [[gradient.tolist() for gradient in step] for step in found]))
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()


@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch was built without distributed")
def test_two_processes_have_the_gradients_of_one(tmp_path: Path) -> None:
    field = made("tensorf")
    names = [name for name, _ in field.named_parameters()]
    with gridreg.apply(field, *COMPOSITION, total_steps=10, seed=7) as handle:
        expected = gradients(field, field, handle, slice(None))
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    workers = [
        context.Process(target=work, args=(rank, str(tmp_path / "meeting"), queue)) for rank in range(2)
    ]
    for worker in workers:
        worker.start()
    try:
        found_names, found = queue.get(timeout=300)
    finally:
        for worker in workers:
            worker.join(60)
            if worker.is_alive():
                worker.terminate()
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert found_names == names
    for ours, theirs in zip(expected, found, strict=True):
        for gradient, other in zip(ours, theirs, strict=True):
            torch.testing.assert_close(torch.tensor(other), gradient, atol=1e-6, rtol=1e-4)
    closed = dict(zip(names, expected[0], strict=True))["density_line.0"][:, 3:]
    assert (closed == 0).all()


def test_declared_sites_are_found_through_the_wrapper() -> None:
    """Applying to the wrapped model finds the sites of the field inside."""

    class Declaring(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = nn.Linear(4, 4)

        def sites(self) -> dict[str, Any]:
            return {"inner": gridreg.outputs("inner")}

        def forward(self, x: Tensor) -> Tensor:
            return self.inner(x)  # type: ignore[no-any-return]

    class Wrapped(nn.Module):
        def __init__(self, module: nn.Module) -> None:
            super().__init__()
            self.module = module

        def forward(self, x: Tensor) -> Tensor:
            return self.module(x)  # type: ignore[no-any-return]

    wrapped = Wrapped(Declaring())
    with gridreg.apply(wrapped, gridreg.FixedMask("inner", visible_ratio=0.5), total_steps=10):
        assert (wrapped(torch.ones(4))[2:] == 0).all()
