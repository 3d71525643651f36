"""The laws that every regularizer keeps, each as a function of a regularizer and a field to try it on."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gridreg.attach._hooks import slots_of, strip
from gridreg.attach._notices import AttachWarning
from gridreg.attach._resolve import find
from gridreg.attach._slots import Slot
from gridreg.attach.apply import apply
from gridreg.base import REGISTRY, Clock, Context, LocalTerm, Regularizer, overrides
from gridreg.compositions.plain_data import from_config, to_config
from gridreg.errors import InputError
from gridreg.regularizers.mask_base import Mask
from gridreg.testing import _subjects
from gridreg.testing._mask_laws import closed_channels, masks
from gridreg.testing._subjects import (
    STEPS,
    Subject,
    anatomy,
    contexts,
    expect,
    observed,
    rays_of,
    renew,
    renew_lists,
    same,
    samples_of,
    seen,
    tensor_for,
)


def _gradient_only(regularizer: Regularizer) -> bool:
    """Whether it declares that it leaves values as they are."""
    return bool(getattr(regularizer, "detach", False))


def removal(regularizer: Regularizer, subject: Subject) -> None:
    """`remove` leaves no trace: outputs, names, classes, dictionaries and hooks are what they were."""
    field = subject.made()
    values, keys, before = seen(field), list(field.state_dict()), anatomy(field)
    handle = apply(field, regularizer, total_steps=STEPS)
    expect(list(field.state_dict()) == keys, "attaching changed the keys of state_dict")
    expect(all(p.is_leaf for _, p in field.named_parameters()), "attaching changed the parameters")
    handle.step(3)
    observed(field, handle)
    with handle.suspended():
        expect(same(seen(field), values), "outputs differ inside suspended()")
        expect(anatomy(field) == before, "traces inside suspended()")
    handle.remove()
    expect(anatomy(field) == before, "traces after remove()")
    expect(list(field.state_dict()) == keys, "other keys of state_dict after remove()")
    expect(same(seen(field), values), "outputs differ after remove()")


def idleness(regularizer: Regularizer, subject: Subject) -> None:
    """A transform that says it is the identity leaves outputs bit-identical; a scheduled mask is it at its end."""
    field = subject.made()
    bare = seen(field)
    with apply(field, regularizer, total_steps=STEPS) as handle:
        seen(field)
        for step in (0, STEPS // 2, STEPS):
            handle.step(step)
            slots = [slot for module in field.modules() for slot in slots_of(module)]
            if not any(slot.active for slot in slots) or _gradient_only(regularizer):
                expect(same(seen(field), bare), f"the identity changes outputs at step {step}")
            expect(not any(slot.active and _ended(slot) for slot in slots), "acts after its end")


def _ended(slot: Slot) -> bool:
    """Whether a mask is past its end."""
    mask, place = slot.regularizer, slot.context.place
    if not isinstance(mask, Mask) or place is None:
        return False
    end = mask.end(max(mask.ranks(place)) + 1, STEPS)
    return end is not None and slot.context.step >= end


def no_weight(regularizer: Regularizer, subject: Subject) -> None:
    """Weight 0: the loss is exactly 0 and the outputs are bit-identical."""
    if not hasattr(regularizer, "weight"):
        return
    field = subject.made()
    bare = seen(field)
    with apply(field, replace(regularizer, weight=0.0), total_steps=STEPS) as handle:  # type: ignore[call-arg]
        expect(handle.loss(samples_of(field)).item() == 0, "the loss is not 0 at weight 0")
        expect(list(handle.terms.values()) == [torch.zeros(())], "another term than 0 at weight 0")
        expect(same(seen(field), bare), "outputs differ at weight 0")


def terms(regularizer: Regularizer, subject: Subject) -> None:
    """The parts of a loss sum to it; what the optimizer may take over equals what the loss leaves out."""
    field = subject.made()
    with apply(field, regularizer, regularizer, total_steps=STEPS) as handle:
        handle.step(1)
        loss = handle.loss(samples_of(field))
        expect(loss.shape == (), f"the loss has shape {tuple(loss.shape)}")
        torch.testing.assert_close(
            torch.stack([torch.zeros(()), *handle.terms.values()]).sum(), loss.detach()
        )
        local = handle.grid_terms()
        if local:
            rest = handle.loss(samples_of(field), exclude={term.name for term in local})
            closed = sum((closed_form(term) for term in local), torch.zeros(()))
            torch.testing.assert_close(rest + closed, loss)


def closed_form(term: LocalTerm) -> Tensor:
    """Value of a local term, written out."""
    p = term.parameter
    if term.kind == "total_variation":
        return term.scale * torch.stack([p.diff(dim=axis).square().mean() for axis in term.spatial]).sum()
    return term.scale * (p.abs() if term.kind == "l1" else p.square()).mean()


def memory(regularizer: Regularizer, subject: Subject) -> None:
    """A saved state, loaded on a fresh field, goes on with the same numbers."""
    first, second = subject.made(), subject.made()
    with (
        apply(first, regularizer, total_steps=STEPS, seed=1) as old,
        apply(second, regularizer, total_steps=STEPS, seed=2) as new,
    ):
        observed(first, old)
        for step in (2, 3):
            old.step(step)
        new.load_state_dict(copy.deepcopy(old.state_dict()))
        expect(same(observed(first, old), observed(second, new)), "other numbers after loading")
        old.step(4)
        new.step(4)
        expect(same(observed(first, old), observed(second, new)), "other numbers a step after loading")


def replacement(regularizer: Regularizer, subject: Subject) -> None:
    """Equal parameters in the place of the old ones, even in new lists, give the same numbers."""
    field = subject.made()
    with apply(field, regularizer, total_steps=STEPS) as handle:
        handle.step(3)
        before = observed(field, handle)
        with handle.suspended():
            renew(field)
        expect(same(observed(field, handle), before), "other numbers after equal parameters came in")
        renew_lists(field)
        handle.step(3)
        if not type(regularizer).train_only:
            expect(same(observed(field, handle), before), "other numbers after new lists came in")


def plain_data(regularizer: Regularizer, subject: Subject) -> None:
    """To plain data and back, it is equal; not asked of a class that is not registered."""
    if type(regularizer) in REGISTRY.values():
        expect(from_config(to_config([regularizer])) == [regularizer], "not equal after a round trip")


def copies(regularizer: Regularizer, subject: Subject) -> None:
    """A copy or a pickle of the field behaves the same at that moment, and goes its own way from then on."""
    if not overrides(regularizer, Regularizer.transform):
        return
    field = subject.made()
    with apply(field, regularizer, total_steps=STEPS) as handle:
        handle.step(3)
        values = seen(field)
        twins = [copy.deepcopy(field), pickle.loads(pickle.dumps(field))]
        expect(all(same(seen(twin), values) for twin in twins), "a copy differs")
        handle.step(STEPS)
    expect(all(same(seen(twin), values) for twin in twins), "a copy follows")
    for twin in twins:
        strip(twin)
        expect(type(twin) is type(field), "a stripped copy has another class")
        expect(same(seen(twin), seen(field)), "a stripped copy differs")


def gradients(regularizer: Regularizer, subject: Subject) -> None:
    """Analytic gradients equal numeric ones in float64, for transforms and penalties."""
    if overrides(regularizer, Regularizer.transform):
        for context in list(contexts(regularizer, subject, 3))[:1]:
            value = tensor_for(context)
            if _gradient_only(regularizer):
                expect(torch.equal(regularizer.transform(value, context), value), "values change")
            else:
                torch.autograd.gradcheck(
                    lambda v, c=context: regularizer.transform(v, c), (value,), fast_mode=True
                )
    clock = Clock(STEPS, seed=5)
    if overrides(regularizer, Regularizer.penalty):
        samples = samples_of(subject.made())

        def penalty(density: Tensor) -> Tensor:
            # Proposals learn from final samples, which get no gradient.
            final = fixed if "proposals" in regularizer.needs() else None
            made_from = rays_of(density, positions, colours, directions, final)
            return regularizer.penalty(made_from, Context(clock)).double()

        wide = (samples.positions, samples.colours, samples.directions)
        positions, colours, directions = (
            torch.zeros(8, 3) if x is None else x.detach().double().view(8, -1, 3).squeeze(1) for x in wide
        )
        fixed = samples.density.detach().double().view(8, 6).flip(1)
        density = samples.density.detach().double().view(8, 6).requires_grad_()
        torch.autograd.gradcheck(penalty, (density,), fast_mode=True)
    if overrides(regularizer, Regularizer.grid_penalty):
        field = subject.made().double()
        matches = [match for site in regularizer.sites() for match in find(field, site, "grids")]
        grids = [grid for match in matches for grid in match.grids()]

        def grid_penalty(*values: Tensor) -> Tensor:
            changed = [replace(grid, parameter=v) for grid, v in zip(grids, values, strict=True)]
            return regularizer.grid_penalty(changed, Context(clock))

        leaves = tuple(grid.parameter.detach().clone().requires_grad_() for grid in grids)
        torch.autograd.gradcheck(grid_penalty, leaves, fast_mode=True)


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
    masks,
)


def accepted(regularizer: Regularizer, subject: Subject) -> bool:
    """Whether it fits a field; if not, it says so in one line that names the regularizer."""
    field = subject.made()
    try:
        with apply(field, regularizer, total_steps=STEPS) as handle:
            observed(field, handle)
    except InputError as error:
        expect(type(regularizer).__name__ in str(error), f"refused without its name: {error}")
        expect("\n" not in str(error), f"refused in several lines: {error}")
        return False
    return True


def _check(law: Callable[[Regularizer, Subject], None], example: Regularizer, subject: Subject) -> None:
    """Try one law, without the advice that its short runs and its copies would call for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AttachWarning)
        try:
            law(example, subject)
        except Exception as error:
            raise AssertionError(f"{example} breaks {law.__name__!r}: {error}") from error


def check_regularizer(cls: type[Regularizer], *subjects: Subject) -> int:
    """Check all laws for all examples of a regularizer class.

    Args:
        cls: has a class method `examples(site)` that returns instances to try.
        subjects: fields to try it on; by default a small one with planes, lines, an encoding and a network.

    Returns:
        How many examples fitted a field.

    Raises:
        InputError: the class gives no examples.
        AssertionError: an example breaks a law, which is named.

    >>> import gridreg
    >>> check_regularizer(gridreg.L1)
    1
    """
    subjects = subjects or (_subjects.BUILT_IN,)
    if not any(_subjects.examples_on(cls, subject) for subject in subjects):
        raise InputError(f"{cls.__name__}: needs a classmethod examples(site) -> list of instances to check")
    checked = 0
    for subject in subjects:
        for example in _subjects.examples_on(cls, subject):
            if accepted(example, subject):
                checked += 1
                for law in LAWS:
                    _check(law, example, subject)
    return checked
