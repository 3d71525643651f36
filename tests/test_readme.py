"""The README's Python runs as it stands there."""

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
