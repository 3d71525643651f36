"""Mesh files that read back or stay away, and arguments that are refused."""

from __future__ import annotations

import json
import math
import struct
import sys

import numpy as np
import pytest
import torch
import trimesh

from gridreg.errors import InputError
from gridreg.export.mesh import Mesh, extract_mesh
from gridreg.export.mesh_files import read_mesh, save_mesh, write_mesh
from tests.export_fields import AnalyticField, ball, box


class TestBadInput:
    def test_empty_field(self):
        field = AnalyticField(lambda x: torch.full((len(x),), 1e-3))
        with pytest.raises(InputError, match=r"no ray along an axis of the box is more than 0\.00225 opaque"):
            extract_mesh(field, resolution=9)

    def test_threshold_that_nothing_exceeds(self):
        with pytest.raises(InputError, match=r"threshold=2000: the largest density in the box is 1000"):
            extract_mesh(AnalyticField(ball(0.5)), resolution=9, threshold=2000.0)

    def test_density_that_is_not_finite(self):
        field = AnalyticField(lambda x: torch.where(x[:, 0] > 0.9, torch.nan, 1.0))
        with pytest.raises(InputError, match=r"not finite at \d+ of \d+ positions"):
            extract_mesh(field, resolution=9)

    @pytest.mark.parametrize(
        "options",
        [
            {"threshold": 0.0},
            {"threshold": -1.0},
            {"threshold": math.nan},
            {"threshold": math.inf},
            {"resolution": 1},
            {"min_component": -0.1},
            {"min_component": 1.5},
            {"refine": -1},
            {"chunk": 0},
            {"bounds": torch.tensor([[0.0, 0, 0], [1, 1, 0]])},
            {"bounds": torch.zeros(3)},
        ],
    )
    def test_arguments_out_of_range_are_named(self, options):
        with pytest.raises(InputError, match=next(iter(options))) as error:
            extract_mesh(AnalyticField(ball(0.5)), **{"resolution": 9, **options})
        assert "\n" not in str(error.value)


class TestFiles:
    @pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".PLY"])
    def test_every_format_reads_back(self, tmp_path, suffix):
        path = tmp_path / f"mesh{suffix}"
        mesh = write_mesh(AnalyticField(ball(0.6)), path, resolution=17)
        back = read_mesh(path)
        np.testing.assert_allclose(np.sort(back.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=1e-6)
        assert len(back.faces) == len(mesh.faces)
        assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
        assert back.colours is not None
        np.testing.assert_allclose(back.colours.mean(axis=0), mesh.colours.mean(axis=0), atol=1.5)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    def test_other_suffix_is_refused_before_any_work(self, tmp_path):
        field = AnalyticField(ball(0.5))
        with pytest.raises(InputError, match=r"found suffix '.dae', expected one of .ply, .obj, .glb, .stl"):
            write_mesh(field, tmp_path / "mesh.dae")
        assert field.largest_batch == 0

    def test_failed_write_leaves_what_stood_there(self, tmp_path, monkeypatch):
        path = tmp_path / "mesh.ply"
        path.write_text("before")

        def broken(self, target, **options):
            target.write_text("half")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(trimesh.Trimesh, "export", broken)
        with pytest.raises(InputError, match="no space left"):
            write_mesh(AnalyticField(ball(0.5)), path, resolution=9)
        assert path.read_text() == "before"
        assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]

    def test_unreadable_files(self, tmp_path):
        with pytest.raises(InputError, match="mesh file not found"):
            read_mesh(tmp_path / "none.ply")
        broken = tmp_path / "broken.ply"
        broken.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n1 2\n")
        with pytest.raises(InputError, match=r"broken\.ply"):
            read_mesh(broken)
        points = tmp_path / "points.ply"
        trimesh.PointCloud(np.eye(3)).export(points)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_mesh(points)
        other = tmp_path / "text.xyzzy"
        other.write_text("hello")
        with pytest.raises(InputError, match=r"text\.xyzzy"):
            read_mesh(other)

    def test_glb_is_as_the_standard_has_it(self, tmp_path):
        corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        colours = np.array([[0, 0, 0], [10, 20, 30], [128, 64, 200], [255, 255, 255]], np.uint8)
        path = tmp_path / "a.glb"
        save_mesh(Mesh(corners, faces, colours), path)
        content = path.read_bytes()
        magic, version, length = struct.unpack("<4sII", content[:12])
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack("<I4s", content[12:20])
        assert kind == b"JSON"
        assert size % 4 == 0
        tree = json.loads(content[20 : 20 + size])
        binary = content[28 + size :]
        assert len(binary) == tree["buffers"][0]["byteLength"]

        def array(number, dtype):
            accessor = tree["accessors"][number]
            view = tree["bufferViews"][accessor["bufferView"]]
            assert view["byteOffset"] % 4 == 0
            data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
            return np.frombuffer(data, dtype).reshape(accessor["count"], -1)

        primitive = tree["meshes"][0]["primitives"][0]
        found = array(primitive["attributes"]["POSITION"], "<f4")
        # The third corner was up by 3 and is so along y; what was away from the viewer goes to -z.
        np.testing.assert_allclose(found, [[0, 0, 0], [1, 0, 0], [0, 0, -2], [0, 3, 0]])
        position = tree["accessors"][primitive["attributes"]["POSITION"]]
        assert (position["min"], position["max"]) == ([0, 0, -2], [1, 3, 0])
        np.testing.assert_array_equal(array(primitive["indices"], "<u4").reshape(-1, 3), faces)
        seen = array(primitive["attributes"]["COLOR_0"], "<f4")
        # IEC 61966-2-1 by hand.
        np.testing.assert_allclose(seen[2], [0.21586, 0.05127, 0.57758], atol=1e-5)
        np.testing.assert_allclose(seen[1, 0], 10 / 255 / 12.92, rtol=1e-5)
        back = read_mesh(path)
        np.testing.assert_allclose(back.vertices, corners)
        np.testing.assert_allclose(back.colours, colours, atol=7)
        assert back.volume == pytest.approx(1.0)

    def test_at_most_so_many_faces_of_the_same_shape(self, tmp_path):
        field = AnalyticField(ball(0.6))
        full = write_mesh(field, tmp_path / "full.ply", resolution=33)
        mesh = write_mesh(field, tmp_path / "few.ply", resolution=33, faces=600)
        assert len(mesh.faces) <= 600 < len(full.faces)
        assert mesh.watertight
        assert mesh.volume == pytest.approx(full.volume, rel=0.02)
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.6, atol=0.02)
        # Colours follow: of the field they are those of a place.
        place = np.clip(127.5 + 127.5 * mesh.vertices / 0.6, 0, 255)
        before = np.clip(127.5 + 127.5 * full.vertices / 0.6, 0, 255)
        slack = np.abs(full.colours.astype(float) - before).mean() + 6
        assert np.abs(mesh.colours.astype(float) - place).mean() < slack
        same = write_mesh(field, tmp_path / "same.ply", resolution=33, faces=10**6)
        assert len(same.faces) == len(full.faces)

    def test_faces_out_of_range_and_without_the_package(self, tmp_path, monkeypatch):
        field = AnalyticField(ball(0.6))
        with pytest.raises(InputError, match="faces=3: expected at least 4"):
            write_mesh(field, tmp_path / "a.ply", faces=3)
        monkeypatch.setitem(sys.modules, "fast_simplification", None)
        with pytest.raises(InputError, match=r"expected: pip install 'gridreg\[train\]'"):
            write_mesh(field, tmp_path / "a.ply", faces=10)
        assert field.largest_batch == 0

    def test_stl_is_closed_again(self, tmp_path):
        mesh = write_mesh(AnalyticField(ball(0.6)), tmp_path / "a.stl", resolution=9)
        back = read_mesh(tmp_path / "a.stl")
        assert back.watertight
        assert back.colours is None
        assert back.volume == pytest.approx(mesh.volume, rel=1e-5)

    def test_mesh_without_colours(self, tmp_path):
        mesh = extract_mesh(AnalyticField(box((0.5, 0.4, 0.3))), resolution=17, colours=False)
        save_mesh(mesh, tmp_path / "a.ply")
        assert read_mesh(tmp_path / "a.ply").colours is None


HEAD = (
    "ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"


class TestMalformedFiles:
    """Each is refused in one line, quickly, and opens nothing but itself."""

    def refused(self, path, message, capfd):
        with pytest.raises(InputError, match=message) as error:
            read_mesh(path)
        assert "\n" not in str(error.value)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize("corner", [9, 3, -1, -9])
    def test_a_face_with_a_corner_that_is_not_there(self, tmp_path, capfd, corner):
        path = tmp_path / "a.ply"
        path.write_text(HEAD.format(vertices=3, faces=1) + CORNERS + f"3 0 1 {corner}\n")
        self.refused(path, rf"found a face with corner {corner}, expected 0 to 2", capfd)

    @pytest.mark.parametrize("name", ["a.zip", "a.tar.gz", "a.3mf", "a.txt", "a"])
    def test_archives_and_what_is_no_mesh(self, tmp_path, capfd, name):
        (tmp_path / name).write_bytes(b"PK\x03\x04" + bytes(100))
        self.refused(tmp_path / name, "found suffix .*, expected a mesh: .ply, .obj", capfd)

    @pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl", ".off", ".gltf"])
    @pytest.mark.parametrize(
        "content", [b"", b"\x00" * 200, b"solid x", b"glTF\x02\x00\x00\x00\xff\xff\xff\xff", b"{}"]
    )
    def test_noise(self, tmp_path, capfd, suffix, content):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(content)
        self.refused(path, r"cannot be read as a triangle mesh|found 0 faces", capfd)

    def test_more_corners_than_the_file_holds(self, tmp_path, capfd):
        path = tmp_path / "a.ply"
        path.write_text(HEAD.format(vertices=10**12, faces=1) + CORNERS + "3 0 1 2\n")
        self.refused(path, "cannot be read as a triangle mesh|found 0 faces", capfd)

    def test_a_bad_normal_is_not_logged(self, tmp_path, caplog):
        path = tmp_path / "a.stl"
        loop = "outer loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
        path.write_text(f"solid x\nfacet normal x x x\n{loop}endfacet\nendsolid\n")
        assert len(read_mesh(path).faces) == 1
        assert caplog.records == []

    def test_buffers_beside_it_are_not_opened(self, tmp_path, capfd):
        (tmp_path / "secret.bin").write_bytes(bytes(36))
        (tmp_path / "a.gltf").write_text(
            '{"asset": {"version": "2.0"}, "buffers": [{"uri": "secret.bin", "byteLength": 36}],'
            '"bufferViews": [{"buffer": 0, "byteLength": 36}], "accessors": [{"bufferView": 0, "componentType": 5126,'
            '"count": 3, "type": "VEC3"}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],'
            '"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}'
        )
        self.refused(tmp_path / "a.gltf", "cannot be read as a triangle mesh", capfd)
