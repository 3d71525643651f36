"""`prepare` on images without cameras, with a stand-in for pycolmap."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene, load_scene, prepare
from gridreg.scenes import structure_from_motion as worker

SIZE = 16


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.getbasetemp() / "scenes", size=SIZE)


def refused(source: Path, out: Path, pattern: str, **options: Any) -> None:
    with pytest.raises(InputError, match=pattern) as error:
        prepare(source, out, **options)
    assert "\n" not in str(error.value)
    assert not out.exists() or out.is_file()
    # Nothing half-written stays beside it either.
    assert not [path for path in out.parent.glob(".*") if out.name in path.name]


@pytest.fixture
def images(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source / "train", tmp_path / "images"))


class TestImages:
    """Images without cameras, with a stand-in for pycolmap that knows them."""

    @pytest.fixture
    def stand_in(self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A worker that registers the images named in ``names.txt``, from a text model of the true cameras."""
        views = load_scene(source, "first18", test=[]).train
        lines = []
        for name, pose in zip(views.names, views.poses.numpy(), strict=True):
            inverse = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
            w = np.sqrt(max(0, 1 + np.trace(inverse[:3, :3]))) / 2
            m = inverse[:3, :3]
            x, y, z = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / (4 * w)
            lines.append((f"{name}.png", " ".join(map(str, [w, x, y, z, *inverse[:3, 3]]))))
        focal = float(views.intrinsics[0, 0])
        script = tmp_path / "stand_in.py"
        script.write_text(
            "import sys, pathlib\n"
            "from PIL import Image\n"
            "images, out = map(pathlib.Path, sys.argv[1:])\n"
            f"known = dict({lines!r})\n"
            f"asked = pathlib.Path({str(tmp_path / 'names.txt')!r})\n"
            "paths = sorted(images.rglob('*.png'))\n"
            "names = asked.read_text().split() if asked.exists() else [str(p.relative_to(images)) for p in paths]\n"
            "(out / 'model').mkdir()\n"
            "sizes = {p.parent.name: Image.open(p).size for p in paths}\n"
            f"lines = [f'{{k}} SIMPLE_PINHOLE {{w}} {{h}} {focal} {{w / 2}} {{h / 2}}' "
            "for k, (w, h) in enumerate(sizes.values())]\n"
            "(out / 'model/cameras.txt').write_text('\\n'.join(lines))\n"
            "camera = lambda n: [*sizes].index((images / n).parent.name)\n"
            "text = '\\n'.join(f'{k} {known[pathlib.Path(n).name]} {camera(n)} {n}\\n' for k, n in enumerate(names))\n"
            "(out / 'model/images.txt').write_text(text + '\\n')\n"
            "(out / 'model/points3D.txt').write_text('')\n"
            "print('noise'); print('features'); print('matches'); print('cameras'); print('registered', len(names))\n"
        )
        monkeypatch.setattr(worker, "__file__", str(script))
        found = importlib.util.find_spec
        monkeypatch.setattr(
            importlib.util, "find_spec", lambda name: object() if name == "pycolmap" else found(name)
        )
        return script

    def test_become_a_scene(self, images: Path, stand_in: Path, tmp_path: Path, source: Path) -> None:
        stages: list[str] = []
        prepared = prepare(images, tmp_path / "out", progress=stages.append)
        assert stages == ["markers", "features", "matches", "cameras", "box"]
        assert len(prepared.registered) == 18
        loaded = load_scene(tmp_path / "out", "holdout8")
        original = load_scene(source, "first18", test=[]).train
        rows = [original.names.index(name) for name in loaded.train.names]
        assert torch.equal(loaded.train.rgba, original.rgba[rows])
        relative = torch.linalg.inv(loaded.train.poses[0]) @ loaded.train.poses[5]
        wanted = torch.linalg.inv(original.poses[rows[0]]) @ original.poses[rows[5]]
        torch.testing.assert_close(relative[:3, :3], wanted[:3, :3], atol=1e-4, rtol=0)

    def test_some_are_left_out_and_named(self, images: Path, stand_in: Path, tmp_path: Path) -> None:
        (tmp_path / "names.txt").write_text(" ".join(f"r_{k}.png" for k in range(10)))
        prepared = prepare(images, tmp_path / "out")
        assert len(prepared.registered) == 10
        assert prepared.missing == tuple(sorted(f"r_{k}.png" for k in range(10, 18)))
        assert "10 of 18 images have cameras (not r_10.png," in str(prepared)

    def test_too_few_registered(self, images: Path, stand_in: Path, tmp_path: Path) -> None:
        (tmp_path / "names.txt").write_text(" ".join(f"r_{k}.png" for k in range(3)))
        refused(images, tmp_path / "out", r"only 3 of 18 images could be registered; take more images")

    def test_a_partial_solution_is_kept_and_says_so(
        self, images: Path, stand_in: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "names.txt").write_text(" ".join(f"r_{k}.png" for k in range(8)))
        stages: list[str] = []
        prepared = prepare(images, tmp_path / "out", progress=stages.append)
        assert any(stage.startswith("only 8 of 18 images could be registered; take more") for stage in stages)
        assert (len(prepared.registered), len(prepared.missing)) == (8, 10)

    def test_how_many_are_placed_is_said(self, images: Path, stand_in: Path, tmp_path: Path) -> None:
        stand_in.write_text(
            stand_in.read_text().replace("print('cameras')", "print('cameras'); print('placed 7')")
        )
        stages: list[str] = []
        prepare(images, tmp_path / "out", progress=stages.append)
        assert "7 of 18 images placed" in stages

    def test_the_worker_fails(self, images: Path, stand_in: Path, tmp_path: Path) -> None:
        stand_in.write_text("import sys; sys.stderr.write('a\\nno memory\\n'); sys.exit(3)")
        refused(images, tmp_path / "out", r"pycolmap failed with status 3: no memory")
        stand_in.write_text("import os; os.abort()")
        refused(images, tmp_path / "out", r"pycolmap failed with status -6: no message")

    def test_transparent_images_are_matched_on_grey(
        self, images: Path, stand_in: Path, tmp_path: Path
    ) -> None:
        seen = tmp_path / "seen"
        code = f"import shutil\nshutil.copytree(sys.argv[1], {str(seen)!r})\n"
        stand_in.write_text(stand_in.read_text().replace("images, out =", code + "images, out ="))
        prepare(images, tmp_path / "out")
        image = np.asarray(Image.open(seen / "r_0.png"))
        assert image.shape == (SIZE, SIZE, 3)
        assert image[0, 0].tolist() == [128, 128, 128]

    def test_turned_images_are_copied_upright(self, images: Path, stand_in: Path, tmp_path: Path) -> None:
        path = images / "r_4.png"
        upright = np.asarray(Image.open(path))
        exif = Image.Exif()
        exif[274] = 8
        Image.fromarray(np.ascontiguousarray(np.rot90(upright, -1))).save(path, exif=exif)
        prepare(images, tmp_path / "out")
        copied = Image.open(tmp_path / "out/images/r_4.png")
        assert copied.getexif().get(274) is None
        np.testing.assert_array_equal(np.asarray(copied), upright)
        assert (tmp_path / "out/images/r_5.png").read_bytes() == (images / "r_5.png").read_bytes()

    def test_none(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        refused(tmp_path / "empty", tmp_path / "out", r"empty: found nothing, expected images")
        (tmp_path / "empty/a.MOV").write_text("")
        (tmp_path / "empty/.hidden.png").write_text("")
        (tmp_path / "empty/notes.txt").write_text("")
        refused(
            tmp_path / "empty", tmp_path / "out", r"found only \.MOV, \.txt files, expected images \(\.jpg"
        )

    def test_three(self, images: Path, tmp_path: Path) -> None:
        for k in range(3, 18):
            (images / f"r_{k}.png").unlink()
        refused(images, tmp_path / "out", "found 3 images, expected at least 4; take more images")

    def test_of_different_sizes(self, images: Path, stand_in: Path, tmp_path: Path, source: Path) -> None:
        """Each size is a folder, so a camera, to pycolmap; the scene's images are cut to what they share."""
        with Image.open(images / "r_7.png") as image:
            image.crop((2, 0, 14, 16)).save(images / "r_7.png")
        prepared = prepare(images, tmp_path / "out")
        assert len(prepared.registered) == 18
        views = load_scene(tmp_path / "out", "holdout8")
        original = load_scene(source, "first18", test=[]).train
        for side in (views.train, views.test):
            assert (side.width, side.height) == (12, 12)
            for name, (fx, _, cx, cy) in zip(side.names, side.intrinsics.tolist(), strict=True):
                scale = 1.0 if name == "r_7" else 0.75
                assert fx == pytest.approx(scale * float(original.intrinsics[0, 0]))
                assert cx == pytest.approx(6)
                assert cy == pytest.approx(6, abs=2 * (name == "r_7") + 1e-6)

    def test_damaged(self, images: Path, tmp_path: Path) -> None:
        path = images / "r_7.png"
        path.write_bytes(path.read_bytes()[:-40])
        refused(images, tmp_path / "out", r"r_7\.png: not a whole image")

    def test_unreadable_exif(self, images: Path, tmp_path: Path) -> None:
        Image.new("RGB", (SIZE, SIZE)).save(images / "a.jpg", exif=b"Exif\0\0garbage that is no TIFF")
        refused(images, tmp_path / "out", r"a\.jpg: EXIF data cannot be read")

    def test_without_pycolmap(self, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        refused(images, tmp_path / "out", r"pycolmap is not installed: pip install 'gridreg\[colmap\]'")
