"""An object to hand on: true size, a box to cut to, a base on the sheet, a texture."""

from __future__ import annotations

import json
import math
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from gridreg.errors import InputError
from gridreg.export import Mesh, read_mesh, save_mesh, write_mesh
from gridreg.export.crop_box import load_crop, save_crop
from gridreg.rendering import OccupancyGrid
from gridreg.scenes import World
from tests.export_fields import AnalyticField, ball

#: A unit of the field is 100 mm; the field's origin is 80 mm over the sheet.
SHEET = World((0.02, 0.0, 0.08), 0.1, metric=True)
SMALL = {"resolution": 48, "colours": False}


def edges(text: str) -> list[float]:
    found = re.search(r"([\d.]+) x ([\d.]+) x ([\d.]+) mm", text)
    assert found is not None, text
    return [float(value) for value in found.groups()]


def glb_json(path: Path) -> dict:
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    return dict(json.loads(data[20 : 20 + length]))


class TestSize:
    @pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
    def test_millimetres_stand_in_the_file(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"ball{suffix}"
        mesh = write_mesh(AnalyticField(ball(0.5)), path, world=SHEET, **SMALL)
        assert edges(mesh.size) == pytest.approx([100, 100, 100], abs=2.5)
        said = (
            glb_json(path)["asset"]["extras"]["size"]
            if suffix == ".glb"
            else path.read_bytes()[:400].decode("latin1")
        )
        assert edges(said) == edges(mesh.size)
        found = read_mesh(path)
        low, high = found.vertices.min(axis=0), found.vertices.max(axis=0)
        # Programs for printing read an STL in millimetres; the others are in the scene's metres.
        unit = 1000 if suffix == ".stl" else 1
        np.testing.assert_allclose((low + high) / 2 / unit, SHEET.origin, atol=2e-3)
        np.testing.assert_allclose((high - low) / unit, 0.1, atol=2.5e-3)
        assert found.watertight

    def test_an_unknown_unit_is_said(self, tmp_path: Path) -> None:
        mesh = write_mesh(
            AnalyticField(ball(0.5)), tmp_path / "ball.ply", world=SHEET._replace(metric=False), **SMALL
        )
        assert mesh.size.endswith("units of the scene's files, whose length is not known")
        assert b" mm" not in (tmp_path / "ball.ply").read_bytes()[:400]


class TestCrop:
    def test_what_is_outside_is_left_out_and_the_cut_closed(self, tmp_path: Path) -> None:
        # The upper half of the ball, in the world of the files.
        box = np.array([[-1.0, -1.0, 0.08], [1.0, 1.0, 1.0]])
        mesh = write_mesh(AnalyticField(ball(0.5)), tmp_path / "half.ply", crop=box, world=SHEET, **SMALL)
        assert mesh.watertight
        assert mesh.vertices[:, 2].min() == pytest.approx(0.08, abs=1e-6)
        assert mesh.volume == pytest.approx(2 / 3 * math.pi * 0.05**3, rel=0.05)

    def test_a_box_beside_the_field(self, tmp_path: Path) -> None:
        box = np.array([[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]])
        with pytest.raises(
            InputError, match=r"crop: the box .* holds nothing of the field's, which is \[\[-0\.08, -0\.1"
        ):
            write_mesh(AnalyticField(ball(0.5)), tmp_path / "a.ply", crop=box, world=SHEET, **SMALL)
        assert not (tmp_path / "a.ply").exists()

    def test_numbers_and_files(self, tmp_path: Path) -> None:
        box = load_crop(["-1", "0", "0.5", "1", "2e0", "3"])
        assert box.tolist() == [[-1, 0, 0.5], [1, 2, 3]]
        save_crop(tmp_path / "crop.json", box)
        assert load_crop([str(tmp_path / "crop.json")]).tolist() == box.tolist()

    @pytest.mark.parametrize("words", [["1", "2"], ["a"] * 6, ["0", "0", "0", "1", "1", "0"], ["nan"] * 6])
    def test_what_is_no_box(self, words: list[str]) -> None:
        with pytest.raises(InputError, match="crop: found"):
            load_crop(words)

    @pytest.mark.parametrize("content", ["{}", '{"bounds": [1]}', '{"bounds": "abcdef"}'])
    def test_what_is_no_file_of_a_box(self, tmp_path: Path, content: str) -> None:
        (tmp_path / "crop.json").write_text(content)
        with pytest.raises(InputError, match=r"crop: found .*expected X0 Y0 Z0 X1 Y1 Z1 or a file"):
            load_crop([str(tmp_path / "crop.json")])
        with pytest.raises(InputError, match=r"nowhere\.json"):
            load_crop([str(tmp_path / "nowhere.json")])


class TestBase:
    def test_the_outline_goes_straight_down_to_the_sheet(self, tmp_path: Path) -> None:
        # A ball of 50 mm, its middle 80 mm over the sheet: from there down, a cylinder.
        field = AnalyticField(ball(0.5), half=(0.7, 0.7, 0.7))
        mesh = write_mesh(field, tmp_path / "a.ply", base=0.08, world=SHEET, **SMALL)
        assert mesh.watertight
        assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
        whole = math.pi * 0.05**2 * 0.08 + 2 / 3 * math.pi * 0.05**3
        assert mesh.volume == pytest.approx(whole, rel=0.05)
        # The foot is flat and as wide as the ball.
        foot = mesh.vertices[mesh.vertices[:, 2] < 1e-6] - SHEET.origin
        assert np.hypot(*foot[:, :2].T).max() == pytest.approx(0.05, abs=2e-3)

    def test_cells_without_anything_stay_empty(self, tmp_path: Path) -> None:
        field = AnalyticField(lambda x: torch.full((len(x),), 1000.0))
        cells = OccupancyGrid.full(field.bounds, (2, 1, 1))
        cells.cells[0] = 0
        mesh = write_mesh(field, tmp_path / "a.ply", cells, base=0.08, world=SHEET, **SMALL)
        assert mesh.vertices[:, 0].min() >= SHEET.origin[0] - 3e-3

    @pytest.mark.parametrize("height", [0.0, -0.01, 0.3])
    def test_heights_out_of_range(self, tmp_path: Path, height: float) -> None:
        with pytest.raises(
            InputError, match=r"base: found .* mm over the sheet, expected above 0 and below 180$"
        ):
            write_mesh(AnalyticField(ball(0.5)), tmp_path / "a.ply", base=height, world=SHEET)

    def test_a_scene_without_a_sheet(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="base: the scene is not one on the sheet"):
            write_mesh(AnalyticField(ball(0.5)), tmp_path / "a.ply", base=0.01)


class TestTexture:
    @pytest.mark.parametrize("suffix", [".obj", ".glb"])
    def test_the_colours_of_the_field_are_where_they_belong(self, tmp_path: Path, suffix: str) -> None:
        pytest.importorskip("xatlas", reason="xatlas (extra 'texture') is not installed")
        field = AnalyticField(ball(0.5, density=4000.0))
        path = tmp_path / f"ball{suffix}"
        mesh = write_mesh(field, path, resolution=64, faces=600, texture=256, world=SHEET)
        assert mesh.watertight
        # Read by somebody else.
        loaded = trimesh.load(path, process=False, force="mesh")
        material = loaded.visual.material
        image = material.image if suffix == ".obj" else material.baseColorTexture
        pixels = np.asarray(image.convert("RGB")).astype(float)
        assert pixels.shape == (256, 256, 3)
        # Middles of faces, in the texture and in space.
        uv = loaded.visual.uv[loaded.faces].mean(axis=1)
        points = loaded.vertices[loaded.faces].mean(axis=1)
        if suffix == ".glb":
            points = points @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T
        seen = pixels[((1 - uv[:, 1]) * 256).astype(int), (uv[:, 0] * 256).astype(int)] / 255
        expected = ((points - SHEET.origin) / SHEET.unit + 1) / 2
        # Colours are taken over three cells of depth, along a ray.
        assert np.abs(seen - expected).max() < 0.07
        assert np.abs(seen - expected).mean() < 0.03
        if suffix == ".obj":
            with Image.open(tmp_path / "ball.png") as stored:
                assert stored.size == (256, 256)
            assert "map_Kd ball.png" in (tmp_path / "ball.mtl").read_text()
        else:
            assert "COLOR_0" not in glb_json(path)["meshes"][0]["primitives"][0]["attributes"]

    @pytest.mark.parametrize("suffix", [".obj", ".glb"])
    def test_a_texture_is_read_by_somebody_else(self, tmp_path: Path, suffix: str) -> None:
        corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1e-3]])
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        places = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
        pixels = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
        save_mesh(Mesh(corners, faces, places=places, texture=pixels), tmp_path / f"two words{suffix}")
        names = {".obj": ["two words.mtl", "two words.obj", "two words.png"], ".glb": ["two words.glb"]}
        assert sorted(p.name for p in tmp_path.iterdir()) == names[suffix]
        loaded = trimesh.load(tmp_path / f"two words{suffix}", process=False, force="mesh")
        material = loaded.visual.material
        image = material.image if suffix == ".obj" else material.baseColorTexture
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), pixels)
        np.testing.assert_allclose(loaded.visual.uv, places, atol=1e-6)
        np.testing.assert_array_equal(loaded.faces, faces)
        if suffix == ".obj":
            np.testing.assert_allclose(loaded.vertices, corners, atol=1e-8)
            lines = (tmp_path / "two words.mtl").read_text().splitlines()
            assert "Kd 1.00000000 1.00000000 1.00000000" in lines
            assert (
                (tmp_path / "two words.obj").read_text().startswith("# gridreg, 1 x 1 x 0.001 units of the")
            )
        else:
            surface = glb_json(tmp_path / "two words.glb")["materials"][0]["pbrMetallicRoughness"]
            assert (surface["metallicFactor"], surface["roughnessFactor"]) == (0, 1)

    def test_what_is_refused_before_any_work(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        field = AnalyticField(ball(0.5))
        with pytest.raises(
            InputError, match=r"suffix '\.stl', expected one of \.obj, \.glb for a mesh with a texture"
        ):
            write_mesh(field, tmp_path / "a.stl", texture=256)
        with pytest.raises(InputError, match="texture=8: expected the edge in pixels, from 16 to 8192"):
            write_mesh(field, tmp_path / "a.glb", texture=8)
        monkeypatch.setitem(sys.modules, "xatlas", None)
        with pytest.raises(
            InputError, match=r"xatlas is not installed, expected: pip install 'gridreg\[texture\]'"
        ):
            write_mesh(field, tmp_path / "a.glb", texture=256)
        assert field.largest_batch == 0
