"""The built-in scene on disk: the same bytes every time, whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import (
    builtin_depth,
    builtin_scene,
    load_scene,
)
from gridreg.scenes.builtin import write

SIZE = 24


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("scenes"), size=SIZE)


class TestFiles:
    def test_loads_as_the_builtin_scene(self, folder: Path) -> None:
        scene = load_scene(folder, "builtin8", validation=10)
        assert scene.builtin
        assert (len(scene.train), len(scene.test), len(scene.validation)) == (8, 25, 10)
        assert 0.1 < float(scene.train.rgba[..., 3].mean()) < 0.5
        depth = builtin_depth(scene.test.poses[4], scene.test.intrinsics[4], SIZE, SIZE)
        solid = scene.test.rgba[4, ..., 3] == 1
        assert bool(torch.isfinite(depth[solid]).all())
        assert bool(((depth[solid] > scene.near) & (depth[solid] < scene.far)).all())

    def test_a_copy_under_another_name_is_still_marked(self, folder: Path, tmp_path: Path) -> None:
        copied = shutil.copytree(folder, tmp_path / "lego")
        assert load_scene(copied, "builtin8").builtin
        (copied / "builtin.json").unlink()
        assert not load_scene(copied, "builtin8").builtin

    def test_same_bytes_every_time(self, folder: Path, tmp_path: Path) -> None:
        again = builtin_scene(tmp_path, size=SIZE)
        names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
        assert names == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
        assert len(names) == 18 + 25 + 3
        assert all((folder / name).read_bytes() == (again / name).read_bytes() for name in names)
        assert sorted(p.name for p in tmp_path.iterdir()) == [f"lighthouse_{SIZE}"]

    def test_is_written_once(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(write, "_write", lambda *_: pytest.fail("written again"))
        assert builtin_scene(folder.parent, size=SIZE) == folder

    @pytest.mark.parametrize("damage", ["image", "version", "json"])
    def test_an_incomplete_folder_is_replaced(self, folder: Path, tmp_path: Path, damage: str) -> None:
        copied = tmp_path / folder.name
        shutil.copytree(folder, copied)
        if damage == "image":
            (copied / "test/r_7.png").unlink()
        elif damage == "json":
            (copied / "transforms_test.json").unlink()
        else:
            marker = json.loads((copied / "builtin.json").read_text())
            (copied / "builtin.json").write_text(json.dumps({**marker, "version": 0}))
        assert builtin_scene(tmp_path, size=SIZE) == copied
        assert len(load_scene(copied, "builtin8").test) == 25
        assert [p.name for p in tmp_path.iterdir()] == [folder.name]

    def test_leaves_other_folders_alone(self, tmp_path: Path) -> None:
        other = tmp_path / f"lighthouse_{SIZE}"
        other.mkdir()
        (other / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match=r"lighthouse_24: exists but is not the built-in scene"):
            builtin_scene(tmp_path, size=SIZE)
        assert (other / "notes.txt").read_text() == "mine"

    def test_nothing_is_left_when_writing_fails(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(folder: Path, size: int) -> None:
            folder.mkdir()
            (folder / "half").write_text("")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(write, "_write", fail)
        with pytest.raises(InputError, match=r"cannot be written \(No space left on device\)") as error:
            builtin_scene(tmp_path, size=SIZE)
        assert "\n" not in str(error.value)
        assert list(tmp_path.iterdir()) == []

    def test_nothing_is_left_when_interrupted(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(folder: Path, size: int) -> None:
            folder.mkdir()
            raise KeyboardInterrupt

        monkeypatch.setattr(write, "_write", interrupt)
        with pytest.raises(KeyboardInterrupt):
            builtin_scene(tmp_path, size=SIZE)
        assert list(tmp_path.iterdir()) == []

    def test_another_process_was_faster(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        original = write._write

        def meanwhile(fresh: Path, size: int) -> None:
            original(fresh, size)
            shutil.copytree(folder, tmp_path / folder.name)

        monkeypatch.setattr(write, "_write", meanwhile)
        assert builtin_scene(tmp_path, size=SIZE) == tmp_path / folder.name
        assert [p.name for p in tmp_path.iterdir()] == [folder.name]

    def test_a_file_in_the_way(self, tmp_path: Path) -> None:
        (tmp_path / "cache").write_text("")
        with pytest.raises(InputError, match="cannot be written"):
            builtin_scene(tmp_path / "cache", size=SIZE)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_unwritable(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(InputError, match="cannot be written"):
            builtin_scene(tmp_path, size=SIZE)

    def test_size(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="size: found 4, expected at least 8 pixels"):
            builtin_scene(tmp_path, size=4)
