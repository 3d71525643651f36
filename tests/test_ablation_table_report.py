"""The report of a table that somebody else has made."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gridreg.ablation.comparison import compare
from gridreg.ablation.export import export_results
from gridreg.ablation.records import Study
from gridreg.ablation.table_report import ReportOptions, TableResults, read_table, run
from gridreg.cli import main
from gridreg.errors import InputError
from tests.ablation_results import NASTY, done, failed, spec, study_of

TABLE = """label,scene,seed,psnr,lpips
base,lego,0,24.9,0.13
base,lego,1,24.8,0.14
base,chair,0,26.9,0.11
mine,lego,0,25.4,0.12
mine,lego,1,25.2,0.10
mine,chair,0,27.2,0.10
mine,ship,0,20.0,
"""


def table(folder: Path, text: str = TABLE) -> Path:
    path = folder / "results.csv"
    path.write_text(text, encoding="utf-8")
    return path


def sections(path: Path, baseline: str = "base"):
    text, found = read_table(path)
    study = Study(path.name, "x", baseline, tuple(r.spec for r in found), text)
    return compare(study, TableResults(found).results(study))


def test_pairs_share_scene_and_seed(tmp_path: Path) -> None:
    (section,) = sections(table(tmp_path))
    base, mine = section.rows
    assert (base.is_baseline, base.done, mine.done) == (True, 3, 4)
    assert mine.difference is not None
    assert sorted(mine.difference.pairs.values()) == pytest.approx([0.3, 0.4, 0.5])
    assert mine.metrics["lpips"].mean == pytest.approx(np.mean([0.12, 0.10, 0.10]))
    assert mine.seconds is None


def test_the_command_writes_page_and_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path)
    assert main(["report", str(path), "--baseline", "base", "--title", "Mine & theirs"]) == 0
    assert capsys.readouterr().out == f"report: {tmp_path / 'results.html'}\n"
    page = (tmp_path / "results.html").read_text()
    assert "Mine &amp; theirs" in page
    assert page.count('role="listitem"') == 1
    assert page.count('class="pair"') == 3
    assert "save results.csv" in page
    assert "<h3>Look</h3>" not in page
    heads = re.findall(r"<button type=\"button\">(.*?)</button>", page)
    assert heads[:5] == ["composition", "PSNR (dB)", "Δ PSNR (dB)", "SSIM (Gaussian)", "lpips"]
    assert r"\begin{tabular}" in (tmp_path / "results.tex").read_text()
    assert "+0.40" in (tmp_path / "results.md").read_text()


def test_images_of_a_table_are_in_the_slider(tmp_path: Path) -> None:
    for name, colour in (("t", "white"), ("a", "red"), ("b", "blue")):
        Image.new("RGB", (8, 8), colour).save(tmp_path / f"{name}.png")
    text = "label,psnr,image:front,target:front\nbase,20,a.png,t.png\nmine,21,b.png,t.png\n"
    out = tmp_path / "page.html"
    assert run(ReportOptions(table(tmp_path, text), "base", out=out)) == 0
    found = re.search(r'id="pictures">(.*?)</script>', out.read_text())
    assert found is not None
    ((entry,),) = json.loads(found[1])
    assert [image["name"] for image in entry["images"]] == ["target", "base", "mine"]
    assert (entry["view"], entry["images"][1]["psnr"]) == ("front", None)


def test_what_a_store_exports_can_be_read_back(tmp_path: Path) -> None:
    labels = ("few_tensorf", "=1+1", NASTY, "'quoted'")
    runs = [spec(label, scene, seed) for label in labels for scene in ("lego", "chair") for seed in (0, 1)]
    results = [done(r) for r in runs[:-1]] + [failed(runs[-1], "=it broke")]
    path = export_results(results, tmp_path / "results.csv")
    _, found = read_table(path)
    assert [r.spec.label for r in found] == [r.spec.label for r in results]
    assert (found[-1].status, found[-1].reason) == ("failed", "=it broke")
    before = compare(study_of(runs), results)
    after = compare(study_of([r.spec for r in found]), found)
    assert [row.difference for row in after[0].rows] == [row.difference for row in before[0].rows]
    assert [row.metrics["psnr"] for row in after[0].rows] == [row.metrics["psnr"] for row in before[0].rows]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found no row, expected one column 'label'"),
        ("label,psnr\n", "found no row"),
        ("label,scene\na,b\n", "found label, scene, expected one column 'psnr'"),
        ("label,psnr,psnr\na,1,2\n", "expected one column 'psnr'"),
        ("label,psnr\na,1\na,2,3\n", r"results\.csv:3: found another number of cells"),
        ("label,psnr\na\n", r"results\.csv:2: found another number of cells"),
        ("label,psnr\na,much\n", r"results\.csv:2: psnr: found 'much', expected a number"),
        ("label,psnr\na,nan\n", r"results\.csv:2: psnr: found 'nan', expected a number"),
        ("label,psnr,seed\na,1,0.5\n", r"results\.csv:2: seed: found '0\.5', expected a number"),
        ("label,psnr\n,1\n", r"results\.csv:2: label: missing"),
        ("label,psnr\na,1\nb,1\na,2\n", r"results\.csv:4: found the same run as in line 2: a \| scene"),
        ('label,psnr\n"a,1\n', "not a table of comma-separated values"),
    ],
)
def test_tables_that_mean_nothing(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_table(table(tmp_path, text))
    assert str(tmp_path / "results.csv") in str(caught.value)


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: table not found"):
        read_table(tmp_path / "none.csv")
    (tmp_path / "image.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_table(tmp_path / "image.csv")
    (tmp_path / "nul.csv").write_bytes(b"label,psnr\na\x00,x\n")
    with pytest.raises(InputError, match=r"nul\.csv"):
        read_table(tmp_path / "nul.csv")


def test_a_baseline_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"--baseline: found 'bas', expected one of 'base', 'mine'; did you mean 'base'"
    ):
        run(ReportOptions(table(tmp_path), "bas"))
    assert [p.name for p in tmp_path.iterdir()] == ["results.csv"]
