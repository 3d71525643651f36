"""Masks against versions written from the papers, and what each mask regularizer does with ranks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import gridreg
from gridreg.attach.sites import Place
from gridreg.base import Clock, Context
from gridreg.regularizers.mask_functions import channel_ranks, level_mask, spherical_bands

COUNTS = st.integers(1, 40)
TOTALS = st.integers(1, 500)
STEPS = st.integers(0, 600)


def block_mask(channels: int, t: int, end: int, block: int, tail: int) -> NDArray[np.float64]:
    """FreeNeRF's program, get_freq_reg_mask, without its clipping."""
    mask = np.zeros(channels)
    if t >= end:
        return np.ones(channels)
    pointer = min(channels / block * t / end + 1, channels / block)
    whole = int(pointer)
    mask[: block * whole] = 1
    mask[block * whole : block * whole + tail] = pointer - whole
    return mask


@given(COUNTS, STEPS, TOTALS, st.integers(1, 6))
def test_frequency_mask_is_the_published_program(channels: int, step: int, total: int, block: int) -> None:
    found = gridreg.frequency_mask(channels, step, total, block=block).numpy()
    expected = block_mask(channels, step, total, block, block)
    # At a whole p, rounding may put 1e-16 on either side of the step from one block to the next.
    np.testing.assert_allclose(found, expected, atol=1e-6)


@given(COUNTS, STEPS, TOTALS, st.integers(1, 6))
def test_frequency_mask_keeps_the_laws(channels: int, step: int, total: int, block: int) -> None:
    mask = gridreg.frequency_mask(channels, step, total, block=block)
    later = gridreg.frequency_mask(channels, step + 1, total, block=block)
    assert mask.dtype == torch.float32
    assert mask.shape == (channels,)
    assert mask.min() >= 0
    assert mask.max() <= 1
    assert (mask.diff() <= 0).all()
    assert (later >= mask).all()
    assert (gridreg.frequency_mask(channels, total, total, block=block) == 1).all()
    if block <= channels:
        assert (gridreg.frequency_mask(channels, 0, total, block=block)[:block] == 1).all()
    fading = mask[(mask > 0) & (mask < 1)]
    assert len(fading) <= block
    assert len(fading) == 0 or (fading == fading[0]).all()


def test_frequency_mask_zeros_and_ones_are_exact() -> None:
    for step in range(0, 91, 10):
        mask = gridreg.frequency_mask(27, step, 90, block=3)
        opened = 3 + 3 * step // 10
        assert mask[:opened].tolist() == [1.0] * min(opened, 27)
        assert mask[opened:].tolist() == [0.0] * max(0, 27 - opened)


@given(COUNTS, STEPS, TOTALS, st.sampled_from([(5, 3), (4, 4), (3, 1)]))
def test_authors_mask(channels: int, step: int, total: int, shape: tuple[int, int]) -> None:
    found = gridreg.authors_frequency_mask(channels, step, total, block=shape[0], tail=shape[1]).numpy()
    np.testing.assert_allclose(found, block_mask(channels, step, total, *shape), atol=1e-6)


@given(COUNTS, st.integers(0, 499), TOTALS)
def test_printed_mask_is_the_equation(channels: int, step: int, total: int) -> None:
    found = gridreg.printed_frequency_mask(channels, step, total)
    if step >= total:
        assert (found == 1).all()
        return
    a = step * channels / total
    expected = [1.0 if i <= a + 3 else a - np.floor(a) if i <= a + 6 else 0.0 for i in range(1, channels + 1)]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_the_printed_equation_closes_channels_again() -> None:
    channels, total = 16, 1600
    masks = torch.stack([gridreg.printed_frequency_mask(channels, step, total) for step in range(total)])
    drops = masks[:-1] - masks[1:]
    assert drops.max() > 0.98  # from almost 1 to 0, between two steps
    assert len((drops.max(1).values > 0.98).nonzero()) >= channels - 5
    ours = torch.stack([gridreg.frequency_mask(channels, step, total) for step in range(total)])
    assert (ours[1:] >= ours[:-1]).all()


@given(COUNTS, STEPS, TOTALS)
def test_cosine_mask_is_barfs_window(octaves: int, step: int, total: int) -> None:
    alpha = octaves * min(step / total, 1)
    k = np.arange(octaves)
    expected = np.where(alpha < k, 0, np.where(alpha - k < 1, (1 - np.cos((alpha - k) * np.pi)) / 2, 1))
    np.testing.assert_allclose(gridreg.cosine_mask(octaves, step, total).numpy(), expected, atol=1e-6)


@given(COUNTS, st.floats(0, 1))
def test_fixed_mask(channels: int, ratio: float) -> None:
    visible = int(channels * ratio)
    assert gridreg.fixed_mask(channels, ratio).tolist() == [1.0] * visible + [0.0] * (channels - visible)


@given(COUNTS, STEPS, st.integers(1, 50), st.integers(1, 50), st.integers(0, 100))
def test_level_mask(levels: int, step: int, every: int, start: int, begin: int) -> None:
    opened = start + max(0, (step - begin) // every)
    expected = [float(level < opened) for level in range(levels)]
    assert level_mask(levels, step, start=start, begin=begin, every=every).tolist() == expected


def test_ranks_and_bands() -> None:
    assert channel_ranks((5, -1, 5, 2)) == (2, 0, 2, 1)
    assert spherical_bands(16) == (0, *[1] * 3, *[2] * 5, *[3] * 7)
    assert spherical_bands(18, 9) == (0, 1, 1, 1, 2, 2, 2, 2, 2) * 2


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: gridreg.frequency_mask(0, 0, 10), "channels=0"),
        (lambda: gridreg.frequency_mask(8, 0, 10, block=0), "block=0"),
        (lambda: gridreg.frequency_mask(8, 0, 0), "total_steps=0"),
        (lambda: gridreg.frequency_mask(8, 0, -5), "total_steps=-5"),
        (lambda: gridreg.frequency_mask(8, 0, float("nan")), "total_steps=nan"),
        (lambda: gridreg.frequency_mask(8, float("nan"), 10), "step=nan"),
        (lambda: gridreg.frequency_mask(8, -1, 10), "step=-1"),
        (lambda: gridreg.frequency_mask(2.5, 0, 10), "channels=2.5"),  # type: ignore[arg-type]
        (lambda: gridreg.authors_frequency_mask(8, 0, 10, tail=0), "tail=0"),
        (lambda: gridreg.printed_frequency_mask(8, 0, 0), "total_steps=0"),
        (lambda: gridreg.cosine_mask(0, 0, 10), "octaves=0"),
        (lambda: gridreg.cosine_mask(4, 0, float("inf")), "total_steps=inf"),
        (lambda: gridreg.fixed_mask(8, 1.5), "visible_ratio=1.5"),
        (lambda: gridreg.fixed_mask(8, float("nan")), "visible_ratio=nan"),
        (lambda: level_mask(4, 0, every=0), "every=0"),
        (lambda: gridreg.component_dropout(4, 1.0, torch.Generator()), "p=1.0"),
    ],
)
def test_bad_arguments_are_named(call: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text.replace(".", r"\.") + ".*expected"):
        call()


def context_at(step: int, channels: int, octaves: tuple[int, ...] | None = None, total: int = 100) -> Context:
    clock = Clock(total, seed=0)
    clock.step = step
    place = Place("grid", gridreg.outputs("grid", octaves=octaves), -1, octaves=octaves)
    place.complete(channels)
    return Context(clock, place)


def test_frequency_mask_opens_whole_octaves_in_any_order() -> None:
    for order in ("octave", "sines_first", "coordinate"):
        octaves = gridreg.octaves_of_channels(3, 4, order)
        mask = gridreg.FrequencyMask("x", until=80).mask(context_at(20, 27, octaves))
        by_octave = {
            o: {m for m, c in zip(mask.tolist(), octaves, strict=True) if c == o} for o in range(-1, 4)
        }
        assert by_octave == {-1: {1.0}, 0: {1.0}, 1: {0.25}, 2: {0.0}, 3: {0.0}}


@pytest.mark.parametrize(("channels", "block"), [(1, 3), (2, 3), (3, 3), (16, 3)])
def test_frequency_mask_has_a_block_open_even_on_few_channels(channels: int, block: int) -> None:
    mask = gridreg.FrequencyMask("x").mask(context_at(0, channels))
    assert mask[: min(block, channels)].tolist() == [1.0] * min(block, channels)


def test_frequency_mask_equals_the_function_at_its_end_step() -> None:
    mask = gridreg.FrequencyMask("x", until=0.9).mask(context_at(33, 16))
    assert torch.equal(mask, gridreg.frequency_mask(16, 33, 90))
    mask = gridreg.FrequencyMask("x", until=70, block=4).mask(context_at(33, 16))
    assert torch.equal(mask, gridreg.frequency_mask(16, 33, 70, block=4))


def test_variants_go_by_channel_index_as_their_programs_do() -> None:
    octaves = gridreg.octaves_of_channels(3, 4, "coordinate")
    context = context_at(20, 27, octaves)
    printed = gridreg.FrequencyMask("x", until=80, variant="printed").mask(context)
    authors = gridreg.FrequencyMask("x", until=80, variant="authors").mask(context)
    assert torch.equal(printed, gridreg.printed_frequency_mask(27, 20, 80))
    assert torch.equal(authors, gridreg.authors_frequency_mask(27, 20, 80))


def test_cosine_mask_is_barfs_window_with_the_identity_beside_it() -> None:
    with_identity = gridreg.CosineMask("x", until=80).mask(context_at(20, 9, (-1, 0, 1, 2, 3, 0, 1, 2, 3)))
    assert torch.equal(with_identity[1:5], gridreg.cosine_mask(4, 20, 80))
    assert with_identity[0] == 1
    without = gridreg.CosineMask("x", until=80).mask(context_at(0, 3, (0, 1, 2)))
    assert without.tolist() == [0.0, 0.0, 0.0]
    half = gridreg.CosineMask("x", until=80).mask(context_at(30, 4, (0, 1, 2, 3)))
    assert torch.equal(half, gridreg.cosine_mask(4, 30, 80))
    unknown = gridreg.CosineMask("x", until=80).mask(context_at(0, 3))
    assert unknown.tolist() == [1.0, 0.0, 0.0]
    assert gridreg.CosineMask("x").mask(context_at(0, 1)).tolist() == [1.0]


def test_level_mask_opens_groups_of_channels() -> None:
    mask = gridreg.LevelMask("x", start=1, every=10, begin=5, features=2)
    assert mask.mask(context_at(14, 8)).tolist() == [1.0] * 2 + [0.0] * 6
    assert mask.mask(context_at(15, 8)).tolist() == [1.0] * 4 + [0.0] * 4
    assert mask.end(4, 100) == 35
    with pytest.raises(gridreg.InputError, match="features=2: 7 channels"):
        mask.mask(context_at(0, 7))


def test_view_dependence_mask_drops_bands() -> None:
    two = gridreg.ViewDependenceMask("x", bands=2).mask(context_at(0, 9))
    assert two.tolist() == [1.0] * 4 + [0.0] * 5
    coloured = gridreg.ViewDependenceMask("x", bands=1, coefficients=4).mask(context_at(0, 12))
    assert coloured.tolist() == [1.0, 0.0, 0.0, 0.0] * 3
    none = gridreg.ViewDependenceMask("x", bands=0, until=0.5)
    assert none.mask(context_at(49, 9)).sum() == 0
    assert none.mask(context_at(50, 9)).sum() == 9
    opening = gridreg.ViewDependenceMask("x", bands=lambda step: step / 10)
    assert opening.mask(context_at(25, 9)).sum() == 4


def test_schedules_drive_every_numeric_argument() -> None:
    ratio = gridreg.FixedMask("x", visible_ratio=gridreg.Linear(0.0, 1.0))
    assert [int(ratio.mask(context_at(step, 10)).sum()) for step in (0, 50, 100)] == [0, 5, 10]
    until = gridreg.FrequencyMask("x", until=gridreg.Piecewise((1.0, 0.1), (50,)))
    assert until.mask(context_at(49, 12)).min() < 1
    assert until.mask(context_at(50, 12)).min() == 1
    assert until.end(12, 100) is None
    start = gridreg.LevelMask("x", start=gridreg.Linear(1, 3), every=0.5, features=1)
    assert start.mask(context_at(100, 8)).sum() == 5
    assert start.end(8, 100) is None


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: gridreg.FrequencyMask("x", until=0), "until=0"),
        (lambda: gridreg.FrequencyMask("x", until=float("nan")), "until=nan"),
        (lambda: gridreg.FrequencyMask("x", until="late"), "until='late'"),
        (lambda: gridreg.FrequencyMask("x", variant="best"), "variant='best'"),
        (lambda: gridreg.FrequencyMask("x", block=0), "block=0"),
        (lambda: gridreg.FrequencyMask(3), "site=3"),
        (lambda: gridreg.FixedMask("x", visible_ratio=2), "visible_ratio=2"),
        (lambda: gridreg.LevelMask("x", every=-1), "every=-1"),
        (lambda: gridreg.LevelMask("x", start=0), "start=0"),
        (lambda: gridreg.LevelMask("x", features=0), "features=0"),
        (lambda: gridreg.ViewDependenceMask("x", bands=-1), "bands=-1"),
        (lambda: gridreg.ViewDependenceMask("x", coefficients=0), "coefficients=0"),
        (lambda: gridreg.ComponentDropout("x", p=1.0), "p=1.0"),
        (lambda: gridreg.ComponentDropout(None), "site=None"),
    ],
)
def test_bad_settings_are_refused_at_once(make: Any, text: str) -> None:
    with pytest.raises(gridreg.InputError, match=text.replace(".", r"\.")):
        make()
