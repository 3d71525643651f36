"""Strict YAML and dataclasses: what is written is read back, and everything wrong is named with its line."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.errors import ConfigError, InputError
from gridreg.training import RunConfig, config
from gridreg.training.strict_yaml import dump_yaml, parse_yaml, read_yaml


@dataclass(frozen=True)
class Train:
    """A nested part with a check of its own."""

    steps: int = 100
    learning_rate: float = 0.02
    resample_at: tuple[int, ...] = (20, 40)
    carve: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ConfigError(("steps",), f"found {self.steps}, expected an integer of at least 1")
        if any(e > self.steps for e in self.resample_at):
            raise ConfigError(("resample_at",), f"found {max(self.resample_at)}, after the last step")


@dataclass(frozen=True)
class Run:
    """The kinds of field that a configuration has."""

    protocol: Literal["dietnerf8", "gs8"] = "dietnerf8"
    scene: str | None = None
    out: Path = Path("out")
    until: int | float = 0.9
    box: tuple[float, float] = (0.0, 1.0)
    options: dict[str, Any] = field(default_factory=dict)
    weights: dict[str, float] = field(default_factory=dict)
    composition: list[dict[str, Any]] = field(default_factory=list)
    train: Train = field(default_factory=Train)


@dataclass(frozen=True)
class Needy:
    """A field without a default."""

    needed: int


def write(folder: Path, text: str) -> Path:
    path = folder / "run.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def message(call: Any, *arguments: Any, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


finite = st.floats(allow_nan=False)
words = st.text(max_size=12)
plain = st.recursive(
    st.none() | st.booleans() | st.integers(1 - 2**63, 2**63 - 1) | finite | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)
runs = st.builds(
    Run,
    protocol=st.sampled_from(["dietnerf8", "gs8"]),
    scene=st.none() | words,
    out=words.map(lambda t: Path("o" + t.replace("/", "").replace("\0", ""))),
    until=st.integers(0, 10**6) | finite,
    box=st.tuples(finite, finite),
    options=st.dictionaries(words, plain, max_size=3),
    weights=st.dictionaries(words, finite, max_size=3),
    composition=st.lists(st.dictionaries(words, plain, max_size=3), max_size=3),
    train=st.builds(
        Train,
        steps=st.integers(50, 10**6),
        learning_rate=finite,
        resample_at=st.lists(st.integers(0, 50), max_size=4).map(tuple),
        carve=st.booleans(),
    ),
)


@settings(max_examples=80, deadline=None)
@given(run=runs)
def test_yaml_round_trip_is_exact(tmp_path_factory, run):
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    config.save_yaml(path, run, comment="written by a test\nin two lines")
    back = config.from_yaml(path, Run)
    assert back == run
    assert type(back.until) is type(run.until)
    assert config.from_data(Run, config.to_data(run)) == run


@settings(max_examples=100, deadline=None)
@given(value=st.text(max_size=15))
def test_text_stays_text_for_this_reader_and_for_plain_yaml(value):
    text = dump_yaml({"key": value})
    assert parse_yaml(text).data == {"key": value}
    assert yaml.safe_load(text) == {"key": value}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("8e-5", 8e-5),
        ("8E-5", 8e-5),
        ("+1e3", 1000.0),
        (".5", 0.5),
        ("1.", 1.0),
        ("1.0e-05", 1e-5),
        (".inf", math.inf),
        ("-.Inf", -math.inf),
        ("15_000", 15000),
        ("0x1f", 31),
        ("010", 10),
        ("12:30", "12:30"),
        ("off", "off"),
        ("no", "no"),
        ("2020-01-01", "2020-01-01"),
        ("1.2.3", "1.2.3"),
        ("e5", "e5"),
        ("~", None),
        ("", None),
        ("True", True),
        ("'8e-5'", "8e-5"),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text, value):
    got = parse_yaml(f"key: {text}").data["key"]
    assert got == value
    assert type(got) is type(value)


def test_nan_is_read_and_refused_where_a_number_is_expected(tmp_path):
    assert math.isnan(parse_yaml("key: .nan").data["key"])
    path = write(tmp_path, "train:\n  learning_rate: .nan\n")
    assert message(config.from_yaml, path, Run).endswith(
        "run.yaml:2: train.learning_rate: found nan, expected a number"
    )


def test_float_without_a_point_reaches_a_float_field(tmp_path):
    run = config.from_yaml(write(tmp_path, "train: {learning_rate: 8e-5}\nbox: [1, 2]\n"), Run)
    assert run.train.learning_rate == 8e-5
    assert run.box == (1.0, 2.0)
    assert [type(edge) for edge in run.box] == [float, float]


def test_a_union_keeps_integers_and_fractions_apart(tmp_path):
    assert type(config.from_yaml(write(tmp_path, "until: 1"), Run).until) is int
    assert type(config.from_yaml(write(tmp_path, "until: 1.0"), Run).until) is float


@pytest.mark.parametrize("text", ["", "# nothing\n", "{}", "---\n"])
def test_an_empty_file_gives_the_defaults(tmp_path, text):
    assert config.from_yaml(write(tmp_path, text), Run) == Run()


def test_a_file_over_a_preset(tmp_path):
    base = Run(
        protocol="gs8", options={"a": 1}, train=Train(steps=500, resample_at=(100,), learning_rate=0.5)
    )
    path = write(tmp_path, "options: {b: 2}\ntrain:\n  steps: 300\n")
    merged = config.from_yaml(path, Run, base=base)
    assert merged.protocol == "gs8"
    assert merged.options == {"b": 2}
    assert merged.train == Train(steps=300, resample_at=(100,), learning_rate=0.5)
    assert base.train.steps == 500


VALID = "valid: protocol, scene, out, until, box, options, weights, composition, train"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("scene: x\nprotcol: gs8", f"2: protcol: unknown key, did you mean protocol? {VALID}"),
        ("steps: 5", f"1: steps: unknown key, did you mean train.steps? {VALID}"),
        ("qqqq: 5", f"1: qqqq: unknown key; {VALID}"),
        (
            "train:\n  carve: true\n  step: 3",
            "3: train.step: unknown key, did you mean steps? valid: steps, learning_rate, resample_at, carve",
        ),
        ("train:\n  steps: many", "2: train.steps: found 'many', expected an integer"),
        ("train: {steps: 1e3}", "1: train.steps: found 1000.0, expected an integer"),
        ("train: {steps: true}", "1: train.steps: found true, expected an integer"),
        ("train: {carve: 1}", "1: train.carve: found 1, expected true or false"),
        ("train: {carve: yes}", "1: train.carve: found 'yes', expected true or false"),
        ("train: {learning_rate: fast}", "1: train.learning_rate: found 'fast', expected a number"),
        ("train: 5", "1: train: found 5, expected a mapping of keys to values"),
        (
            "train:\n  resample_at:\n    - 1\n    - x",
            "4: train.resample_at.1: found 'x', expected an integer",
        ),
        (
            "train: {resample_at: 5}",
            "1: train.resample_at: found 5, expected a list (each item an integer)",
        ),
        ("protocol: llff3", "1: protocol: found 'llff3', expected one of dietnerf8, gs8"),
        ("scene: 0525", "1: scene: found 525, expected text or null"),
        ("out: null", "1: out: found null, expected a path"),
        ("until: soon", "1: until: found 'soon', expected an integer or a number"),
        ("box: [1, 2, 3]", "1: box: found 3 items, expected 2"),
        ("box: {}", "1: box: found an empty mapping, expected a list of a number, a number"),
        ("weights: {a: b}", "1: weights.a: found 'b', expected a number"),
        ("weights: [1]", "1: weights: found a list of 1, expected a mapping of keys to values"),
        ("composition: {a: 1}", "expected a list (each item a mapping of keys to values)"),
        ("- 1\n- 2", "1: found a list of 2, expected a mapping of keys to values"),
        ("scene: a\ntrain:\n  carve: true\n  steps: 0", "4: train.steps: found 0, expected an integer of"),
        ("train:\n  steps: 30", "1: train.resample_at: found 40, after the last step"),
        ("scene: a\nscene: b", "2: scene: stands twice, first in line 1"),
        ("train: {steps: 1, steps: 2}", "1: train.steps: stands twice, first in line 1"),
        ("1: 2", "1: key 1: expected text (quote it if it is meant so)"),
        ("? [a]\n: 2", "1: key a list or mapping: expected text"),
        ("scene: [a", "1: not valid YAML: while parsing a flow sequence expected ',' or ']'"),
        ("a: 1\n---\nb: 2", "2: not valid YAML: expected a single document in the stream but found"),
        ("scene: &x a\nout: *x", "1: not valid YAML: anchors and aliases"),
        (
            "scene: !!python/object/apply:os.system [ls]",
            "1: not valid YAML: the tag tag:yaml.org,2002:python",
        ),
        ("scene: !mine x", "1: not valid YAML: the tag !mine is not supported"),
        ("train: {steps: " + "9" * 5000 + "}", "not valid YAML: Exceeds the limit"),
        ("scene: \x01", "not valid YAML: unacceptable character #x0001"),
        ("scene: " + "[" * 3000, "nested too deeply"),
    ],
)
def test_what_is_wrong_is_named_with_file_and_line(tmp_path, text, expected):
    path = write(tmp_path, text)
    got = message(config.from_yaml, path, Run)
    assert got.startswith(f"{path}:")
    assert expected in got


def test_a_missing_key(tmp_path):
    assert message(config.from_yaml, write(tmp_path, ""), Needy).endswith(
        "run.yaml: needed: missing, expected an integer"
    )


def test_files_that_cannot_be_read(tmp_path):
    assert "YAML file not found" in message(read_yaml, tmp_path / "none.yaml")
    assert "cannot be read" in message(read_yaml, tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"name: caf\xe9")
    assert "not UTF-8 text at byte 9" in message(read_yaml, tmp_path / "latin.yaml")


def test_long_values_are_shortened_in_errors():
    assert len(message(config.from_data, Run, {"until": "x" * 1000})) < 150


def test_override_changes_nested_values_and_leaves_the_rest():
    run = Run(options={"rank": 16, "decoder": "fea"}, composition=[{"type": "L1", "weight": 1}])
    changed = config.override(
        run,
        {
            "train.steps": "30",
            "train.resample_at": "[10, 20]",
            "train.learning_rate": "8e-5",
            "scene": "0525",
            "out": "1",
            "until": "0.5",
            "options.rank": "48",
            "weights.tv": 1,
            "composition.0.weight": "8e-5",
            "protocol": "gs8",
            "train.carve": True,
        },
    )
    assert changed == Run(
        protocol="gs8",
        scene="0525",
        out=Path("1"),
        until=0.5,
        options={"rank": 48, "decoder": "fea"},
        weights={"tv": 1.0},
        composition=[{"type": "L1", "weight": 8e-5}],
        train=Train(steps=30, resample_at=(10, 20), learning_rate=8e-5, carve=True),
    )
    assert run.options["rank"] == 16
    assert config.override(changed, {"scene": "null"}).scene is None
    assert config.override(Run(), {"out": "null"}).out == Path("null")
    assert config.override(Run(), {"scene": "a: b: c"}).scene == "a: b: c"


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("train.stepz", "5", "command line: train.stepz: unknown key, did you mean steps?"),
        ("nothing.at.all", "5", "command line: nothing: unknown key;"),
        ("train.steps", "many", "command line: train.steps: found 'many', expected an integer"),
        ("train.steps", "", "command line: train.steps: found '', expected an integer"),
        ("train.steps", "[1", "command line: train.steps: not valid YAML"),
        ("train.steps.more", "1", "command line: train.steps.more: there is nothing named 'more' inside 100"),
        ("composition.0", "1", "expected the number of an item below 0"),
        ("train", "5", "command line: train: found 5, expected a mapping"),
        ("train.steps", "0", "command line: train.steps: found 0, expected an integer of at least 1"),
    ],
)
def test_override_names_what_is_wrong(key, value, expected):
    assert expected in message(config.override, Run(), {key: value})


def test_assignments():
    assert config.assignments([]) == {}
    assert config.assignments(["a.b=1", "c="]) == {"a.b": "1", "c": ""}
    assert "expected KEY=VALUE" in message(config.assignments, ["a.b"])
    assert "expected KEY=VALUE" in message(config.assignments, ["=1"])
    assert "a: given twice" in message(config.assignments, ["a=1", "a=2"])


@dataclass(frozen=True)
class Unsupported:
    """A declared type that no configuration can hold."""

    value: set[int] = field(default_factory=set)


def test_what_is_not_plain_data_is_the_programmers_error():
    with pytest.raises(TypeError, match="not supported in a configuration"):
        config.from_data(Unsupported, {"value": [1]})
    with pytest.raises(TypeError, match="not plain data"):
        config.to_data(Unsupported())


def test_an_error_is_data_not_text(tmp_path):
    """Whoever places an error in a file reads its path, and it survives the way between processes."""
    with pytest.raises(ConfigError) as caught:
        config.from_yaml(write(tmp_path, "scene: a\ntrain:\n  steps: 0"), Run)
    error = pickle.loads(pickle.dumps(caught.value))
    assert (error.path, error.source) == (("train", "steps"), f"{tmp_path / 'run.yaml'}:3")
    assert str(error) == f"{error.source}: train.steps: {error.problem}"
    document = parse_yaml("set: {train.steps: 0}\nrows: [1,\n  2]", "study")
    assert document.where(("set", "train", "steps")) == "study:1"
    message = r"^study:3: rows\.1\.steps: found 0, expected an integer"
    with pytest.raises(ConfigError, match=message), document.locating("rows", 1):
        Train(steps=0)


@pytest.mark.parametrize("value", ["1" + "0" * 400, "0x" + "F" * 5000, "-99999999999999999999", ".nan"])
@pytest.mark.parametrize(
    "key", ["seed", "train.learning_rate_grid", "train.rays", "field.x", "composition.0.y"]
)
def test_numbers_that_nothing_can_hold(key, value):
    base = replace(RunConfig(), composition=[{"name": "L1"}])
    with pytest.raises(ConfigError, match=key) as caught:
        config.override(base, {key: value})
    assert len(str(caught.value)) < 200


def test_a_long_number_in_place_of_text():
    with pytest.raises(ConfigError, match="preset: found an integer of 20000 bits, expected text"):
        config.from_data(RunConfig, parse_yaml("preset: 0x" + "F" * 5000))


def test_messages_are_one_printable_line():
    text = str(InputError(f"scene \x1b[2J\u2028\udcff: {'a/' * 6000}: expected one\nline"))
    assert text.isprintable()
    assert len(text) <= 500
    assert text.startswith(r"scene \x1b[2J\u2028\udcff: a/a/")
    assert text.endswith("a/: expected one?line")
    assert str(InputError(text)) == text
