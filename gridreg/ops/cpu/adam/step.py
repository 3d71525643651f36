"""The compiled `gridreg.ops.adam_step`: many parameters in one launch, as most of them are small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gridreg.ops.cpu.adam.kernels import Factors, flat_step, grid_step, keep_edges
from gridreg.ops.cpu.adam.layout import Form, flat_tasks, form_of, grid_tasks
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.workspace import workspace
from gridreg.ops.dispatch import is_cpu_float32
from gridreg.ops.fused_adam import AdamStep, adam_step, add_term, axes_of

# Blocks of slabs that may be updated at the same time; fixed, so that sums do not depend on threads.
_BLOCKS = 16


class _Plan(NamedTuple):
    """A step as the kernels see it: its form, factors of gradients, and the values of terms known so far."""

    step: AdamStep
    form: Form
    factors: Factors
    values: list[float]

    @property
    def looks_at_neighbours(self) -> bool:
        return bool(self.factors.slabs or self.factors.nodes)

    @property
    def tensors(self) -> list[Tensor]:
        """p, g, m and v as vectors."""
        return [x.detach().view(-1) for x in self.step[:4]]

    def finish(self, sums: Sequence[float]) -> None:
        """Set the values of the terms, from the kernels' sums."""
        for number, columns in self.form.columns.items():
            mean = sum(sums[column] / self.form.counts[column] for column in columns)
            self.values[number] = self.step.terms[number].scale * mean


def _plan(step: AdamStep) -> _Plan:
    """Plan a step; terms that the kernels cannot take are added to the gradient at once."""
    form = form_of(tuple(step.p.shape), tuple((term.kind, axes_of(term)) for term in step.terms))
    factors, values = [0.0, 0.0, 0.0, step.decay], [0.0] * len(step.terms)
    for number in form.apart:
        values[number] = add_term(step.terms[number], step.g)
    for number, columns in form.columns.items():
        term = step.terms[number]
        for column in columns:
            factors[column] += term.scale * (1 if term.kind == "l1" else 2) / form.counts[column]
    return _Plan(step, form, Factors(*factors), values)


def _numbers(plans: Sequence[_Plan]) -> Tensor:
    return torch.tensor([(*plan.step.moments, *plan.factors) for plan in plans], dtype=torch.float32)


def _finish(plans: Sequence[_Plan], sums: Tensor, starts: tuple[int, ...]) -> None:
    """Give each plan the sums of its tasks."""
    for plan, some in zip(plans, np.add.reduceat(sums.numpy(), starts, axis=0).tolist(), strict=True):
        plan.finish(some)


def update_flat(plans: Sequence[_Plan]) -> None:
    """Step parameters none of which has a term that looks at neighbours."""
    if not plans:
        return
    parts, starts = flat_tasks(tuple(plan.step.p.numel() for plan in plans))
    tensors = [tensor for plan in plans for tensor in plan.tensors]
    sums = torch.zeros(len(parts), 4, dtype=torch.float64)
    launch(flat_step, len(sums), _numbers(plans), parts, sums, *tensors)
    _finish(plans, sums, starts)


def update_grids(plans: Sequence[_Plan]) -> None:
    """Step parameters each of which has a term that looks at neighbours."""
    if not plans:
        return
    tasks = grid_tasks(tuple(plan.form.layout for plan in plans), _BLOCKS)
    tensors = [plan.tensors for plan in plans]
    before, after = workspace("adam edges", 2, tasks.held)
    launch(keep_edges, len(tasks.edges), tasks.edges, before, after, *(p for p, _, _, _ in tensors))
    sums = torch.zeros(len(tasks.parts), 4, dtype=torch.float64)
    flat = [tensor for four in tensors for tensor in four]
    launch(grid_step, len(sums), _numbers(plans), tasks.shapes, tasks.parts, sums, before, after, *flat)
    _finish(plans, sums, tasks.starts)


def _takes(step: AdamStep) -> bool:
    return is_cpu_float32(step[:4]) and all(x.is_contiguous() for x in step[:4]) and step.p.numel() > 0


@adam_step.register_cpu(suits=lambda steps: True)
def _adam_step(steps: Sequence[AdamStep]) -> list[list[float]]:
    plans = [_plan(step) if _takes(step) else None for step in steps]
    planned = [plan for plan in plans if plan is not None]
    update_grids([plan for plan in planned if plan.looks_at_neighbours])
    update_flat([plan for plan in planned if not plan.looks_at_neighbours])
    return [
        adam_step.reference([step])[0] if plan is None else plan.values
        for step, plan in zip(steps, plans, strict=True)
    ]
