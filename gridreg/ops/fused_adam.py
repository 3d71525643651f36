"""Adam that touches memory once: local grid terms, update and clearing of gradients in one pass."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops.dispatch import operation

if TYPE_CHECKING:
    from gridreg.base import LocalTerm

_KINDS = ("total_variation", "l1", "l2")


class Moments(NamedTuple):
    """Constants of one Adam step (Kingma and Ba 2015, algorithm 1).

    ``rest1`` and ``rest2`` are ``1 - beta1`` and ``1 - beta2``; ``rate`` is the learning rate over ``1 -
    beta1^t``, ``root`` is ``1 / sqrt(1 - beta2^t)``; parameters are multiplied by ``keep`` first (decoupled
    weight decay).
    """

    rest1: float
    beta2: float
    rest2: float
    rate: float
    root: float
    eps: float
    keep: float


class AdamStep(NamedTuple):
    """One parameter's step.

    Args:
        p, g, m, v: parameter, gradient and both moments, of one size.
        moments: constants.
        decay: weight decay that is added to the gradient.
        terms: penalties whose gradients are added.
    """

    p: Tensor
    g: Tensor
    m: Tensor
    v: Tensor
    moments: Moments
    decay: float
    terms: Sequence[LocalTerm]


def axes_of(term: LocalTerm) -> tuple[int, ...]:
    """Axes along which a term compares neighbours, counted from the front."""
    dim = term.parameter.dim()
    return tuple(sorted(axis % dim for axis in term.spatial)) if term.kind == "total_variation" else ()


def neighbour_pairs(shape: Sequence[int], axis: int) -> int:
    """Number of neighbour pairs along an axis."""
    return math.prod(shape) // shape[axis] * (shape[axis] - 1)


def add_term(term: LocalTerm, gradient: Tensor) -> float:
    """Add the gradient of a term to ``gradient``; returns the term's value."""
    p = term.parameter.detach()
    if term.kind == "l1":
        gradient.add_(p.sign(), alpha=term.scale / p.numel())
        return term.scale * float(p.abs().double().mean())
    if term.kind == "l2":
        gradient.add_(p, alpha=2 * term.scale / p.numel())
        return term.scale * float(p.double().square().mean())
    value = 0.0
    for axis in axes_of(term):
        n, pairs = p.shape[axis], neighbour_pairs(p.shape, axis)
        if pairs:
            difference = p.diff(dim=axis)
            factor = 2 * term.scale / pairs
            gradient.narrow(axis, 0, n - 1).sub_(difference, alpha=factor)
            gradient.narrow(axis, 1, n - 1).add_(difference, alpha=factor)
            value += float(difference.double().square().sum()) / pairs
    return term.scale * value


@operation()
def adam_step(steps: Sequence[AdamStep]) -> list[list[float]]:
    """Add the gradients of penalties, make the Adam steps in place, and set the gradients to 0.

    Returns:
        For each parameter the values of its terms before the step.
    """
    values = []
    for p, g, m, v, s, decay, terms in steps:
        values.append([add_term(term, g) for term in terms])
        if decay:
            g.add_(p, alpha=decay)
        if s.keep != 1:
            p.mul_(s.keep)
        m.lerp_(g, s.rest1)
        v.mul_(s.beta2).addcmul_(g, g, value=s.rest2)
        p.addcdiv_(m, v.sqrt().mul_(s.root).add_(s.eps), value=-s.rate)
        g.zero_()
    return values


class FusedAdam(torch.optim.Optimizer):
    """`torch.optim.Adam` (Kingma and Ba 2015) in one pass over memory, with grid penalties folded in.

    For contiguous float32 CPU parameters a compiled kernel reads parameter, gradient and both moments once,
    adds the gradients of total variation (TensoRF's ``TVLoss``), L1 and L2 terms, writes back, and sets the
    gradient to 0. Gradient buffers stay, so that a backward pass can add to them: do not call ``zero_grad``.
    All other parameters take a plain path with the same results.

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
        >>> from gridreg.base import LocalTerm
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
        defaults = {"lr": lr, "betas": betas, "eps": eps, "weight_decay": weight_decay}
        super().__init__(params, {**defaults, "decoupled_weight_decay": decoupled_weight_decay})

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
        by_parameter = self._terms_by_parameter(local_terms)
        pairs = [(p, group) for group in self.param_groups for p in group["params"]]
        steps = [step for p, group in pairs if (step := self._step_of(p, group, by_parameter.get(id(p), [])))]
        values = {term.name: 0.0 for term in local_terms}
        for step, found in zip(steps, adam_step(steps), strict=True):
            for term, value in zip(step.terms, found, strict=True):
                values[term.name] += value
        return values

    def _terms_by_parameter(self, terms: Sequence[LocalTerm]) -> dict[int, list[LocalTerm]]:
        held = {id(p) for group in self.param_groups for p in group["params"]}
        by_parameter: defaultdict[int, list[LocalTerm]] = defaultdict(list)
        for term in terms:
            name = term.name or "term"
            if term.kind not in _KINDS:
                raise InputError(f"{name}: found kind {term.kind!r}, expected one of {', '.join(_KINDS)}")
            if id(term.parameter) not in held:
                shape = tuple(term.parameter.shape)
                raise InputError(f"{name}: found a parameter {shape} that the optimizer does not hold")
            by_parameter[id(term.parameter)].append(term)
        return by_parameter

    def _step_of(self, p: Tensor, group: dict[str, Any], terms: Sequence[LocalTerm]) -> AdamStep | None:
        """The step of a parameter; None for one that has never had a gradient."""
        if p.grad is None:
            if not terms and p not in self.state:
                return None
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
        return AdamStep(p, p.grad, state["exp_avg"], state["exp_avg_sq"], moments, coupled, terms)
