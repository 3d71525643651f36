"""The README: at most 90 lines, in the words that people search for, and its Python runs as it stands there."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("code", BLOCKS)
def test_python_blocks_run(code):
    scope = {}
    exec(compile(code, "README.md", "exec"), scope)
    assert scope["field"].grid.shape == (1, 12, 16, 16, 16)
    assert type(scope["field"]) is scope["Voxels"]


def test_there_is_something_to_run():
    assert BLOCKS


def test_it_is_short_and_says_what_it_is_first():
    assert len(README.splitlines()) <= 90
    first = README.split("```")[0]
    words = ("few-shot", "sparse-view", "nerf", "tensorf", "pytorch", "reconstruction", "video", "mesh")
    assert all(word in README.lower() for word in words)
    assert "![" in first
    assert ".webp" in first


def test_every_link_leads_somewhere():
    root = Path(__file__).parents[1]
    places = [place for place in re.findall(r"\]\(([^)]+)\)", README) if "://" not in place]
    assert len(places) > 10
    for place in places:
        name, _, anchor = place.partition("#")
        assert (root / name).exists(), place
        headings = (
            re.findall(r"^#+ (.*)$", (root / name).read_text(encoding="utf-8"), re.M) if anchor else [""]
        )
        assert anchor in {
            re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings
        }, place
