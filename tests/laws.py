"""The laws that every regularizer keeps, each as a function of a regularizer and a foreign field."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import torch
import yaml
from torch import Tensor, nn

import gridreg
from gridreg.attach._hooks import Slot, slots_of
from gridreg.attach._resolve import find
from gridreg.base import Clock, Context, Regularizer, overrides
from tests.fields import DESIGNS, made, points
from tests.observations import (
    STEPS,
    anatomy,
    contexts,
    examples_on,
    observed,
    same,
    samples_of,
    tensor_for,
)


def removal(regularizer: Regularizer, name: str) -> None:
    """`remove` leaves no trace: outputs, names, classes, dictionaries and hooks are what they were."""
    field = made(name)
    values, keys, before = field(*points()), list(field.state_dict()), anatomy(field)
    handle = gridreg.apply(field, regularizer, total_steps=STEPS)
    assert list(field.state_dict()) == keys
    assert all(value.is_leaf for _, value in field.named_parameters())
    handle.step(3)
    observed(field, handle)
    with handle.suspended():
        assert same(list(field(*points())), list(values))
        assert anatomy(field) == before
    handle.remove()
    assert anatomy(field) == before
    assert list(field.state_dict()) == keys
    assert same(list(field(*points())), list(values))


def idleness(regularizer: Regularizer, name: str) -> None:
    """What says that it is the identity leaves outputs bit-identical; a scheduled mask is it at its end."""
    field = made(name)
    bare = list(field(*points()))
    with gridreg.apply(field, regularizer, total_steps=STEPS) as handle:
        field(*points())
        for step in (0, STEPS // 2, STEPS):
            handle.step(step)
            slots = [slot for module in field.modules() for slot in slots_of(module)]
            if not any(slot.active for slot in slots) or regularizer.gradient_only():
                assert same(list(field(*points())), bare)
            for slot in slots:
                assert not (slot.active and ended(slot))


def ended(slot: Slot) -> bool:
    """Whether a mask is past its end."""
    mask, place = slot.regularizer, slot.context.place
    if not isinstance(mask, gridreg.Mask) or place is None:
        return False
    end = mask.end(max(mask.ranks(place)) + 1, STEPS)
    return end is not None and slot.context.step >= end


def no_weight(regularizer: Regularizer, name: str) -> None:
    """Weight 0: the loss is exactly 0 and the outputs are bit-identical."""
    if not hasattr(regularizer, "weight"):
        return
    field = made(name)
    bare = list(field(*points()))
    with gridreg.apply(field, replace(regularizer, weight=0.0), total_steps=STEPS) as handle:  # type: ignore[call-arg]
        assert handle.loss(samples_of(field)).item() == 0
        assert list(handle.terms.values()) == [torch.zeros(())]
        assert same(list(field(*points())), bare)


def terms(regularizer: Regularizer, name: str) -> None:
    """The parts of a loss sum to it; what the optimizer may take over equals what the loss leaves out."""
    field = made(name)
    with gridreg.apply(field, regularizer, regularizer, total_steps=STEPS) as handle:
        handle.step(1)
        loss = handle.loss(samples_of(field))
        assert loss.shape == ()
        torch.testing.assert_close(
            torch.stack([torch.zeros(()), *handle.terms.values()]).sum(), loss.detach()
        )
        local = handle.grid_terms()
        if local:
            rest = handle.loss(samples_of(field), exclude={term.name for term in local})
            closed = sum((closed_form(term) for term in local), torch.zeros(()))
            torch.testing.assert_close(rest + closed, loss)


def closed_form(term: gridreg.LocalTerm) -> Tensor:
    """What a local term stands for, written out."""
    p = term.parameter
    if term.kind == "total_variation":
        return term.scale * torch.stack([p.diff(dim=axis).square().mean() for axis in term.spatial]).sum()
    return term.scale * (p.abs() if term.kind == "l1" else p.square()).mean()


def memory(regularizer: Regularizer, name: str) -> None:
    """A saved state, loaded on a fresh field, goes on with the same numbers."""
    first, second = made(name), made(name)
    with (
        gridreg.apply(first, regularizer, total_steps=STEPS, seed=1) as old,
        gridreg.apply(second, regularizer, total_steps=STEPS, seed=2) as new,
    ):
        observed(first, old)
        for step in (2, 3):
            old.step(step)
        new.load_state_dict(copy.deepcopy(old.state_dict()))
        assert same(observed(first, old), observed(second, new))
        old.step(4)
        new.step(4)
        assert same(observed(first, old), observed(second, new))


def replacement(regularizer: Regularizer, name: str) -> None:
    """Equal parameters in the place of the old ones, even in new lists, give the same numbers."""
    field = made(name)
    with gridreg.apply(field, regularizer, total_steps=STEPS) as handle:
        handle.step(3)
        before = observed(field, handle)
        with handle.suspended():
            renew(field)
        assert same(observed(field, handle), before)
        renew_lists(field)
        handle.step(3)
        if not type(regularizer).train_only:
            assert same(observed(field, handle), before)


def renew(field: nn.Module) -> None:
    """Assign an equal parameter to every name, and a new list to every list."""
    for module in list(field.modules()):
        for key, parameter in list(module._parameters.items()):
            if parameter is not None:
                setattr(module, key, nn.Parameter(parameter.detach().clone()))
    renew_lists(field)


def renew_lists(field: nn.Module) -> None:
    """Put new lists of the raw parameters in the place of every `ParameterList`."""
    for module in list(field.modules()):
        for key, child in list(module._modules.items()):
            if isinstance(child, nn.ParameterList):
                module._modules[key] = nn.ParameterList(child._parameters.values())


def plain_data(regularizer: Regularizer, name: str) -> None:
    """To YAML and back, it is equal."""
    text = yaml.safe_dump(gridreg.to_config([regularizer]))
    assert gridreg.from_config(yaml.safe_load(text)) == [regularizer]


def copies(regularizer: Regularizer, name: str) -> None:
    """A copy or a pickle of the field behaves the same at that moment, and goes its own way from then on."""
    if not overrides(regularizer, "transform"):
        return
    field = made(name)
    with gridreg.apply(field, regularizer, total_steps=STEPS) as handle:
        handle.step(3)
        values = list(field(*points()))
        twins = [copy.deepcopy(field), pickle.loads(pickle.dumps(field))]
        assert all(same(list(twin(*points())), values) for twin in twins)
        handle.step(STEPS)
    assert all(same(list(twin(*points())), values) for twin in twins)
    for twin in twins:
        gridreg.strip(twin)
        assert type(twin) is type(field)
        assert same(list(twin(*points())), list(field(*points())))


def gradients(regularizer: Regularizer, name: str) -> None:
    """Analytic gradients equal numeric ones in float64, for transforms and penalties."""
    if overrides(regularizer, "transform"):
        for context in list(contexts(regularizer, name, 3))[:1]:
            value = tensor_for(context)
            if regularizer.gradient_only():
                assert torch.equal(regularizer.transform(value, context), value)
            else:
                assert torch.autograd.gradcheck(
                    lambda v, c=context: regularizer.transform(v, c), (value,), fast_mode=True
                )
    clock = Clock(STEPS, seed=5)
    if overrides(regularizer, "penalty"):
        samples = samples_of(made(name))
        density = samples.density.detach().double().view(8, 6)
        density = density.requires_grad_()

        def penalty(density: Tensor) -> Tensor:
            made_from = gridreg.RaySamples.from_dense(
                torch.linspace(0.2, 2.0, 6, dtype=torch.float64),
                torch.full((6,), 0.36, dtype=torch.float64),
                density,
                colours=samples.colours.detach().view(8, 6, 3).double(),  # type: ignore[union-attr]
                positions=samples.positions.detach().view(8, 6, 3).double(),  # type: ignore[union-attr]
                patch=(2, 2, 2),
                target_opacity=torch.linspace(0, 1, 8, dtype=torch.float64),
            )
            return regularizer.penalty(made_from, Context(clock)).double()

        assert torch.autograd.gradcheck(penalty, (density,), fast_mode=True)
    if overrides(regularizer, "grid_penalty"):
        field = made(name).double()
        matches = [match for site in regularizer.sites() for match in find(field, site, "grids")]
        grids = [match.grid() for match in matches]

        def grid_penalty(*values: Tensor) -> Tensor:
            changed = [replace(grid, parameter=v) for grid, v in zip(grids, values, strict=True)]
            return regularizer.grid_penalty(changed, Context(clock))

        leaves = tuple(grid.parameter.detach().clone().requires_grad_() for grid in grids)
        assert torch.autograd.gradcheck(grid_penalty, leaves, fast_mode=True)


def closed_channels(regularizer: Regularizer, name: str) -> None:
    """A closed channel has exactly no effect and no gradient, even where it is NaN or infinite."""
    if not isinstance(regularizer, gridreg.Mask):
        return
    for context in contexts(regularizer, name, 2):
        place = context.place
        assert place is not None
        closed = context.state["mask"] == 0
        value = tensor_for(context).detach()
        axis = value.movedim(place.dim, -1)
        axis[..., closed] = (
            torch.tensor([float("nan"), float("inf")])[: 1 + (int(closed.sum()) > 1)]
            .repeat(int(closed.sum()))[: int(closed.sum())]
            .double()
        )
        value.requires_grad_()
        result = regularizer.transform(value, context)
        (gradient,) = torch.autograd.grad(result, value, torch.ones_like(result))
        assert (gradient.movedim(place.dim, -1)[..., closed] == 0).all()
        if regularizer.gradient_only():
            assert torch.equal(result.nan_to_num(), value.nan_to_num())
        else:
            assert (result.movedim(place.dim, -1)[..., closed] == 0).all()
        assert result.movedim(place.dim, -1)[..., ~closed].isfinite().all()


LAWS = (
    removal,
    idleness,
    no_weight,
    terms,
    memory,
    replacement,
    plain_data,
    copies,
    gradients,
    closed_channels,
)


def accepted(regularizer: Regularizer, name: str) -> bool:
    """Whether it fits the design; if not, it says so in one line."""
    field = made(name)
    refusal = ""
    try:
        with gridreg.apply(field, regularizer, total_steps=STEPS) as handle:
            observed(field, handle)
    except gridreg.InputError as error:
        refusal = str(error)
    assert not refusal or type(regularizer).__name__ in refusal
    assert "\n" not in refusal
    return not refusal


def check(cls: type[Regularizer], name: str) -> int:
    """All laws for all examples of a class that fit a design; returns how many these were."""
    examples = [example for example in examples_on(cls, DESIGNS[name]) if accepted(example, name)]
    for example in examples:
        for law in LAWS:
            try:
                law(example, name)
            except Exception as error:
                raise AssertionError(f"{example} on {name} breaks {law.__name__!r}: {error}") from error
    return len(examples)
