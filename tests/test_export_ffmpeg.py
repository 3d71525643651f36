"""ffmpeg that is missing, fails or is stopped: one line, and no file."""

from __future__ import annotations

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export import writers
from gridreg.export.camera_paths import camera_path
from gridreg.export.video import render_video
from gridreg.export.writers import write_video
from gridreg.rendering.cameras import Camera
from gridreg.rendering.model import Model
from tests.export_fields import AnalyticField, ball, ring_of_views


def model_of() -> Model:
    return Model.of_field(AnalyticField(ball(0.6)), resolution=16)


def cameras_of(frames: int) -> list[Camera]:
    bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return camera_path("turntable", bounds, ring_of_views(6, size=(12, 16)), frames=frames)


class TestFfmpeg:
    def test_missing(self, tmp_path, monkeypatch):
        model = model_of()

        def none():
            raise RuntimeError("No ffmpeg exe could be found.\nInstall it.")

        monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none)
        with pytest.raises(InputError, match=r"ffmpeg: found none, expected the program for \.mp4") as error:
            render_video(model, tmp_path / "video.mp4", cameras_of(1))
        assert "\n" not in str(error.value)
        assert model.field.largest_batch == 0
        render_video(model, tmp_path / "video.gif", cameras_of(1))

    def test_named_in_the_environment_but_not_there(self, tmp_path, monkeypatch):
        monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(tmp_path / "ffmpeg"))
        with pytest.raises(InputError, match=r"ffmpeg: found .*ffmpeg, expected the program"):
            writers.find_ffmpeg()

    @pytest.mark.parametrize("reads", [True, False])
    def test_failing(self, tmp_path, monkeypatch, reads):
        program = tmp_path / "ffmpeg"
        body = "cat > /dev/null; " if reads else ""
        program.write_text(
            f"#!/bin/sh\n{body}echo 'first line' >&2; echo 'No space left on device' >&2; exit 3\n"
        )
        program.chmod(0o755)
        monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(program))
        big = [np.zeros((200, 200, 3), np.uint8)] * 5
        with pytest.raises(InputError, match=r"^ffmpeg: failed with No space left on device$"):
            write_video(tmp_path / "video.mp4", big)
        assert [p.name for p in tmp_path.iterdir()] == ["ffmpeg"]

    def test_stopped_when_rendering_fails(self, tmp_path, monkeypatch):
        started = []
        real = subprocess.Popen

        def remember(*arguments, **options):
            started.append(real(*arguments, **options))
            return started[-1]

        monkeypatch.setattr(subprocess, "Popen", remember)

        def interrupted():
            yield np.zeros((8, 8, 3), np.uint8)
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / "video.mp4", interrupted())
        # Looking for the program may have started it before, to ask for its version.
        (running,) = [process for process in started if "rawvideo" in process.args]
        assert running.returncode not in (None, 0)
        assert list(tmp_path.iterdir()) == []
