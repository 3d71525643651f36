"""Weight decay and learning rates by site, in the groups of torch's own optimizers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

import gridreg
from gridreg.errors import InputError
from gridreg.regularizers.optimizer import LearningRate, WeightDecay, split_groups
from gridreg.schedules import Linear

LINES = gridreg.parameters("line", dim=0)


class Field(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.line = nn.Parameter(torch.randn(3, 5, generator=generator))
        self.plane = nn.Parameter(torch.randn(3, 5, 5, generator=generator))
        self.decoder = nn.Linear(3, 1)
        for parameter in self.decoder.parameters():
            nn.init.normal_(parameter, generator=generator)


def groups_of(field: Field) -> list[dict[str, Any]]:
    return [
        {"name": "grid", "params": [field.line, field.plane], "lr": 0.1},
        {"name": "network", "params": list(field.decoder.parameters()), "lr": 0.001},
    ]


def quadratic(field: Field) -> torch.Tensor:
    return sum((p**2).sum() for p in field.parameters())  # type: ignore[return-value]


class TestSplitGroups:
    def test_keeps_order_options_and_the_input(self) -> None:
        field = Field()
        groups = groups_of(field)
        result, parts = split_groups(groups, [field.line])
        assert [[id(p) for p in g["params"]] for g in result] == [
            [id(field.plane)],
            [id(field.line)],
            [id(p) for p in field.decoder.parameters()],
        ]
        assert [g["lr"] for g in result] == [0.1, 0.1, 0.001]
        assert parts == [result[1]]
        assert len(groups[0]["params"]) == 2

    def test_a_whole_group_stays_one_group(self) -> None:
        field = Field()
        result, parts = split_groups(groups_of(field), [field.line, field.plane])
        assert len(result) == 2
        assert parts[0] is result[0]

    def test_parameters_with_their_names(self) -> None:
        field = Field()
        groups: list[dict[str, Any]] = [{"params": list(field.named_parameters()), "lr": 0.1}]
        result, parts = split_groups(groups, [field.line])
        assert [[name for name, _ in group["params"]] for group in result] == [
            ["plane", "decoder.weight", "decoder.bias"],
            ["line"],
        ]
        assert parts == [result[1]]

    def test_parameters_that_no_group_holds(self) -> None:
        with pytest.raises(InputError, match="none holds a parameter of the site"):
            split_groups(groups_of(Field()), [Field().line])


class TestWeightDecay:
    @pytest.mark.parametrize("optimizer_class", [torch.optim.AdamW, torch.optim.Adam])
    def test_shrinks_the_site_alone_and_apart_from_the_gradient(self, optimizer_class: Any) -> None:
        plain, decayed = Field(), Field()
        decayed.load_state_dict(plain.state_dict())
        handle = gridreg.apply(decayed, WeightDecay(LINES, decay=0.5), total_steps=10)
        optimizers = [
            optimizer_class(groups_of(plain), weight_decay=0.0),
            optimizer_class(handle.parameter_groups(groups_of(decayed)), weight_decay=0.0),
        ]
        before = decayed.line.detach().clone()
        for field, optimizer in zip((plain, decayed), optimizers, strict=True):
            quadratic(field).backward()
            optimizer.step()
        # AdamW: p - lr * decay * p, then the same Adam step as without.
        torch.testing.assert_close(decayed.line, plain.line - 0.1 * 0.5 * before)
        assert torch.equal(decayed.plane, plain.plane)
        assert torch.equal(decayed.decoder.weight, plain.decoder.weight)

    def test_follows_its_schedule(self) -> None:
        field = Field()
        handle = gridreg.apply(field, WeightDecay(LINES, decay=Linear(0.0, 1.0)), total_steps=10)
        optimizer = torch.optim.AdamW(handle.parameter_groups(groups_of(field)), weight_decay=0.0)
        for step, expected in ((0, 0.0), (5, 0.5), (10, 1.0)):
            handle.step(step)
            handle.update_groups(optimizer.param_groups)
            assert [g["weight_decay"] for g in optimizer.param_groups] == [0.0, expected, 0.0]


class TestLearningRate:
    def test_scales_the_site_alone(self) -> None:
        field = Field()
        handle = gridreg.apply(field, LearningRate(LINES, scale=0.25), total_steps=10)
        groups = handle.parameter_groups(groups_of(field))
        assert [g["lr"] for g in groups] == [0.1, 0.025, 0.001]
        optimizer = torch.optim.SGD(groups, lr=1.0)
        before = field.line.detach().clone()
        quadratic(field).backward()
        optimizer.step()
        torch.testing.assert_close(field.line, before - 0.025 * 2 * before)

    def test_schedule_goes_with_a_trainer_that_decays_from_the_initial_rate(self) -> None:
        field = Field()
        handle = gridreg.apply(field, LearningRate(LINES, scale=Linear(1.0, 0.1, until=10)), total_steps=20)
        optimizer = torch.optim.Adam(handle.parameter_groups(groups_of(field)))
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        for step in range(12):
            handle.step(step)
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * 0.9**step
            handle.update_groups(optimizer.param_groups)
            handle.update_groups(optimizer.param_groups)
            expected = 0.1 * 0.9**step * max(0.1, 1 - 0.09 * step)
            assert optimizer.param_groups[1]["lr"] == pytest.approx(expected)
            assert optimizer.param_groups[0]["lr"] == pytest.approx(0.1 * 0.9**step)

    def test_sites_inside_one_another_multiply(self) -> None:
        field = Field()
        both = gridreg.Site(grids=(LINES, gridreg.parameters("plane", dim=0)))
        handle = gridreg.apply(field, LearningRate(both, 0.5), LearningRate(LINES, 0.5), total_steps=10)
        groups = handle.parameter_groups(groups_of(field))
        rates = {id(p): g["lr"] for g in groups for p in g["params"]}
        assert rates[id(field.plane)] == pytest.approx(0.05)
        assert rates[id(field.line)] == pytest.approx(0.025)

    def test_groups_without_a_rate(self) -> None:
        field = Field()
        handle = gridreg.apply(field, LearningRate(LINES, 0.5), total_steps=10)
        with pytest.raises(InputError, match="expected an 'lr' in the groups of the site"):
            handle.parameter_groups([{"params": list(field.parameters())}])


@pytest.mark.parametrize(
    ("cls", "arguments", "message"),
    [
        (WeightDecay, {"decay": -0.1}, r"decay=-0\.1"),
        (LearningRate, {"scale": 0.0}, r"scale=0\.0"),
        (LearningRate, {"scale": "fast"}, "scale='fast'"),
        (WeightDecay, {"site": 5}, "site=5"),
        (LearningRate, {"site": 5}, "site=5"),
    ],
)
def test_bad_arguments(cls: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        cls(**{"site": LINES, **arguments})


@pytest.mark.parametrize(
    "regularizer",
    [WeightDecay(LINES, Linear(0.5, 0.0)), LearningRate(LINES, Linear(1.0, 0.2))],
    ids=["WeightDecay", "LearningRate"],
)
def test_a_run_goes_on_from_a_saved_optimizer(regularizer: gridreg.Regularizer) -> None:
    def start() -> tuple[Field, gridreg.Handle, torch.optim.Optimizer]:
        field = Field()
        handle = gridreg.apply(field, regularizer, total_steps=10)
        return field, handle, torch.optim.AdamW(handle.parameter_groups(groups_of(field)), weight_decay=0.0)

    def run(field: Field, handle: gridreg.Handle, optimizer: torch.optim.Optimizer, steps: range) -> None:
        for step in steps:
            handle.step(step)
            handle.update_groups(optimizer.param_groups)
            optimizer.zero_grad()
            quadratic(field).backward()
            optimizer.step()

    whole, half, rest = start(), start(), start()
    run(*whole, range(8))
    run(*half, range(4))
    rest[0].load_state_dict(half[0].state_dict())
    rest[1].load_state_dict(half[1].state_dict())
    rest[2].load_state_dict(half[2].state_dict())
    run(*rest, range(4, 8))
    for expected, found in zip(whole[0].parameters(), rest[0].parameters(), strict=True):
        assert torch.equal(expected, found)


def test_a_new_optimizer_after_growing_keeps_the_settings_of_the_site() -> None:
    field = Field()
    composition = [WeightDecay(LINES, decay=0.5), LearningRate(LINES, scale=Linear(1.0, 0.5))]
    handle = gridreg.apply(field, *composition, total_steps=10)
    handle.step(5)
    with handle.suspended():
        field.line = nn.Parameter(torch.randn(3, 9))
    groups = handle.parameter_groups(groups_of(field))
    (group,) = [g for g in groups if g["params"][0] is field.line]
    assert group["weight_decay"] == 0.5
    assert group["lr"] == pytest.approx(0.1 * 0.75)
