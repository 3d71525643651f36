"""Importing the toolkit."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import gridreg


def test_import_is_quick_after_torch() -> None:
    """In under 0.3 seconds; the best of up to three, because the machine may be busy."""
    code = "import torch, time; t = time.perf_counter(); import gridreg; print(time.perf_counter() - t)"
    times: list[float] = []
    while len(times) < 3 and min(times, default=1.0) >= 0.3:
        times.append(float(subprocess.check_output([sys.executable, "-c", code], text=True)))
    assert min(times) < 0.3


def test_idle_threads_do_not_spin_unless_asked_to() -> None:
    code = "import os, gridreg; print(os.environ['OMP_WAIT_POLICY'])"
    variables = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    for asked, policy in (({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")):
        found = subprocess.check_output([sys.executable, "-c", code], env=variables | asked, text=True)
        assert found.strip() == policy


def test_public_names_are_flat_and_exist() -> None:
    assert sorted(gridreg.__all__) == gridreg.__all__
    assert all(hasattr(gridreg, name) for name in gridreg.__all__)
    assert all(cls is getattr(gridreg, name) for name, cls in gridreg.REGISTRY.items())


def test_the_toolkit_alone_loads_no_other_room() -> None:
    code = "import sys, gridreg; print([m for m in sys.modules if m.startswith('gridreg.') or m == 'torchvision'])"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert "gridreg.regularizers.mask_functions" in loaded
    assert not any(
        room in loaded for room in ("torchvision", "rendering", "training", "export", "ablation", "scenes")
    )


ALONE = """
import sys
class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
NAMES = set(sys.argv[1:])
sys.meta_path.insert(0, Nothing())
import torch, gridreg
from gridreg.cli import main
field = torch.nn.Linear(4, 8)
mask = gridreg.FrequencyMask(gridreg.parameters("weight", dim=0), until=0.5)
with gridreg.apply(field, mask, total_steps=10) as handle:
    handle.step(1)
    assert field(torch.rand(2, 4)).shape == (2, 8)
assert main(["--version"]) == 0 == main([])
for command in ("train", "eval", "ablate", "mesh"):
    assert main([command]) == 2
"""


def test_the_toolkit_needs_four_packages_and_commands_name_the_extra() -> None:
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    extra = re.search(r"^train = \[(.*?)^\]", text, flags=re.M | re.S)
    assert extra is not None
    modules = {"imageio-ffmpeg": "imageio_ffmpeg", "pillow": "PIL", "scikit-image": "skimage"}
    names = [modules.get(name, name) for name in re.findall(r'"([a-z0-9-]+)', extra[1])]
    assert len(names) > 5
    done = subprocess.run(
        [sys.executable, "-c", ALONE, *names, "llvmlite"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 4
    assert all("is not installed: pip install 'gridreg[train]'" in line for line in lines)


def test_version_is_in_one_place() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*", gridreg.__version__)
