"""Compositions to plain data and back, strict keys, and the named compositions."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

import gridreg
from gridreg.attach.selectors import Selector
from gridreg.attach.sites import Site
from gridreg.base import REGISTRY, Regularizer
from gridreg.schedules import Schedule
from tests.fields import made

SMALL = st.floats(0.01, 0.9)
SCHEDULES = st.one_of(
    st.builds(gridreg.Linear, SMALL, SMALL, st.one_of(SMALL, st.integers(1, 900))),
    st.builds(gridreg.Cosine, SMALL, SMALL, SMALL),
    st.builds(gridreg.Geometric, SMALL, SMALL, st.integers(1, 900)),
    st.builds(gridreg.Piecewise, st.tuples(SMALL, SMALL), st.tuples(SMALL)),
)
CHANNELS = st.one_of(
    st.none(),
    st.builds(slice, st.integers(0, 3), st.one_of(st.none(), st.integers(4, 9))),
    st.lists(st.integers(0, 20), min_size=1, max_size=5, unique=True),
)
OCTAVES = st.one_of(st.none(), st.lists(st.integers(-1, 9), min_size=1, max_size=5))
SELECTORS = st.one_of(
    st.builds(gridreg.parameters, st.just("a.*"), st.integers(-2, 3), channels=CHANNELS, octaves=OCTAVES),
    st.builds(gridreg.parameters, st.just("a.*"), st.just(1), spatial=st.just((2, 3))),
    st.builds(gridreg.outputs, st.just("b"), channels=CHANNELS, item=st.one_of(st.none(), st.just("rgb"))),
    st.builds(gridreg.inputs, st.just("c.0"), octaves=OCTAVES, item=st.one_of(st.none(), st.just(1))),
)
SITES = st.one_of(
    st.sampled_from(["density", "encoding.position"]),
    SELECTORS,
    st.builds(Site, st.lists(SELECTORS, max_size=2), st.lists(SELECTORS, max_size=2)),
)


@st.composite
def regularizers(draw: st.DrawFn) -> Regularizer:
    """Any example of any registered class, at any site, with a schedule in the place of a number if it takes one."""
    cls = draw(st.sampled_from(list(REGISTRY.values())))
    example = draw(st.sampled_from(cls.examples(draw(SITES))))
    numeric = [f.name for f in fields(example) if "Numeric" in str(f.type)]
    for name in numeric:
        if draw(st.booleans()):
            try:
                example = replace(example, **{name: draw(SCHEDULES)})
            except gridreg.InputError:
                continue  # this class takes only plain numbers here
    return example


@given(st.lists(regularizers(), max_size=4))
def test_plain_data_survives_yaml_and_gives_equal_regularizers(composition: list[Regularizer]) -> None:
    config = gridreg.to_config(composition)
    assert is_plain(config)
    assert gridreg.from_config(config) == composition
    again = gridreg.from_config(yaml.safe_load(yaml.safe_dump(config)))
    assert again == composition
    assert gridreg.to_config(again) == config


def is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(map(is_plain, value))
    return value is None or type(value) in (str, int, float, bool)


@given(regularizers())
def test_arguments_at_their_defaults_may_be_left_out(regularizer: Regularizer) -> None:
    (config,) = gridreg.to_config([regularizer])
    defaults = {f.name: f.default for f in fields(regularizer) if f.default is not MISSING}
    short = {
        key: value
        for key, value in config.items()
        if key not in defaults or getattr(regularizer, key) != defaults[key]
    }
    assert gridreg.from_config([short]) == [regularizer]


def test_a_handle_gives_its_composition() -> None:
    composition = [gridreg.FixedMask(gridreg.inputs("mlp.0")), gridreg.OcclusionLoss(samples=5)]
    with gridreg.apply(made("tensorf"), *composition, total_steps=10) as handle:
        assert gridreg.from_config(gridreg.to_config(handle)) == composition


def test_a_config_written_by_hand() -> None:
    text = """
    - {name: FrequencyMask, site: density, until: 0.9}
    - name: FrequencyMask
      site: {inputs: decoder.0, channels: "30:150"}
      until: {schedule: Linear, start: 0.5, end: 1.0}
    - {name: FixedMask, site: {mask: {parameters: line.*, dim: 1}, grids: [{parameters: plane.*, dim: 1}]}}
    - {name: L1, site: density, weight: 8e-5}
    """
    assert gridreg.from_config(yaml.safe_load(text)) == [
        gridreg.FrequencyMask("density", until=0.9),
        gridreg.FrequencyMask(
            gridreg.inputs("decoder.0", channels=slice(30, 150)), until=gridreg.Linear(0.5, 1.0)
        ),
        gridreg.FixedMask(
            Site(gridreg.parameters("line.*", dim=1), grids=gridreg.parameters("plane.*", dim=1))
        ),
        gridreg.L1("density", weight=8e-5),  # YAML reads 8e-5 as text
    ]


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (
            [{"name": "FrequncyMask", "site": "a"}],
            "unknown regularizer 'FrequncyMask'; did you mean 'FrequencyMask'",
        ),
        (
            [{"name": "FixedMask", "site": "a", "ratio": 1}],
            "unknown argument 'ratio'.*valid: site, detach, visible",
        ),
        ([{"name": "FixedMask", "site": "a", "visible_ration": 1}], "did you mean 'visible_ratio'"),
        ([{"name": "FixedMask"}], "FixedMask: argument 'site' is missing"),
        ([{"site": "a"}], "expected a mapping with the regularizer's name"),
        (["FixedMask"], "expected a mapping"),
        ([{"name": 3}], "unknown regularizer '3'"),
        ({"name": "FixedMask"}, "expected a list"),
        ("few_tensorf", "expected a list"),
        (
            [{"name": "FixedMask", "site": {"paramters": "a", "dim": 1}}],
            r"FixedMask\.site: found .*parameters",
        ),
        (
            [{"name": "FixedMask", "site": {"parameters": "a", "dims": 1}}],
            "unknown key 'dims'; did you mean 'dim'",
        ),
        ([{"name": "FixedMask", "site": {"parameters": "a"}}], r"FixedMask\.site: .*dim"),
        (
            [{"name": "FixedMask", "site": {"mask": [], "grid": []}}],
            "unknown key 'grid'; did you mean 'grids'",
        ),
        ([{"name": "FixedMask", "site": {"mask": ["a"]}}], r"FixedMask\.site: found 'a'"),
        ([{"name": "FixedMask", "site": "a", "visible_ratio": 2}], "FixedMask: visible_ratio=2"),
        ([{"name": "FixedMask", "site": "a", "visible_ratio": "much"}], "FixedMask: visible_ratio='much'"),
        (
            [{"name": "L1", "site": "a", "weight": {"schedule": "Linar"}}],
            "unknown schedule 'Linar'; did you mean",
        ),
        (
            [{"name": "L1", "site": "a", "weight": {"schedule": "Linear", "start": 1}}],
            "Linear: argument 'end'",
        ),
        ([{"name": "L1", "site": "a", "weight": {"schedule": "Linear", "stat": 1}}], "did you mean 'start'"),
        ([{"name": "FrequencyMask", "site": "a", "block": "x"}], "FrequencyMask: .*block"),
    ],
)
def test_what_is_unknown_is_refused_by_name(config: Any, text: str) -> None:
    with pytest.raises(gridreg.InputError, match=text) as caught:
        gridreg.from_config(config)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Unregistered(Regularizer):
    """Not in the registry."""


class Private(Schedule):
    """Not in the registry."""

    def at(self, step: int, total_steps: int) -> float:
        return 0.5


@pytest.mark.parametrize(
    ("regularizer", "text"),
    [
        (
            gridreg.L1("a", weight=lambda step: 1.0),
            r"L1\.weight=<function.*use a schedule, such as gridreg\.Linear",
        ),
        (gridreg.L1("a", weight=Private()), "not registered; put @gridreg.register_schedule"),
        (Unregistered(), "Unregistered: not registered; put @gridreg.register"),
    ],
)
def test_what_has_no_plain_form_is_named(regularizer: Regularizer, text: str) -> None:
    with pytest.raises(gridreg.InputError, match=text):
        gridreg.to_config([regularizer])


# --- named compositions ------------------------------------------------------------------------


@pytest.mark.parametrize("name", gridreg.composition_names())
def test_named_compositions_are_fresh_plain_and_complete(name: str) -> None:
    first, second = gridreg.composition(name), gridreg.composition(name)
    assert first == second
    assert first is not second
    assert (len(first) == 0) == (name == "none")
    assert gridreg.from_config(gridreg.to_config(first)) == first


def test_few_tensorf_has_the_settings_of_its_paper() -> None:
    few = gridreg.composition("few_tensorf")
    masks = [r for r in few if isinstance(r, gridreg.FrequencyMask)]
    assert [mask.site for mask in masks] == [
        "density",
        "appearance",
        "encoding.features",
        "encoding.direction",
        "encoding.position",
    ]
    assert all(mask.until == 1.0 and mask.variant == "block" for mask in masks)
    assert gridreg.OcclusionLoss(weight=0.01, samples=20) in few
    assert gridreg.composition("tensorf") == [
        gridreg.L1("density", gridreg.Piecewise((8e-5, 4e-5), (2 / 15,)))
    ]
    assert {r.weight for r in few if isinstance(r, gridreg.Orthogonality)} == {0.01}
    # TensoRF's factors of 2 and 0.01 on a weight of 0.01, on planes alone.
    assert {(r.site, r.weight) for r in few if isinstance(r, gridreg.TotalVariation)} == {
        ("density.planes", 2e-4),
        ("appearance.planes", 2e-4),
    }
    authors = gridreg.composition("few_tensorf_authors")
    masks = [r for r in authors if isinstance(r, gridreg.FrequencyMask)]
    assert {"density.planes", "density.lines"} <= {mask.site for mask in masks}
    assert {mask.variant for mask in masks} == {"authors"}
    assert not any(isinstance(r, gridreg.OcclusionLoss) for r in authors)


def test_the_printed_variant_differs_in_its_masks_alone() -> None:
    few, printed = gridreg.composition("few_tensorf"), gridreg.composition("few_tensorf_printed")
    changed = [(a, b) for a, b in zip(few, printed, strict=True) if a != b]
    assert [type(a) for a, _ in changed] == [gridreg.FrequencyMask] * 5
    assert all(b == replace(a, variant="printed") for a, b in changed)


def test_the_fixed_variant_keeps_the_same_share_open_on_the_same_sites() -> None:
    few, fixed = gridreg.composition("few_tensorf"), gridreg.composition("few_tensorf_fixed")
    changed = [(a, b) for a, b in zip(few, fixed, strict=True) if a != b]
    assert [b for _, b in changed] == [gridreg.FixedMask(a.site, visible_ratio=0.8) for a, _ in changed]
    assert len(changed) == 5


@pytest.mark.parametrize(("old", "new"), gridreg.errors.RENAMED.items())
def test_a_name_that_went_is_refused_with_the_one_that_took_its_place(old: str, new: str) -> None:
    assert issubclass(getattr(gridreg, new), Regularizer)
    with pytest.raises(gridreg.InputError, match=f"gridreg.{old}: it is called gridreg.{new} now"):
        getattr(gridreg, old)
    with pytest.raises(gridreg.InputError, match=f"unknown regularizer '{old}'; it is called '{new}' now"):
        gridreg.from_config([{"name": old}])


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(gridreg, "Nothing")


def test_the_fine_tuned_row_is_no_composition_of_its_own() -> None:
    with pytest.raises(gridreg.InputError, match=r"as published it is 'few_tensorf'.*preset of this name"):
        gridreg.composition("few_tensorf_finetuned")


class Undecided(nn.Module):
    """A field whose decoder has no encoding of positions."""

    def __init__(self) -> None:
        super().__init__()
        self.line = nn.Parameter(torch.ones(1, 6, 5, 1))

    def sites(self) -> dict[str, gridreg.Site]:
        return {"density": gridreg.Site(gridreg.parameters("line", dim=1))}


def test_what_acts_on_a_missing_site_may_be_skipped() -> None:
    field = Undecided()
    with pytest.raises(gridreg.InputError, match="declares no site of this name"):
        gridreg.apply(field, *gridreg.composition("few_tensorf"), total_steps=10)
    handle = gridreg.apply(field, *gridreg.composition("few_tensorf", missing="skip"), total_steps=10)
    kept = [(type(r).__name__, getattr(r, "site", None)) for r in handle.regularizers]
    assert kept == [
        ("FrequencyMask", "density"),
        ("OcclusionLoss", None),
        ("L1", "density"),
        ("Orthogonality", "density"),
    ]
    rows = [row.split()[:2] for row in str(handle).splitlines() if "skipped: no such site" in row]
    sites = [[type(r).__name__, r.site] for r in gridreg.composition("few_tensorf") if hasattr(r, "site")]
    assert rows == [row for row in sites if row[1] != "density"]
    assert len(rows) == 7
    assert handle._repr_html_().count("skipped: no such site") == 7
    (plain,) = gridreg.to_config([gridreg.FixedMask("density?")])
    assert plain["site"] == "density?"
    with pytest.raises(gridreg.InputError, match="Linear declares none of the sites density, appearance"):
        gridreg.apply(nn.Linear(1, 1), *gridreg.composition("few_tensorf", missing="skip"), total_steps=10)
    with pytest.raises(gridreg.InputError, match="missing='drop': expected 'refuse' or 'skip'"):
        gridreg.composition("few_tensorf", missing="drop")  # type: ignore[arg-type]


def test_rivals_are_there() -> None:
    assert {"tensorf", "few_tensorf", "freenerf", "fourierf", "sanerf"} <= set(gridreg.composition_names())
    kinds = {
        name: {type(r).__name__ for r in gridreg.composition(name)} for name in gridreg.composition_names()
    }
    assert kinds["freenerf"] == {"FrequencyMask", "OcclusionLoss"}
    assert {"FourierLowPass", "WeightDecay"} <= kinds["fourierf"]
    assert {"GridBlur", "ViewDependenceMask"} <= kinds["sanerf"]


def test_an_unknown_composition_is_refused_and_a_new_one_can_be_registered() -> None:
    from gridreg.compositions import named as compositions

    with pytest.raises(gridreg.InputError, match=r"composition='fourier'.*did you mean 'fourierf'"):
        gridreg.composition("fourier")
    gridreg.register_composition("mine", lambda: [gridreg.FixedMask("density")])
    try:
        assert gridreg.composition("mine") == [gridreg.FixedMask("density")]
        assert "mine" in gridreg.composition_names()
    finally:
        del compositions._COMPOSITIONS["mine"]


def test_selectors_in_plain_data_show_only_what_was_said() -> None:
    (config,) = gridreg.to_config([gridreg.FixedMask(gridreg.inputs("mlp.0", channels=slice(3, 9)))])
    assert config["site"] == {"inputs": "mlp.0", "dim": -1, "channels": "3:9"}
    (regularizer,) = gridreg.from_config([config])
    assert isinstance(regularizer.site, Selector)  # type: ignore[attr-defined]
