"""Adam that touches memory once: local grid terms, update and clearing of gradients in one pass."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.base import LocalTerm
from gridreg.errors import InputError
from gridreg.ops.cpu.adam.layout import Layout, Moments, Terms, layout
from gridreg.ops.cpu.adam.update import Job, update, update_flat
from gridreg.ops.dispatch import takes_compiled

__all__ = ["FusedAdam"]

_KINDS = ("total_variation", "l1", "l2")


def _axes(term: LocalTerm) -> tuple[int, ...]:
    dim = term.parameter.dim()
    return tuple(sorted(axis % dim for axis in term.spatial)) if term.kind == "total_variation" else ()


def _pairs(shape: Sequence[int], axis: int) -> int:
    """Number of neighbour pairs along an axis."""
    return math.prod(shape) // shape[axis] * (shape[axis] - 1)


def _add_plainly(term: LocalTerm, gradient: Tensor) -> float:
    """Add the gradient of a term to ``gradient``; returns the term's value."""
    p = term.parameter.detach()
    if term.kind == "l1":
        gradient.add_(p.sign(), alpha=term.scale / p.numel())
        return term.scale * float(p.abs().double().mean())
    if term.kind == "l2":
        gradient.add_(p, alpha=2 * term.scale / p.numel())
        return term.scale * float(p.double().square().mean())
    value = 0.0
    for axis in _axes(term):
        n, pairs = p.shape[axis], _pairs(p.shape, axis)
        if pairs:
            difference = p.diff(dim=axis)
            factor = 2 * term.scale / pairs
            gradient.narrow(axis, 0, n - 1).sub_(difference, alpha=factor)
            gradient.narrow(axis, 1, n - 1).add_(difference, alpha=factor)
            value += float(difference.double().square().sum()) / pairs
    return term.scale * value


def _step_plainly(p: Tensor, g: Tensor, m: Tensor, v: Tensor, s: Moments) -> None:
    if s.keep != 1:
        p.mul_(s.keep)
    m.lerp_(g, s.rest1)
    v.mul_(s.beta2).addcmul_(g, g, value=s.rest2)
    p.addcdiv_(m, v.sqrt().mul_(s.root).add_(s.eps), value=-s.rate)


class _Form(NamedTuple):
    """How the kernel sees a parameter and its terms.

    Args:
        shape: of the tensors.
        apart: places of terms that it cannot take.
        members: by place, the columns of the kernel's sums that make the value of a term.
        counts: by column, what the sum is divided by.
    """

    shape: Layout
    apart: tuple[int, ...]
    members: dict[int, tuple[int, ...]]
    counts: tuple[float, ...]


@functools.lru_cache(maxsize=256)
def _form(shape: tuple[int, ...], terms: tuple[tuple[str, tuple[int, ...]], ...]) -> _Form:
    """Of a parameter's shape, and kinds and axes of its terms."""
    axes: tuple[int, ...] = next((axes for _, axes in terms if axes and layout(shape, axes)), ())
    found = layout(shape, axes)
    assert found is not None
    # Of slabs, rows and nodes, in the order of `axes`: two axes have no rows, one has slabs alone.
    columns = {0: (), 1: (0,), 2: (0, 2), 3: (0, 1, 2)}[len(axes)]
    counts = [1.0] * 3 + [float(math.prod(shape))] * 2
    for column, axis in zip(columns, axes, strict=True):
        counts[column] = max(1, _pairs(shape, axis))
    by_kind = {"total_variation": columns, "l1": (3,), "l2": (4,)}
    apart = tuple(i for i, (kind, own) in enumerate(terms) if kind == "total_variation" and own != axes)
    members = {i: by_kind[kind] for i, (kind, _) in enumerate(terms) if i not in apart}
    return _Form(found, apart, members, tuple(counts))


class _Plan(NamedTuple):
    """A step of the kernel.

    Args:
        job: what it does.
        form: of its parameter and terms.
        terms: whose values are wanted.
        values: of each term, as far as they are known.
    """

    job: Job
    form: _Form
    terms: Sequence[LocalTerm]
    values: list[float]

    def finish(self, sums: Sequence[float]) -> list[float]:
        """Values of the terms, from the kernel's sums."""
        for place, own in self.form.members.items():
            mean = sum(sums[column] / self.form.counts[column] for column in own)
            self.values[place] = self.terms[place].scale * mean
        return self.values


def _plan(
    p: Tensor, g: Tensor, m: Tensor, v: Tensor, s: Moments, decay: float, terms: Sequence[LocalTerm]
) -> _Plan:
    """One step of the kernel; odd terms are added to the gradient at once."""
    form = _form(tuple(p.shape), tuple((term.kind, _axes(term)) for term in terms))
    factors = [0.0] * 4 + [decay]
    values = [0.0] * len(terms)
    for place in form.apart:
        values[place] = _add_plainly(terms[place], g)
    for place, columns in form.members.items():
        term = terms[place]
        for column in columns:
            factors[column] += term.scale * (1 if term.kind == "l1" else 2) / form.counts[column]
    return _Plan(Job(p, g, m, v, s, Terms(*factors)), form, terms, values)


class FusedAdam(torch.optim.Optimizer):
    """`torch.optim.Adam` (Kingma and Ba 2015) in one pass over memory, with grid penalties folded in.

    For contiguous float32 CPU parameters a compiled kernel reads parameter, gradient and both moments once,
    adds the gradients of total variation, L1 and L2 terms, writes back, and sets the gradient to 0. Gradient
    buffers stay, so that a backward pass can add to them: do not call ``zero_grad``. All other parameters
    take a plain path with the same results.

    A parameter without a gradient is left alone until its first one; from then on no gradient counts as 0.

    Args:
        params: parameters, or groups of them.
        lr: learning rate.
        betas: decay rates of the moments.
        eps: added to the root of the second moment.
        weight_decay: per step, times ``lr`` if decoupled.
        decoupled_weight_decay: True: shrink parameters (AdamW, Loshchilov and Hutter 2019); False: add to the
        gradient.

    Raises:
        InputError: for a setting out of range.

    Example:
        >>> grid = torch.nn.Parameter(torch.tensor([[0.0], [1.0]]))
        >>> optimizer = FusedAdam([grid], lr=0.1)
        >>> optimizer.step(local_terms=[LocalTerm("total_variation", 0.5, grid, (0,), "smooth")])
        {'smooth': 0.5}
        >>> [round(x, 3) for x in grid.flatten().tolist()]
        [0.1, 0.9]
    """

    accepts_local_terms = True
    zeroes_gradients = True

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        *,
        decoupled_weight_decay: bool = True,
    ) -> None:
        for name, value, high in (
            ("lr", lr, math.inf),
            ("betas[0]", betas[0], 1.0),
            ("betas[1]", betas[1], 1.0),
            ("eps", eps, math.inf),
            ("weight_decay", weight_decay, math.inf),
        ):
            if not 0 <= value < high:
                raise InputError(f"{name}: found {value}, expected a number in [0, {high})")
        defaults = {
            "lr": lr,
            "betas": betas,
            "eps": eps,
            "weight_decay": weight_decay,
            "decoupled_weight_decay": decoupled_weight_decay,
        }
        super().__init__(params, defaults)

    @torch.no_grad()
    def step(  # type: ignore[override]
        self, closure: None = None, *, local_terms: Sequence[LocalTerm] = ()
    ) -> dict[str, float]:
        """Update all parameters and set their gradients to 0.

        Args:
            closure: not supported.
            local_terms: penalties whose gradients are added; see `gridreg.base.LocalTerm`.

        Returns:
            The values of the terms before the update, by name.

        Raises:
            InputError: for a closure, or a term of an unknown kind or of a parameter that is not here.
        """
        if closure is not None:
            raise InputError("closure: found a function, expected None; compute gradients before the step")
        held = {id(p) for group in self.param_groups for p in group["params"]}
        by_parameter: defaultdict[int, list[LocalTerm]] = defaultdict(list)
        values = {term.name: 0.0 for term in local_terms}
        for term in local_terms:
            if term.kind not in _KINDS:
                raise InputError(
                    f"{term.name or 'term'}: found kind {term.kind!r}, expected one of {', '.join(_KINDS)}"
                )
            if id(term.parameter) not in held:
                shape = tuple(term.parameter.shape)
                raise InputError(
                    f"{term.name or 'term'}: found a parameter {shape} that the optimizer does not hold"
                )
            by_parameter[id(term.parameter)].append(term)
        flat: list[_Plan] = []
        grids: list[_Plan] = []
        found: list[tuple[Sequence[LocalTerm], list[float]]] = []
        for group in self.param_groups:
            for p in group["params"]:
                terms = by_parameter.get(id(p), [])
                step = self._step_one(p, group, terms)
                if isinstance(step, list):
                    found.append((terms, step))
                else:
                    (flat if step.job.flat else grids).append(step)
        # Together, as most parameters are small.
        sums = update([plan.job for plan in grids], [plan.form.shape for plan in grids])
        sums += update_flat([plan.job for plan in flat])
        found += [(plan.terms, plan.finish(some)) for plan, some in zip(grids + flat, sums, strict=True)]
        for those, numbers in found:
            for term, value in zip(those, numbers, strict=True):
                values[term.name] += value
        return values

    def _step_one(self, p: Tensor, group: dict[str, Any], terms: Sequence[LocalTerm]) -> list[float] | _Plan:
        """Values of the terms, or what is still to be done by the kernel."""
        if p.grad is None:
            if not terms and p not in self.state:
                return []
            p.grad = torch.zeros_like(p)
        state = self.state[p]
        if not state:
            # Names and types as of torch.optim.Adam.
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(p), torch.zeros_like(p)
        state["step"] += 1
        steps, (beta1, beta2), rate = int(state["step"]), group["betas"], float(group["lr"])
        decay, decoupled = float(group["weight_decay"]), group["decoupled_weight_decay"]
        moments = Moments(
            rest1=1 - beta1,
            beta2=beta2,
            rest2=1 - beta2,
            rate=rate / (1 - beta1**steps),
            root=1 / math.sqrt(1 - beta2**steps),
            eps=group["eps"],
            keep=1 - rate * decay if decoupled else 1.0,
        )
        coupled = 0.0 if decoupled else decay
        tensors = (p, p.grad, state["exp_avg"], state["exp_avg_sq"])
        if takes_compiled(*tensors) and all(x.is_contiguous() for x in tensors) and p.numel():
            return _plan(*tensors, moments, coupled, terms)
        values = [_add_plainly(term, p.grad) for term in terms]
        if coupled:
            p.grad.add_(p, alpha=coupled)
        _step_plainly(*tensors, moments)
        p.grad.zero_()
        return values
