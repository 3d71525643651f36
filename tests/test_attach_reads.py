"""Reads of a masked parameter: once a step, with right gradients, and what torch does with masked tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

import gridreg
from gridreg.attach.sites import SiteLike
from gridreg.base import Context, Regularizer

LINES = gridreg.parameters("lines.*", dim=1)


@dataclass(frozen=True)
class Cubed(Regularizer):
    """A transform that is not linear, and counts how often it is computed."""

    count: ClassVar[list[int]] = [0]
    site: SiteLike

    def transform(self, value: Tensor, context: Context) -> Tensor:
        Cubed.count[0] += 1
        return value**3


class Lines(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.lines = nn.ParameterList([torch.full((1, 9, 4, 1), 2.0 + i) for i in range(4)])
        self.named = nn.ParameterDict({"a": torch.ones(1, 9, 4, 1)})

    def get_optparam_groups(self) -> list[dict[str, Any]]:
        return [{"params": self.lines, "lr": 0.02}, {"params": self.named["a"], "lr": 0.1}]


def test_a_transform_is_computed_once_for_all_reads_of_a_step() -> None:
    field = Lines()
    with gridreg.apply(field, Cubed(gridreg.parameters("lines.0", dim=1)), total_steps=9) as handle:
        Cubed.count[0] = 0
        first, second = (field.lines[0] ** 2).sum(), field.lines[0].sum() + field.lines[0].sum()
        assert Cubed.count == [1]
        first.backward()
        # A second backward pass over what the first one went through.
        second.backward()
        raw = field.lines._parameters["0"]
        assert torch.equal(raw.grad, 6 * raw.detach() ** 5 + 2 * 3 * raw.detach() ** 2)
        (slope,) = torch.autograd.grad(field.lines[0].sum(), raw, create_graph=True)
        (curvature,) = torch.autograd.grad(slope.sum(), raw)
        assert torch.equal(curvature, 6 * raw.detach())
        with torch.no_grad():
            raw.add_(1)
        assert torch.equal(field.lines[0], raw.detach() ** 3)
        raw.data = torch.ones_like(raw)
        assert (field.lines[0] == 1).all()
        handle.step(1)
        Cubed.count[0] = 0
        with torch.no_grad():
            _ = field.lines[0], field.lines[0]
            assert Cubed.count == [2]
            with handle.cached():
                _ = field.lines[0], field.lines[0]
            assert Cubed.count == [3]
            raw.data.mul_(2)
            assert (field.lines[0] == 8).all()


@pytest.mark.parametrize("reentrant", [True, False])
def test_checkpointing_computes_the_same_gradient(reentrant: bool) -> None:
    field, x = Lines(), torch.ones(9, requires_grad=True)

    def run(x: Tensor) -> Tensor:
        return (field.lines[0][0, :, :, 0].T * x).square().sum() + field.lines[0].sum()

    with gridreg.apply(field, gridreg.FrequencyMask(LINES), total_steps=9):
        run(x).backward()
        expected = field.lines._parameters["0"].grad
        field.zero_grad()
        checkpoint(run, x, use_reentrant=reentrant).backward()
        assert torch.equal(field.lines._parameters["0"].grad, expected)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_transforms_of_torch_func_are_not_given_a_kept_tensor() -> None:
    field, x = Lines(), torch.ones(9)
    with gridreg.apply(field, gridreg.FrequencyMask(LINES), total_steps=9):
        run = lambda x: (field.lines[0][0, :, 0, 0] * x).sum()  # noqa: E731
        _ = field.lines[0]
        assert torch.equal(torch.func.grad(run)(x), torch.tensor([2.0] * 3 + [0] * 6))
        assert torch.func.vmap(run)(torch.ones(5, 9)).tolist() == [6.0] * 5
        assert torch.func.jvp(run, (x,), (x,))[1] == 6


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("inplace", [True, False])
def test_gradient_masks_before_an_in_place_relu_and_under_torch_func(inplace: bool) -> None:
    field, x = nn.Sequential(nn.Linear(9, 9), nn.ReLU(inplace=inplace)), torch.randn(2, 9)
    bare = field(x)
    with gridreg.apply(field, gridreg.FrequencyMask(gridreg.outputs("0"), detach=True), total_steps=9):
        out = field(x)
        assert torch.equal(out, bare)
        out.sum().backward()
        assert not field[0].weight.grad[3:].any()
        gradient = torch.func.grad(lambda v: field[0](v).sum())(x)
        assert torch.allclose(gradient, field[0].weight[:3].sum(0).expand(2, 9))
        (tangent,) = torch.func.jvp(lambda v: field[0](v), (x,), (torch.ones_like(x),))[1:]
        assert not tangent[:, 3:].any()
        assert torch.func.vmap(field[0])(x[None]).shape == (1, 2, 9)


def test_slices_and_copies_of_lists_keep_values_and_gradients() -> None:
    field = Lines()
    sites = LINES, gridreg.parameters("named.*", dim=1)
    with gridreg.apply(field, *map(gridreg.FrequencyMask, sites), total_steps=9):
        made = [
            field.lines[1:3],
            nn.ParameterList(field.lines),
            nn.ParameterList([*field.lines[::-1], torch.ones(1)]),
            field.named.copy(),
            nn.ParameterDict(field.named),
            field.named | {"b": torch.ones(2)},
        ]
        for part in made:
            field.zero_grad()
            values = list(part.values() if isinstance(part, nn.ParameterDict) else part)
            masked = [value for value in values if value.ndim == 4]
            assert masked
            assert all(not value[:, 3:].any() and value[:, :3].all() for value in masked)
            sum(value.sum() for value in masked).backward()
            gradients = [p.grad for p in field.parameters() if p.grad is not None]
            assert len(gradients) == len(masked)
            assert all((g[:, :3] == 1).all() and (g[:, 3:] == 0).all() for g in gradients)
    assert type(field.lines) is nn.ParameterList


@pytest.mark.parametrize("no_grad", [True, False])
def test_optimizers_are_made_of_parameters(no_grad: bool) -> None:
    field = Lines()
    own = {id(p) for p in field.parameters()}
    masks = gridreg.FrequencyMask(LINES), gridreg.FrequencyMask(gridreg.parameters("named.a", dim=1))
    with gridreg.apply(field, *masks, gridreg.WeightDecay(LINES), total_steps=9) as handle:
        with torch.set_grad_enabled(not no_grad):
            groups = handle.parameter_groups(field.get_optparam_groups())
        optimizer = torch.optim.AdamW(groups)
        assert {id(p) for group in optimizer.param_groups for p in group["params"]} == own
    with gridreg.apply(field, *masks, total_steps=9) as handle:
        named = handle.parameter_groups([{"params": [("line", field.lines[0])]}])
        assert named[0]["params"][0][0] == "line"
        assert named[0]["params"][0][1] is field.lines._parameters["0"]


def test_an_optimizer_of_masked_tensors_is_refused() -> None:
    field = Lines()
    with gridreg.apply(field, gridreg.FrequencyMask(LINES), total_steps=9):
        with torch.no_grad():
            optimizer = torch.optim.SGD([{"params": list(field.lines)}], lr=0.1)
        with pytest.raises(gridreg.InputError, match=r"holds masked tensors.*handle\.parameter_groups"):
            optimizer.step()
    torch.optim.SGD(field.parameters(), lr=0.1).step()


def test_torch_gets_parameters_where_it_means_them() -> None:
    field = nn.Sequential(nn.Linear(9, 9))
    raw = field[0].weight
    with gridreg.apply(field, gridreg.FixedMask(gridreg.parameters("0.weight", dim=1), 0.0), total_steps=9):
        assert field.get_parameter("0.weight") is raw
        assert nn.ModuleList([field]).get_parameter("0.0.weight") is raw
        nn.utils.parametrize.register_parametrization(field[0], "weight", nn.Identity())
        assert field[0].parametrizations.weight.original is raw


def test_replicas_of_data_parallel_are_masked() -> None:
    """As torch.nn.parallel.replicate makes them, which needs several GPUs."""
    field = nn.Linear(9, 2)
    with gridreg.apply(field, gridreg.FixedMask(gridreg.parameters("weight", dim=1), 0.5), total_steps=9):
        replica = field._replicate_for_data_parallel()
        for name, parameter in field._parameters.items():
            setattr(replica, name, parameter.clone())
        x = torch.ones(3, 9)
        assert torch.equal(replica(x), field(x))
        replica(x).sum().backward()
        assert (field._parameters["weight"].grad[:, 4:] == 0).all()
        del replica.weight
        with pytest.raises(AttributeError):
            _ = replica.weight


def test_reading_on_the_meta_device_does_not_move_the_mask() -> None:
    field = Lines()
    with gridreg.apply(field, gridreg.FrequencyMask(LINES), total_steps=9) as handle:
        field.to("meta")
        assert field.lines[0].is_meta
        field.to_empty(device="cpu")
        with torch.no_grad():
            for parameter in field.parameters():
                parameter.fill_(1)
        handle.step(1)
        assert not field.lines[0][:, 6:].any()


def test_bake_writes_what_the_field_reads() -> None:
    field = nn.Sequential(nn.Linear(9, 9), nn.Linear(9, 2))
    first = gridreg.FrequencyMask(gridreg.parameters("0.weight", dim=1), until=7)
    handle = gridreg.apply(
        field, first, gridreg.ComponentDropout(gridreg.parameters("1.weight", dim=1)), total_steps=9
    )
    handle.step(2)
    x, own = torch.randn(4, 9), list(field.parameters())
    expected = field.eval()(x)
    handle.bake()
    assert type(field[0]) is nn.Linear
    assert torch.equal(field(x), expected)
    assert all(a is b for a, b in zip(field.parameters(), own, strict=True))
    handle = gridreg.apply(field, gridreg.FixedMask(gridreg.outputs("0"), 0.5), total_steps=9)
    field(x)
    with pytest.raises(gridreg.InputError, match=r"FixedMask\(0\): acts on the outputs"):
        handle.bake()
    handle.remove()


def test_sites_of_parts_are_named_by_path() -> None:
    class Part(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.grid = nn.Parameter(torch.ones(1, 9, 4))

        def sites(self) -> dict[str, gridreg.Site]:
            return {"density": gridreg.Site(gridreg.parameters("grid", dim=1))}

    model = nn.ModuleDict({"field": Part(), "proposal": Part()})
    with gridreg.apply(model, gridreg.FixedMask("field.density", 0.0), total_steps=9):
        assert not model["field"].grid.any()
        assert model["proposal"].grid.all()
    with pytest.raises(gridreg.InputError, match=r"did you mean 'field\.density' or 'proposal\.density'\?"):
        gridreg.apply(model, gridreg.FixedMask("density", 0.0), total_steps=9)
    with pytest.raises(gridreg.InputError, match=r"site=Parameter of shape \(1, 9, 4\): expected"):
        gridreg.FixedMask(model["field"].grid)  # type: ignore[arg-type]
