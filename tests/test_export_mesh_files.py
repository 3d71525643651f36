"""Mesh files that read back or stay away, and arguments that are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from gridreg.errors import InputError
from gridreg.export.mesh import extract_mesh, read_mesh, save_mesh, write_mesh
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
        with pytest.raises(InputError, match=r"found suffix '.stl', expected one of .ply, .obj, .glb"):
            write_mesh(field, tmp_path / "mesh.stl")
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
        with pytest.raises(InputError, match="no such mesh file"):
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

    def test_mesh_without_colours(self, tmp_path):
        mesh = extract_mesh(AnalyticField(box((0.5, 0.4, 0.3))), resolution=17, colours=False)
        save_mesh(mesh, tmp_path / "a.ply")
        assert read_mesh(tmp_path / "a.ply").colours is None
