"""The report as a file: whole, self-contained, escaped, bounded, the same for the same results."""

from __future__ import annotations

import base64
import io
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gridreg.ablation.comparison import compare
from gridreg.ablation.report import write_report
from gridreg.ablation.wipes import wipe_data
from gridreg.errors import InputError
from gridreg.export.html import LONGEST_SIDE, encode
from tests.ablation_results import NASTY, VIEWS, Results, done, example, failed, save_history, spec, study_of

VOID = {"meta", "link", "img", "br", "input", "circle", "line", "path", "polyline"}


class Outline(HTMLParser):
    """Elements of a page: what is open must be closed, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


def outline(path: Path) -> Outline:
    found = Outline()
    found.feed(path.read_text(encoding="utf-8"))
    assert found.open == []
    return found


def pictures_of(path: Path) -> list[list[dict]]:
    match = re.search(r'<script type="application/json" id="pictures">(.*?)</script>', path.read_text(), re.S)
    assert match is not None
    return json.loads(match[1])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Results]:
    store, study = example(tmp_path_factory.mktemp("store"))
    return write_report(store, study, tmp_path_factory.mktemp("out") / "report.html"), store


def test_page_is_well_formed_and_loads_nothing(made: tuple[Path, Results]) -> None:
    page = outline(made[0])
    for tag, attributes in page.tags:
        for name in ("src", "href", "action", "data"):
            value = attributes.get(name)
            if value is not None:
                assert value.startswith(("data:", "#")), f"<{tag} {name}={value}>"
    # A namespace or a comment would be fine, but there is not even that. Charts refer to their own frames by url(#id).
    assert not re.search(r"https?://|//\w+\.|@import|url\((?!#)", made[0].read_text())
    policy = [
        a["content"] for t, a in page.tags if t == "meta" and "content-security-policy" in str(a).lower()
    ]
    assert policy
    assert str(policy[0]).startswith("default-src 'none'")


def test_page_has_every_part(made: tuple[Path, Results]) -> None:
    text = " ".join(outline(made[0]).text)
    for part in ("Paired differences", "By scene", "Over time", "Look", "How the masks open", "What failed"):
        assert part in text, part
    assert "43 of 45 runs are finished" in text
    assert "Scenes: lego, chair; seeds 0, 1, 2" in text
    assert "step 40: the loss is <nan> & no more" in text
    assert "few_tensorf + RandomBackground" in text
    assert "cpu A & B <CPU>" in text
    assert "dietnerf8" in text
    assert "11x11 Gaussian window" in text


def test_all_text_is_escaped(made: tuple[Path, Results]) -> None:
    page = outline(made[0])
    assert not [tag for tag, _ in page.tags if tag == "b" and "bold" in str(tag)]
    assert NASTY in "".join(page.text)
    assert len([tag for tag, _ in page.tags if tag == "script"]) == 2
    assert '<script>alert("no")' not in made[0].read_text()
    assert "An <example> & more" in page.text
    options = [a.get("data-right") for t, a in page.tags if a.get("class") == "wipe"]
    assert NASTY in options


def test_markup_in_data_cannot_end_its_script(tmp_path: Path) -> None:
    run = spec("</script><script>alert(1)</script>")
    results = [done(r, tmp_path / str(i)) for i, r in enumerate((run, spec("few_tensorf")))]
    for result in results:
        (result.folder / "test").mkdir(parents=True)
        Image.new("RGB", (8, 8), "red").save(result.folder / "test" / "r_0.png")
    path = write_report(Results(results), study_of([r.spec for r in results]), tmp_path / "r.html")
    assert len([tag for tag, _ in outline(path).tags if tag == "script"]) == 2
    assert pictures_of(path)[0][0]["images"][0]["name"] == run.label


def test_builtin_scene_stands_apart(made: tuple[Path, Results]) -> None:
    text = made[0].read_text()
    first, second = re.findall(r'<section id="table\d">.*?</section>', text, re.S)
    assert "built-in scene, not a published benchmark" in second
    assert "built-in" not in first
    assert "builtin" not in first
    assert "lego" not in second


def test_noise_is_said_and_nothing_is_set_in_bold(made: tuple[Path, Results]) -> None:
    text = made[0].read_text()
    table = re.findall(r'<table class="sortable">.*?</table>', text, re.S)[0]
    rows = {
        row.split('data-value="')[1].split('"')[0]: row for row in re.findall(r"<tr.*?</tr>", table, re.S)[1:]
    }
    assert "within noise" in rows["few_tensorf + RandomBackground"]
    assert "≈" in rows["few_tensorf + RandomBackground"]
    assert "▼" in rows["tensorf"]
    assert "<b>" not in table
    assert "<strong" not in table
    # The last composition has lost two of three runs on the built-in scene.
    assert "one pair: no interval" in text


def test_an_interval_that_leaves_the_picture_has_an_arrow(tmp_path: Path) -> None:
    runs = [spec(label, seed=seed) for label in ("few_tensorf", "tensorf", "none") for seed in range(2)]
    figures = {"few_tensorf": (25.0, 25.0), "tensorf": (25.3, 24.8), "none": (25.1, 25.11)}
    results = [done(run, psnr=figures[run.label][run.seed]) for run in runs]
    text = write_report(Results(results), study_of(runs), tmp_path / "r.html").read_text()
    wide, narrow = re.findall(r'role="listitem">.*?</div>', text, re.S)
    assert wide.count('class="arrow"') == 2
    assert 'class="arrow"' not in narrow


def test_scores_of_pictures_are_those_of_their_views(made: tuple[Path, Results]) -> None:
    sections = pictures_of(made[0])
    assert [sorted({entry["scene"] for entry in section}) for section in sections] == [
        ["chair", "lego"],
        ["builtin"],
    ]
    entry = next(e for e in sections[0] if e["scene"] == "lego" and e["view"] == "r_8")
    names = [image["name"] for image in entry["images"]]
    assert names == ["target", "few_tensorf", "tensorf", NASTY, "few_tensorf + RandomBackground", "none"]
    tensorf = done(spec("tensorf")).metrics
    assert tensorf is not None
    assert entry["images"][2]["psnr"] == tensorf["images"]["r_8"]["psnr"]
    assert entry["seed"] == "0"


def decoded(source: str) -> np.ndarray:
    content = base64.b64decode(source.split(",", 1)[1])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(float)


def test_pictures_are_the_renders_and_the_target(made: tuple[Path, Results]) -> None:
    images = {i["name"]: decoded(i["src"]) for i in pictures_of(made[0])[0][0]["images"]}
    run = next(r for r in made[1].found if r.spec.label == "tensorf" and r.spec.scene_name == "lego")
    view = pictures_of(made[0])[0][0]["view"]
    with Image.open(run.folder / "test" / f"{view}.png") as render:
        assert np.array_equal(images["tensorf"], np.asarray(render))
    # In the middle of the disc: orange is true, tensorf makes it blue.
    assert images["target"][16, 24].tolist() == pytest.approx([230, 128, 26], abs=1)
    assert images["tensorf"][16, 24].tolist() == pytest.approx([26, 128, 230], abs=1)


def test_pictures_keep_to_their_budget(made: tuple[Path, Results]) -> None:
    runs = [spec(label) for label in ("few_tensorf", "tensorf")]
    own = [r for r in made[1].found if r.spec in runs]
    sections = compare(study_of(runs), own)
    whole = wipe_data(sections, 10**9)[0]
    assert [entry["view"] for entry in whole] == list(VIEWS)
    size = sum(len(image["src"]) for image in whole[0]["images"])
    few = wipe_data(sections, size + 10)[0]
    assert len(few) == 1
    assert wipe_data(sections, 10) == [[]]


def test_large_pictures_become_smaller_and_stay_alike() -> None:
    rng = np.random.default_rng(0)
    smooth = np.kron(rng.random((10, 10, 3)), np.ones((80, 80, 1)))
    noise = (255 * np.clip(smooth + rng.normal(0, 0.05, (800, 800, 3)), 0, 1)).astype(np.uint8)
    source = encode(Image.fromarray(noise))
    assert source.startswith("data:image/jpeg")
    found = decoded(source)
    assert found.shape == (LONGEST_SIDE, LONGEST_SIDE, 3)
    mean = noise.reshape(400, 2, 400, 2, 3).mean((1, 3))
    assert np.abs(found - mean).mean() < 6


def test_curves_of_batches_where_no_run_looked(tmp_path: Path) -> None:
    runs = [spec(label) for label in ("few_tensorf", "tensorf")]
    results = [done(run, tmp_path / str(i)) for i, run in enumerate(runs)]
    for result in results:
        result.folder.mkdir()
        save_history(result.folder / "history.jsonl", 25.0, masked=False, looks=False)
    path = write_report(Results(results), study_of(runs), tmp_path / "r.html")
    text = path.read_text()
    assert "PSNR of training batches (dB)" in text
    assert "<h3>Look</h3>" not in text
    assert "How the masks open" not in text


def test_more_views_make_a_chart(tmp_path: Path) -> None:
    runs = [
        spec(label, seed=s, views=v, protocol=f"views{v}")
        for label in ("few_tensorf", "tensorf")
        for v in (3, 10, 100)
        for s in range(2)
    ]
    path = write_report(Results([done(run) for run in runs]), study_of(runs), tmp_path / "r.html")
    text = path.read_text()
    assert text.count("training views</h2>") == 3
    assert "More views" in text
    chart = re.search(r'<section id="views".*?</section>', text, re.S)
    assert chart is not None
    lines = re.findall(r'<g data-series="(\w+)"><title>\w+</title><path ', chart[0])
    assert lines == ["few_tensorf", "tensorf"]
    assert all(f">{count}</text>" in chart[0] for count in (3, 10, 100))


def test_a_study_without_any_result_is_reported(tmp_path: Path) -> None:
    runs = [spec("few_tensorf"), spec("tensorf")]
    path = write_report(Results([]), study_of(runs), tmp_path / "r.html")
    text = " ".join(outline(path).text)
    assert "0 of 2 runs are finished" in text
    assert "cannot be told" in text
    only_failed = write_report(
        Results([failed(run, "no") for run in runs]), study_of(runs), tmp_path / "f.html"
    )
    assert "What failed" in only_failed.read_text()


def test_files_that_cannot_be_read_are_said(tmp_path: Path) -> None:
    store, study = example(tmp_path / "runs", seeds=1, labels={"few_tensorf": 0.0, "tensorf": 0.0})
    broken = store.found[0].folder
    (broken / "history.jsonl").write_text("{not json\n")
    (broken / "test" / "r_0.png").write_bytes(b"no picture")
    text = write_report(store, study, tmp_path / "r.html").read_text()
    assert "history.jsonl:1: not a row of a history" in text


def test_same_results_make_the_same_bytes(made: tuple[Path, Results], tmp_path: Path) -> None:
    study = study_of([spec(label, s) for label in ("few_tensorf", "tensorf") for s in ("lego", "chair")])
    own = [r for r in made[1].found if r.spec in study.runs]
    first = write_report(Results(own), study, tmp_path / "r.html").read_bytes()
    assert write_report(Results(own[::-1]), study, tmp_path / "again.html").read_bytes() == first


def test_tables_stand_beside_and_nothing_else(made: tuple[Path, Results]) -> None:
    assert sorted(path.name for path in made[0].parent.iterdir()) == [
        "report.html",
        "report.md",
        "report.tex",
    ]
    assert made[0].with_suffix(".md").read_text().startswith("# An &lt;example&gt; &amp; more")
    assert r"\begin{tabular}" in made[0].with_suffix(".tex").read_text()


def test_source_can_be_saved(made: tuple[Path, Results]) -> None:
    link = next(a for t, a in outline(made[0]).tags if t == "a" and "download" in a)
    assert link["download"] == "example.yaml"
    source = base64.b64decode(str(link["href"]).split(",", 1)[1]).decode()
    assert source.startswith('name: example\n# <script>alert("no")')


@pytest.mark.parametrize("name", ["report", "report.md", "report.tex"])
def test_other_endings_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected \.html"):
        write_report(Results([]), study_of([spec("few_tensorf")]), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    place = tmp_path / "missing" / "report.html"
    with pytest.raises(InputError, match=re.escape(str(place.parent))):
        write_report(Results([]), study_of([spec("few_tensorf")]), place)


def test_names_that_are_not_utf_8_do_not_stop_the_report(tmp_path: Path) -> None:
    odd = os.fsdecode(b"scene\xff")
    study = study_of([spec("few_tensorf", odd)])
    path = write_report(Results([done(study.runs[0])]), study, tmp_path / "r.html")
    assert "scene\\udcff" in path.read_text()
