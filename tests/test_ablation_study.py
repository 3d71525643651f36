"""Studies as YAML: rows and their generators, scenes, view counts, and what is refused."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from gridreg.ablation.rows import expand_rows
from gridreg.ablation.study import load_study, study_from_text
from gridreg.errors import InputError
from gridreg.scenes import get_protocol
from gridreg.training import RunConfig, load_preset
from gridreg.training.typed_data import from_data
from tests.ablation_runs import tiny_study, write_study


def labels(entry):
    return [row.label for row in expand_rows(entry)]


def names(row):
    return [regularizer["name"] for regularizer in row.plain]


def test_a_name_is_a_row():
    (row,) = expand_rows("composition:few_tensorf")
    assert row.label == "few_tensorf"
    assert gridreg.from_config(row.plain) == gridreg.composition("few_tensorf")


def test_edits_make_the_label():
    entry = {
        "name": "composition:few_tensorf",
        "remove": ["L1", {"name": "FrequencyMask", "site": "encoding.*"}],
        "replace": [{"name": "OcclusionLoss", "with": {"weight": 0.1}}],
        "add": ["RandomBackground"],
    }
    (row,) = expand_rows(entry)
    assert row.label == "few_tensorf - L1 - FrequencyMask encoding.* ~ OcclusionLoss + RandomBackground"
    assert names(row).count("FrequencyMask") == 2
    assert names(row)[-1] == "RandomBackground"
    assert [r["weight"] for r in row.plain if r["name"] == "OcclusionLoss"] == [0.1]
    assert labels({**entry, "label": "mine"}) == ["mine"]


def test_written_out():
    (row,) = expand_rows(
        {"label": "mine", "regularizers": [{"name": "L1", "site": "density"}, "RandomBackground"]}
    )
    assert names(row) == ["L1", "RandomBackground"]
    with pytest.raises(InputError, match="label: missing"):
        expand_rows({"regularizers": ["RandomBackground"]})


def test_leave_one_out():
    rows = expand_rows({"leave_one_out": "quick"})
    whole = names(rows[0])
    assert [row.label for row in rows] == ["quick", *(f"quick - {name}" for name in dict.fromkeys(whole))]
    for row in rows[1:]:
        left_out = row.label.removeprefix("quick - ")
        assert names(row) == [name for name in whole if name != left_out]


def test_leave_one_out_of_each():
    rows = expand_rows({"leave_one_out": "tensorf", "by": "each", "label": "T"})
    assert [row.label for row in rows] == ["T", "T - L1 density"]
    assert rows[1].plain == []


def test_one_at_a_time():
    rows = expand_rows({"one_at_a_time": "freenerf"})
    assert [row.label for row in rows] == ["none", "none + FrequencyMask", "none + OcclusionLoss"]
    assert [len(row.plain) for row in rows] == [0, 2, 1]


def test_one_at_a_time_on_something():
    entry = {
        "one_at_a_time": "composition:few_tensorf",
        "on": {"name": "composition:few_tensorf", "remove": ["FrequencyMask"], "label": "bare"},
        "parts": {"density": "FrequencyMask density", "encodings": "FrequencyMask encoding.*"},
    }
    rows = expand_rows(entry)
    assert [row.label for row in rows] == ["bare", "bare + density", "bare + encodings"]
    assert [names(row).count("FrequencyMask") for row in rows] == [0, 1, 3]


def test_the_product_is_every_subset():
    rows = expand_rows({"product": "preset:few_tensorf"})
    assert len(rows) == 2**5
    assert len({row.label for row in rows}) == 2**5
    assert len({str(row.plain) for row in rows}) == 2**5
    assert rows[-1].plain == []
    whole = rows[0].plain
    # What is left stands in the order of the whole.
    assert all(row.plain == [r for r in whole if r in row.plain] for row in rows)


def test_a_product_too_large_is_refused():
    many = [{"name": "L1", "site": {"parameters": f"grid{i}", "dim": 0}} for i in range(13)]
    with pytest.raises(InputError, match="found 13 parts, expected at most 12"):
        expand_rows({"product": {"label": "x", "regularizers": many}, "by": "each"})


def test_sweep_of_an_argument():
    rows = expand_rows(
        {
            "sweep": "composition:few_tensorf",
            "change": "FrequencyMask",
            "argument": "until",
            "values": [0.5, 300],
        }
    )
    assert [row.label for row in rows] == ["few_tensorf, until=0.5", "few_tensorf, until=300"]
    assert [{r["until"] for r in row.plain if r["name"] == "FrequencyMask"} for row in rows] == [{0.5}, {300}]


def test_sweep_of_a_value():
    rows = expand_rows({"sweep": "none", "key": "train.rays", "values": [64, 128], "set": {"train.steps": 5}})
    assert [row.label for row in rows] == ["none, train.rays=64", "none, train.rays=128"]
    study = study_from_text(
        "compositions: [{sweep: none, key: train.rays, values: [64, 128], set: {train.steps: 5}}]"
    )
    assert [(r.config["train"]["rays"], r.config["train"]["steps"]) for r in study.runs] == [
        (64, 5),
        (128, 5),
    ]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (3, "expected the name of a composition or a mapping"),
        ("few_tensor", "unknown composition 'few_tensor'"),
        ({}, "expected exactly one of name"),
        ({"nam": "none"}, "nam: unknown key, did you mean name?"),
        ({"name": "none", "product": "none"}, "found name and product, expected exactly one"),
        ({"name": "none", "removed": ["L1"]}, "removed: unknown key, did you mean remove?"),
        ({"name": ["none"]}, "name: found"),
        ({"name": "none", "label": " "}, "label: found ' '"),
        ({"name": "none", "steps": 0}, "steps: found 0"),
        ({"name": "none", "steps": True}, "steps: found true"),
        ({"name": "none", "preset": 3}, "preset: found 3"),
        ({"name": "none", "set": [1]}, "set: found"),
        ({"name": "none", "values": [1]}, "values: found beside name, expected none but name, remove"),
        ({"name": "quick", "remove": [True]}, "remove.0: found true, expected text or a mapping"),
        (
            {"name": "quick", "replace": [{"name": {}, "with": {}}]},
            "name: found an empty mapping, expected text",
        ),
        (
            {"leave_one_out": {"name": "quick", "stps": 3}},
            r"leave_one_out\.stps: unknown key, did you mean steps",
        ),
        ({"leave_one_out": "none"}, "composition without regularizers"),
        ({"leave_one_out": "preset"}, "by its name"),
        ({"leave_one_out": {"product": "quick"}}, "found a generator"),
        ({"leave_one_out": "quick", "by": "name", "parts": {"a": "L1"}}, "found beside parts"),
        ({"one_at_a_time": "quick", "on": "nothing"}, "unknown composition 'nothing'"),
        ({"sweep": "quick", "values": []}, r"values: found \[\]"),
        ({"sweep": "quick", "values": [1]}, "either argument"),
        ({"sweep": "quick", "values": [1], "argument": "until"}, "change: missing"),
        ({"sweep": "quick", "values": [1], "argument": "until", "change": "WeightDecay"}, "does not have"),
    ],
)
def test_entries_that_mean_nothing(entry, message):
    with pytest.raises(InputError, match=message) as caught:
        expand_rows(entry)
    assert "\n" not in str(caught.value)


def test_runs_are_rows_by_scenes_by_protocols_by_seeds():
    study = study_from_text("compositions: [none, tensorf]\nseeds: [0, 7]\nviews: [3, 8]")
    assert len(study.runs) == len({run.hash for run in study.runs}) == 8
    assert [(r.label, r.views, r.seed) for r in study.runs[:4]] == [
        ("none", 3, 0),
        ("none", 3, 7),
        ("none", 8, 0),
        ("none", 8, 7),
    ]
    assert {r.protocol for r in study.runs} == {"first3", "first8"}
    assert study.baseline == "none"


def test_a_run_says_all_of_its_configuration():
    (run,) = study_from_text("compositions: [tensorf]\nseeds: [5]\nset: {train.rays: 77}\nsteps: 120").runs
    config = from_data(RunConfig, run.config)
    assert gridreg.from_config(config.composition) == gridreg.composition("tensorf")
    assert (config.seed, config.train.rays, config.train.steps, config.protocol) == (5, 77, 120, "builtin8")
    quick = load_preset("quick")
    # Events move in proportion: 120 of 1200 steps.
    assert config.train.resample_at == tuple(step // 10 for step in quick.train.resample_at)
    assert config.field == quick.field


def test_the_presets_own_composition():
    (run,) = study_from_text("compositions: [{name: preset, remove: [L1]}]\npresets: [quick]").runs
    held = [r["name"] for r in load_preset("quick").composition]
    assert [r["name"] for r in run.config["composition"]] == [name for name in held if name != "L1"]


def test_rows_are_told_apart_by_preset_and_backbone():
    study = study_from_text("compositions: [none]\npresets: [quick, cp_quick]\nbaseline: none")
    assert study.labels == ("none [quick]", "none [cp_quick]")
    assert study.baseline == "none [quick]"
    assert [r.backbone for r in study.runs] == ["vm", "cp"]
    study = study_from_text("compositions: [none]\nbackbones: [vm, cp]")
    assert study.labels == ("none [vm]", "none [cp]")
    assert study.runs[1].config["field"] != study.runs[0].config["field"]


def test_a_row_has_its_own_preset():
    study = study_from_text("compositions: [none, {name: freenerf, preset: freenerf_quick, steps: 9}]")
    assert [(r.label, r.preset, r.backbone) for r in study.runs] == [
        ("none", "quick", "vm"),
        ("freenerf", "freenerf_quick", "mlp"),
    ]
    assert study.runs[1].config["train"]["steps"] == 9


def test_rows_that_are_equal_are_one():
    study = study_from_text("compositions: [quick, {leave_one_out: quick}]")
    assert len(study.runs) == len(study.labels)


def test_rows_of_one_name_and_two_contents_are_refused():
    rows = "[{name: none, label: a}, {name: tensorf, label: a}]"
    with pytest.raises(InputError, match="two rows are called 'a'"):
        study_from_text(f"compositions: {rows}")


@pytest.mark.parametrize("count", [3, 4, 6, 8, 10, 50, 100])
def test_view_counts_of_real_scenes(tmp_path, count):
    (tmp_path / "lego").mkdir()
    text = f"compositions: [none]\nscenes: [lego]\ndata: {tmp_path}\nviews: [{count}]"
    (run,) = study_from_text(text).runs
    assert run.protocol == f"views{count}"
    assert run.views == count
    assert get_protocol(run.protocol).train.count == count


@pytest.mark.parametrize(
    ("protocol", "views"),
    [("dietnerf8", 8), ("zerorf4", 4), ("human50", 50), ("spread9", 9), ("holdout8", 0)],
)
def test_views_of_protocols(protocol, views):
    (run,) = study_from_text(f"compositions: [none]\nprotocols: [{protocol}]").runs
    assert run.views == views


def test_scenes_are_found(tmp_path, monkeypatch):
    for name in ("data/lego", "own/garden", "variable/chair"):
        (tmp_path / name).mkdir(parents=True)
    path = tmp_path / "study.yaml"
    path.write_text("compositions: [none]\ndata: data\nscenes: [lego, own/garden, builtin]")
    study = load_study(path)
    assert [r.scene for r in study.runs] == [
        str((tmp_path / "data/lego").resolve()),
        str((tmp_path / "own/garden").resolve()),
        None,
    ]
    assert [r.protocol for r in study.runs] == ["dietnerf8", "dietnerf8", "builtin8"]
    assert study.name == "study"
    monkeypatch.setenv("GRIDREG_DATA", str(tmp_path / "variable"))
    path.write_text("compositions: [none]\nscenes: [chair]")
    assert load_study(path).runs[0].scene_name == "chair"


def test_scenes_that_are_not_there(tmp_path, monkeypatch):
    monkeypatch.delenv("GRIDREG_DATA", raising=False)
    (tmp_path / "chair").mkdir()
    with pytest.raises(InputError, match=r"scenes: found 'cheir'.*there are chair"):
        study_from_text(f"compositions: [none]\nscenes: [cheir]\ndata: {tmp_path}")
    with pytest.raises(InputError, match=r"found 'lego'.*data: or in GRIDREG_DATA"):
        study_from_text("compositions: [none]\nscenes: [lego]")


def test_two_scenes_of_one_name_are_refused(tmp_path):
    for name in ("a/lego", "b/lego"):
        (tmp_path / name).mkdir(parents=True)
    with pytest.raises(InputError, match="two folders are called 'lego'"):
        study_from_text(f"compositions: [none]\nscenes: [a/lego, b/lego]\ndata: {tmp_path}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"study: compositions: missing"),
        ("compositions: []", "a study without runs"),
        ("compositions: [none]\nseeds: []", r"study:2: seeds: found an empty list"),
        ("compositions: [none]\nsceens: [builtin]", r"study:2: sceens: unknown key, did you mean scenes"),
        ("compositions: [none]\nseeds: [1, 1]", "expected each value once"),
        ("compositions: [none]\nviews: [0]", "expected numbers of training views from 1"),
        ("compositions: [none]\nviews: [50]", "built-in scene has 18 training frames"),
        ("compositions: [none]\nviews: [3]\nprotocols: [builtin8]", "views: found beside protocols"),
        ("compositions: [none]\nprotocols: [buildin8]", r"study:2: protocols: found 'buildin8'"),
        ("compositions: [none]\npresets: [quik]", r"study:2: presets: .*did you mean 'quick'"),
        ("compositions: [none]\nbackbones: [wm]", r"study:2: backbones: found the backbone 'wm', .*vm"),
        ("compositions: [{name: none, backbone: wm}]", r"study:1: compositions: found the backbone 'wm'"),
        ("compositions: [{name: none, preset: quik}]", r"study:1: compositions: found 'quik'"),
        ("compositions: [none]\nset: {train.step: 3}", r"study:2: set.train.step: unknown key"),
        ("compositions: [none]\nset: {seed: 3}", "found 'seed'; expected the study's own key"),
        (
            "compositions: [none]\nbaseline: tensorf",
            r"study:2: baseline: found 'tensorf', expected one of the rows none",
        ),
        ("compositions: [none]\nsteps: 0", r"steps: found 0"),
        ("compositions: [none]\nsize: -1", r"size: found -1"),
        ("compositions:\n  - none\n  - tensrf", r"study:3: compositions.1: unknown composition 'tensrf'"),
        (
            "compositions: [none]\nmodules: [no_such_module_here]",
            "modules: cannot import 'no_such_module_here'",
        ),
        (
            "compositions: [none, composition:few_tensorf]",
            r"row 'few_tensorf' with preset quick: .*encoding\.position",
        ),
        ("compositions: [none]\nset: {field.decoder: nonsense}", "row 'none' with preset quick: .*nonsense"),
        ("compositions: none", "expected a list"),
        *(
            (f"compositions: [none]\nname: {name}", r"study:2: name: found .*expected a name")
            for name in ("../x", "/tmp/x", "..", "''", "a/b", r"'a\b'", r'"a\x00b"', r'"a\nb"')
        ),
        (
            "compositions: [none]\nscenes: ['~nosuchuser/x']",
            "scenes: found '~nosuchuser/x', but there is no folder",
        ),
        (
            "compositions: [none]\ndata: '~nosuchuser'\nscenes: [x]",
            "scenes: found 'x', but there is no folder",
        ),
        (f"compositions: [none]\nscenes: ['{'a' * 300}/x']", "scenes: found 'aaa.*but there is no folder"),
        ("compositions: [none]\nset: {field.generator: 1}", "row 'none' with preset quick: .*generator"),
        ("compositions: [none", "not valid YAML"),
        ("- none", "expected a mapping"),
    ],
)
def test_studies_that_mean_nothing(text, message):
    with pytest.raises(InputError, match=message) as caught:
        study_from_text(text)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml: study not found"):
        load_study(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_study(tmp_path)
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        load_study(tmp_path / "bytes.yaml")


def test_modules_register_what_is_ones_own(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_penalties.py").write_text(
        "import gridreg\ngridreg.register_composition('mine', lambda: [gridreg.OcclusionLoss(weight=0.5)])\n"
    )
    from gridreg.compositions import named as compositions

    before = dict(compositions._COMPOSITIONS)
    try:
        study = study_from_text("compositions: [mine]\nmodules: [my_penalties]")
        assert study.modules == ("my_penalties",)
        assert study.runs[0].config["composition"][0]["weight"] == 0.5
    finally:
        compositions._COMPOSITIONS.clear()
        compositions._COMPOSITIONS.update(before)
        sys.modules.pop("my_penalties", None)


def test_a_file_gives_its_name_and_keeps_its_text(tmp_path):
    path = write_study(tmp_path, "title: Small\n")
    study = load_study(path)
    assert (study.name, study.title) == ("tiny", "Small")
    assert study.source == path.read_text(encoding="utf-8")
    assert study_from_text(study.source, name="tiny").runs == study.runs


def test_the_tiny_study_of_these_tests():
    study = tiny_study(seeds="[0, 1]")
    assert len(study.runs) == 4
    assert {(r.size, r.test) for r in study.runs} == {(32, (0, 9))}


@given(
    st.sampled_from(gridreg.composition_names()),
    st.lists(st.integers(0, 99), min_size=1, max_size=3, unique=True),
    st.lists(st.integers(1, 18), min_size=1, max_size=3, unique=True),
)
def test_hashes_are_one_for_each_run(composition, seeds, views):
    preset = {"few": "few_tensorf", "fre": "freenerf_quick"}.get(composition[:3], "quick")
    study = study_from_text(
        f"compositions: [composition:{composition}]\npresets: [{preset}]\nseeds: {seeds}\nviews: {views}"
    )
    assert len({run.hash for run in study.runs}) == len(study.runs) == len(seeds) * len(views)
    again = study_from_text(
        f"compositions: [composition:{composition}]\npresets: [{preset}]\nseeds: {seeds}\nviews: {views}"
    )
    assert [run.hash for run in again.runs] == [run.hash for run in study.runs]
