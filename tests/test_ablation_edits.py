"""Compositions as plain data: what selectors mean, and what edits do."""

from __future__ import annotations

import pytest

import gridreg
from gridreg.ablation.edits import (
    added,
    change_argument,
    known_composition,
    matches,
    normalised,
    parts_of,
    removed,
    replaced,
    title_of,
)
from gridreg.compositions.named import RETIRED
from gridreg.errors import InputError
from gridreg.training.presets import preset_names

FEW = known_composition("composition:few_tensorf")


def titles(plain):
    return [title_of(regularizer) for regularizer in plain]


def test_known_compositions_are_those_of_the_toolkit():
    for name in gridreg.composition_names():
        assert gridreg.from_config(known_composition(f"composition:{name}")) == gridreg.composition(name)


def test_no_name_means_a_composition_to_one_and_a_preset_to_another():
    for name in {*gridreg.composition_names(), *preset_names()} - {*RETIRED}:
        meanings = [
            known_composition(f"{kind}:{name}")
            for kind, names in (("composition", gridreg.composition_names()), ("preset", preset_names()))
            if name in names
        ]
        if all(meaning == meanings[0] for meaning in meanings):
            assert known_composition(name) == meanings[0]
        else:
            with pytest.raises(InputError, match=f"write composition:{name} or preset:{name}$"):
                known_composition(name)


def test_the_retired_composition_says_what_to_write():
    for name in ("few_tensorf_finetuned", "composition:few_tensorf_finetuned"):
        with pytest.raises(
            InputError, match=r"as published it is 'few_tensorf'.*preset:few_tensorf_finetuned"
        ):
            known_composition(name)
    assert "RandomBackground" in titles(known_composition("preset:few_tensorf_finetuned"))


def test_presets_hold_compositions_too():
    assert "RandomBackground" in titles(known_composition("quick"))


def test_an_unknown_composition_comes_with_the_near_one():
    with pytest.raises(InputError, match=r"'few_tensor'.*expected one of .*did you mean 'few_tensorf'\?"):
        known_composition("few_tensor")


def test_equal_compositions_are_equal_data():
    short = normalised([{"name": "L1", "site": "density"}, "RandomBackground"])
    long = normalised([{"site": "density", "weight": 8e-5, "name": "L1"}, {"name": "RandomBackground"}])
    assert short == long == normalised(short)


@pytest.mark.parametrize(
    ("selector", "count"),
    [
        ("FrequencyMask", 5),
        ("FrequencyMask density", 1),
        ("FrequencyMask encoding.*", 3),
        ({"name": "FrequencyMask", "site": "encoding.*"}, 3),
        ({"site": "density"}, 3),
        ("OcclusionLoss", 1),
        ("L1 appearance", 0),
    ],
)
def test_selectors(selector, count):
    assert sum(matches(regularizer, selector) for regularizer in FEW) == count


@pytest.mark.parametrize(
    ("selector", "message"),
    [
        ("FrequencMask", "unknown regularizer 'FrequencMask'; did you mean 'FrequencyMask'"),
        ({"nam": "L1"}, "nam: unknown key, did you mean name?"),
        ({}, "expected NAME"),
        (3, "expected NAME"),
    ],
)
def test_selectors_that_mean_nothing(selector, message):
    with pytest.raises(InputError, match=message):
        matches(FEW[0], selector)


def test_sites_written_out_have_titles():
    plain = normalised([{"name": "FixedMask", "site": {"outputs": "encoder.*", "dim": -1}}])
    assert titles(plain) == ["FixedMask encoder.*"]
    assert matches(plain[0], "FixedMask encoder.[*]")


def test_remove():
    assert titles(removed(FEW, ["FrequencyMask", "L1"])) == [
        "OcclusionLoss",
        "Orthogonality density",
        "Orthogonality appearance",
        "TotalVariation density.planes",
        "TotalVariation appearance.planes",
    ]
    assert len(removed(FEW, "TotalVariation density.planes")) == len(FEW) - 1


def test_removing_what_is_not_there_says_what_is():
    with pytest.raises(InputError, match=r"found 'WeightDecay'.*it has FrequencyMask density, "):
        removed(FEW, ["WeightDecay"])
    with pytest.raises(InputError, match="no regularizer at all"):
        removed([], ["L1"])


def test_replace_changes_arguments():
    plain = replaced(FEW, [{"name": "FrequencyMask", "site": "encoding.*", "with": {"until": 0.5}}])
    until = {title_of(r): r["until"] for r in plain if r["name"] == "FrequencyMask"}
    assert until.pop("FrequencyMask density") == until.pop("FrequencyMask appearance") == 1.0
    assert set(until.values()) == {0.5}


def test_replace_swaps_in_place():
    plain = replaced(FEW, {"name": "FrequencyMask", "site": "density", "with": {"name": "FixedMask"}})
    assert plain[0]["name"] == "FixedMask"
    assert plain[0]["site"] == "density"
    assert plain[1:] == FEW[1:]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("L1", "expected {name"),
        ({"name": "L1", "with": {"wait": 3}}, r"(?s)unknown argument 'wait'.*weight"),
        ({"name": "L1", "withs": {}, "with": {}}, "withs: unknown key; valid: name, site"),
        ({"name": "WeightDecay", "with": {"decay": 3}}, "which the composition does not have"),
    ],
)
def test_replacements_that_mean_nothing(entry, message):
    with pytest.raises(InputError, match=message):
        replaced(FEW, [entry])


def test_add():
    plain = added(FEW, ["RandomBackground", {"name": "WeightDecay", "site": "density", "decay": 0.1}])
    assert titles(plain[-2:]) == ["RandomBackground", "WeightDecay density"]
    with pytest.raises(InputError, match="expected a list"):
        added(FEW, 3)


def test_change_argument():
    plain = change_argument(FEW, "TotalVariation", "weight", 0.5)
    assert [r["weight"] for r in plain if r["name"] == "TotalVariation"] == [0.5, 0.5]
    with pytest.raises(InputError, match="unknown argument 'until'"):
        change_argument(FEW, "TotalVariation", "until", 0.5)


def test_edits_leave_what_they_got_alone():
    before = [dict(regularizer) for regularizer in FEW]
    removed(FEW, "L1")
    replaced(FEW, [{"name": "FrequencyMask", "with": {"until": 0.1}}])
    change_argument(FEW, "L1", "weight", 1.0)
    assert before == FEW


def test_parts_by_name_site_and_each():
    assert list(parts_of(FEW, None, "name")) == [
        "FrequencyMask",
        "OcclusionLoss",
        "L1",
        "Orthogonality",
        "TotalVariation",
    ]
    assert list(parts_of(FEW, None, "site"))[:2] == ["density", "appearance"]
    assert len(parts_of(FEW, None, "each")) == len(FEW)
    for by in ("name", "site", "each"):
        assert sum(len(part) for part in parts_of(FEW, None, by).values()) == len(FEW)
    with pytest.raises(InputError, match="by: found 'nam'"):
        parts_of(FEW, None, "nam")


def test_named_parts():
    parts = parts_of(FEW, {"masks": "FrequencyMask", "tv + l1": ["TotalVariation", "L1"]}, "name")
    assert {name: len(part) for name, part in parts.items()} == {"masks": 5, "tv + l1": 3}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "expected names of parts"),
        ({"a": "L1", "b": {"site": "density"}}, "L1 density is in 'a' and in 'b'"),
        ({"a": "WeightDecay"}, "parts: a: found 'WeightDecay'"),
    ],
)
def test_parts_that_mean_nothing(parts, message):
    with pytest.raises(InputError, match=message):
        parts_of(FEW, parts, "name")
