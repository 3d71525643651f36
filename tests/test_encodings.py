"""Positional encodings against the programs that they come from."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import nn

import gridreg
from gridreg.encodings import Order

ORDERS: tuple[Order, ...] = ("octave", "sines_first", "coordinate")


def original_nerf(x: NDArray[np.float64], octaves: int) -> NDArray[np.float64]:
    """NeRF's program: a list of functions, octave by octave."""
    parts = [x]
    for k, function in itertools.product(range(octaves), (np.sin, np.cos)):
        parts.append(function(x * 2.0**k))
    return np.concatenate(parts, -1)


def jaxnerf(x: NDArray[np.float64], octaves: int) -> NDArray[np.float64]:
    """FreeNeRF's JAX program: posenc with sin(x + pi / 2) for the cosines."""
    scales = np.array([2.0**i for i in range(octaves)])
    xb = np.reshape(x[..., None, :] * scales[:, None], [*x.shape[:-1], -1])
    return np.concatenate([x, np.sin(np.concatenate([xb, xb + 0.5 * np.pi], -1))], -1)


def tensorf(x: NDArray[np.float64], octaves: int) -> NDArray[np.float64]:
    """TensoRF's program: positional_encoding, after the input itself."""
    bands = 2.0 ** np.arange(octaves)
    points = (x[..., None] * bands).reshape(*x.shape[:-1], octaves * x.shape[-1])
    return np.concatenate([x, np.sin(points), np.cos(points)], -1)


PROGRAMS = {"octave": original_nerf, "sines_first": jaxnerf, "coordinate": tensorf}


@given(st.sampled_from(ORDERS), st.integers(1, 4), st.integers(0, 6), st.integers(0, 1000))
def test_orders_are_those_of_the_programs(order: Order, dimensions: int, octaves: int, seed: int) -> None:
    x = np.random.default_rng(seed).uniform(-1, 1, (3, 5, dimensions))
    found = gridreg.positional_encoding(torch.tensor(x), octaves, order).numpy()
    np.testing.assert_allclose(found, PROGRAMS[order](x, octaves), atol=1e-12)


@given(st.sampled_from(ORDERS), st.integers(1, 4), st.integers(1, 6), st.booleans())
def test_every_channel_has_the_octave_it_says(order: Order, dimensions: int, octaves: int, own: bool) -> None:
    """A channel of octave k repeats when the input moves by 2 pi / 2^k, and by no less."""
    said = gridreg.octaves_of_channels(dimensions, octaves, order, own)
    x = torch.linspace(0.1, 0.7, dimensions, dtype=torch.float64)
    base = gridreg.positional_encoding(x, octaves, order, own)
    assert len(said) == len(base) == dimensions * (2 * octaves + own)
    for k in range(octaves):
        moved = gridreg.positional_encoding(x + 2 * math.pi / 2**k, octaves, order, own)
        repeats = (moved - base).abs() < 1e-9
        assert repeats.tolist() == [octave >= k for octave in said]
    assert said.count(-1) == (dimensions if own else 0)


@pytest.mark.parametrize("order", ORDERS)
def test_the_input_may_come_last(order: Order) -> None:
    x = torch.rand(5, 3)
    found = gridreg.positional_encoding(x, 2, order, include_input="last")
    assert torch.equal(found[:, -3:], x)
    assert torch.equal(found[:, :-3], gridreg.positional_encoding(x, 2, order, include_input=False))
    said = gridreg.octaves_of_channels(3, 2, order, "last")
    assert said == (*gridreg.octaves_of_channels(3, 2, order, False), -1, -1, -1)
    module = gridreg.PositionalEncoding(3, 2, order, include_input="last")
    assert module.channel_octaves == said
    assert torch.equal(module(x), found)
    with pytest.raises(gridreg.InputError, match="include_input='first': expected True, False or 'last'"):
        gridreg.positional_encoding(x, 2, order, include_input="first")  # type: ignore[arg-type]


def test_the_orders_hold_the_same_channels() -> None:
    x = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    first, *others = (gridreg.positional_encoding(x, 4, order).sort(-1).values for order in ORDERS)
    assert all(torch.allclose(first, other) for other in others)


def test_scale_multiplies_the_frequencies() -> None:
    x = torch.tensor([[0.25]])
    found = gridreg.positional_encoding(x, 2, include_input=False, scale=math.pi)
    expected = [math.sin(math.pi / 4), math.cos(math.pi / 4), 1.0, 0.0]
    assert torch.allclose(found, torch.tensor([expected]), atol=1e-6)


def test_gradients_in_float64() -> None:
    x = torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    for order in ORDERS:
        assert torch.autograd.gradcheck(lambda v, o=order: gridreg.positional_encoding(v, 3, o), (x,))


@pytest.mark.parametrize("order", ORDERS)
def test_a_mask_on_the_module_finds_its_octaves(order: Order) -> None:
    encoding = gridreg.PositionalEncoding(3, 4, order)
    field = nn.Sequential(encoding, nn.Identity())
    x = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    bare = field(x)
    octaves = torch.tensor(encoding.channel_octaves)
    with gridreg.apply(
        field, gridreg.FrequencyMask(gridreg.outputs("0"), until=80), total_steps=100
    ) as handle:
        assert torch.equal(field(x), bare * (octaves < 0))
        handle.step(40)
        assert torch.equal(field(x), bare * torch.tensor([1, 1, 1, 0.5, 0])[octaves + 1])
    assert torch.equal(field(x), bare)


def test_module_equals_function_and_tells_its_size() -> None:
    encoding = gridreg.PositionalEncoding(3, octaves=2, order="coordinate", include_input=False, scale=2.0)
    x = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(encoding(x), gridreg.positional_encoding(x, 2, "coordinate", False, 2.0))
    assert encoding.channels == encoding(x).shape[-1] == len(encoding.channel_octaves)
    assert "octaves=2, order='coordinate', channels=12" in repr(encoding)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [((torch.zeros(3), 2, "random"), "order='random'"), ((torch.zeros(3), -1), "octaves=-1")],
)
def test_bad_arguments_are_named(arguments: tuple[Any, ...], text: str) -> None:
    with pytest.raises(gridreg.InputError, match=text):
        gridreg.positional_encoding(*arguments)
