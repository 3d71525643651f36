"""What there is to choose, by name: listed, shown one by one, and named in the help of ``train``."""

from __future__ import annotations

import pytest
import yaml

import gridreg
from gridreg.base import REGISTRY
from gridreg.cli import main
from gridreg.fields import field_names
from gridreg.scenes.protocols import COUNTED, PROTOCOLS, get_protocol
from gridreg.training import RunConfig, preset_names
from gridreg.training.presets import load_preset, preset_text
from gridreg.training.typed_data import from_data
from tests.inventory import inventory

KNOWN = {
    "presets": preset_names(),
    "compositions": gridreg.composition_names(),
    "protocols": [*PROTOCOLS, *COUNTED],
    "regularizers": sorted(REGISTRY),
    "config": sorted(inventory()["configuration"]),
}


@pytest.mark.parametrize("kind", KNOWN)
def test_lists_everything_with_a_line_each(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", kind]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.split()[0] for line in lines) == sorted(KNOWN[kind])
    assert all(len(line.split()) > 1 and len(line) < 160 for line in lines)


@pytest.mark.parametrize("kind", KNOWN)
def test_shows_each(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in KNOWN[kind]:
        assert main(["show", kind, name]) == 0
        assert len(capsys.readouterr().out) > len(name) + 10


@pytest.mark.parametrize("kind", KNOWN)
def test_an_unknown_name_is_one_line_with_what_there_is(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", kind, "nonsense"]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "found 'nonsense', expected one of" in text


def test_a_preset_is_its_file_and_its_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "presets", "quick"]) == 0
    written = capsys.readouterr().out
    assert written.startswith("# Few TensoRF in minutes.")
    assert main(["show", "config", "quick"]) == 0
    whole = yaml.safe_load(capsys.readouterr().out)
    assert set(whole["train"]) >= {"steps", "weight_bound"}
    assert from_data(RunConfig, whole) == load_preset("quick")


def test_a_composition_is_yaml_that_a_configuration_takes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["show", "compositions", "few_tensorf"]) == 0
    assert gridreg.from_config(yaml.safe_load(capsys.readouterr().out)) == gridreg.composition("few_tensorf")


def test_counted_protocols_and_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "protocols", "views5-validation"]) == 0
    text = capsys.readouterr().out
    assert str(get_protocol("views5").train) in text
    assert "training frames that are not trained on" in text
    assert main(["show", "config", "train.steps"]) == 0
    assert capsys.readouterr().out == "train.steps: 15000\n  iterations.\n"


def test_the_help_of_train_names_what_there_is_to_choose(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    words = set(" ".join(capsys.readouterr().out.split()).replace(",", " ").replace(";", " ").split())
    forms = [form for form in COUNTED if "ninit" not in form and form[:4] != "NAME"]
    for name in (*preset_names(), *gridreg.composition_names(), *PROTOCOLS, *forms):
        assert name in words, name
    assert {"vm", "cp", "mlp"} == set(field_names()) & {"vm", "cp", "mlp"} <= words


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_says_what_it_is(name: str) -> None:
    assert preset_text(name).startswith("# ")
