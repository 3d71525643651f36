"""Images and videos: what a mode shows, files that play, whole or not there."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.export.camera_paths import camera_path
from gridreg.export.images import colour_bar, depth_range, to_image
from gridreg.export.video import render_frames, render_video
from gridreg.export.writers import write_video
from gridreg.rendering import Rays, Rendered
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model
from gridreg.training.images import row
from tests.export_fields import AnalyticField, ball, ring_of_views

RED = torch.tensor([1.0, 0.0, 0.0])


def red(x: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    return RED.expand(len(x), 3)


def model_of(density: float = 200.0, **options: object) -> Model:
    return Model.of_field(AnalyticField(ball(0.6, density), colour=red), resolution=64, **options)


def cameras_of(frames: int, size: tuple[int, int] = (30, 40)) -> list[Camera]:
    return camera_path(
        "turntable", torch.tensor([[-1.0] * 3, [1.0] * 3]), ring_of_views(6, size=size), frames=frames
    )


def flat(value: float, opacity: float = 1.0, shape: tuple[int, int] = (4, 5)) -> Rendered:
    full = torch.full(shape, opacity)
    return Rendered(torch.full((*shape, 3), 0.5), full, full * value)


def decoded(path: Path, height: int, width: int) -> tuple[np.ndarray, str]:
    """All frames of a video, and what ffmpeg says about it."""
    program = imageio_ffmpeg.get_ffmpeg_exe()
    done = subprocess.run(
        [program, "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True,
        check=True,
    )
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3), done.stderr.decode()


class TestModel:
    def test_image_of_a_ball(self):
        rendered = model_of().render(cameras_of(1)[0])
        assert rendered.colour.shape == (30, 40, 3)
        torch.testing.assert_close(rendered.colour[15, 20], RED, atol=1e-3, rtol=0)
        torch.testing.assert_close(rendered.colour[0, 0], torch.ones(3))
        assert float(rendered.depth[15, 20]) == pytest.approx(3.0 - 0.6, abs=0.03)
        # The silhouette of a ball is a circle: its share of the image is known.
        tangent = 0.6 / math.sqrt(3.0**2 - 0.6**2) * 1.2 * 40
        assert float(rendered.opacity.mean()) == pytest.approx(math.pi * tangent**2 / 1200, rel=0.05)

    def test_chunks_change_nothing_and_can_be_given_up(self):
        model, camera = model_of(), cameras_of(1)[0]
        whole, parts = model.render(camera), model.render(camera, chunk=7)
        assert torch.equal(whole.colour, parts.colour)
        assert torch.equal(whole.depth, parts.depth)
        asked = iter([False, True])
        assert model.render(camera, chunk=600, stop=lambda: next(asked)) is None

    def test_warped_rays_walk_the_field_from_elsewhere(self):
        plain, camera = model_of(), cameras_of(1)[0]

        def shifted(rays: Rays) -> Rays:
            return Rays(rays.origins + torch.tensor([0.0, 0.0, 5.0]), rays.directions)

        moved = Model(plain.field, plain.occupancy, plain.march, warp=shifted).render(camera)
        assert float(moved.opacity.max()) == 0
        assert float(plain.render(camera).opacity.max()) > 0.99

    def test_background(self):
        rendered = model_of(background=torch.tensor([0.0, 1.0, 0.0])).render(cameras_of(1)[0])
        assert rendered.colour[0, 0].tolist() == [0, 1, 0]
        with pytest.raises(InputError, match="resolution=0"):
            Model.of_field(AnalyticField(ball(0.6)), resolution=0)


class TestImages:
    def test_rgb_and_opacity_are_the_render(self):
        rendered = flat(2.0, opacity=0.25)
        assert (to_image(rendered, "rgb") == 128).all()
        assert (to_image(rendered, "opacity") == 64).all()

    def test_depth_goes_from_blue_to_red(self):
        near, middle, far = (
            to_image(flat(v), "depth", (1.0, 3.0))[0, 0].astype(int) for v in (1.0, 2.0, 3.0)
        )
        assert near[2] > near[0]
        assert middle[1] > max(middle[0], middle[2])
        assert far[0] > far[2]
        # Half hit: half way to white.
        half = to_image(flat(3.0, opacity=0.5), "depth", (1.0, 3.0))[0, 0]
        np.testing.assert_allclose(half, (far + 255) / 2, atol=1)
        assert (to_image(flat(2.0, opacity=0.0), "depth", (1.0, 3.0)) == 255).all()

    def test_depth_is_where_the_ray_hits_not_scaled_by_opacity(self):
        assert (
            to_image(flat(2.0), "depth", (1.0, 3.0)) == to_image(flat(2.0, 1.0), "depth", (1.0, 3.0))
        ).all()
        assert depth_range([flat(2.0, opacity=0.6), flat(4.0)]) == pytest.approx((2.0, 4.0), abs=0.15)

    def test_range_of_one_depth_and_of_nothing(self):
        near, far = depth_range([flat(2.0)])
        assert near < 2.0 < far
        assert depth_range([flat(2.0, opacity=0.1)]) == (0.0, 1.0)
        assert depth_range([]) == (0.0, 1.0)
        assert np.isfinite(to_image(flat(0.0, opacity=0.0), "depth").astype(float)).all()

    def test_unknown_mode(self):
        with pytest.raises(InputError, match="mode: found 'normals', expected one of rgb, depth, opacity"):
            to_image(flat(1.0), "normals")

    def test_bar_has_far_above_and_figures(self):
        bar = colour_bar(120, (1.0, 3.0))
        assert bar.shape == (120, 64, 3)
        assert bar[15, 8, 0] > bar[15, 8, 2]
        assert bar[104, 8, 2] > bar[104, 8, 0]
        assert (bar[:, 20:] < 128).any()
        assert not np.array_equal(bar, colour_bar(120, (1.0, 4.0)))
        assert colour_bar(3, (0.0, 1.0)).shape == (3, 64, 3)

    def test_beside_fills_up_with_white(self):
        joined = row([np.zeros((2, 3, 3), np.uint8), np.full((4, 1, 3), 9, np.uint8)], gap=0)
        assert joined.shape == (4, 4, 3)
        assert (joined[2:, :3] == 255).all()
        assert (joined[:, 3] == 9).all()


class TestFrames:
    def test_models_and_modes_lie_side_by_side(self):
        dense, faint = model_of(), model_of(density=0.5)
        (frame,) = render_frames([dense, faint], cameras_of(1), modes=("rgb", "opacity"))
        assert frame.shape == (30, 160, 3)
        middle = frame[15, 20::40].astype(int)
        assert middle[0].tolist() == [255, 0, 0]
        assert middle[1].tolist() == [255, 255, 255]
        assert middle[2, 1] > 100
        assert 50 < middle[3, 0] < 200

    def test_depth_has_one_scale_for_the_video_and_a_bar(self):
        frames = list(render_frames(model_of(), cameras_of(3), modes=("depth",)))
        assert all(frame.shape == (30, 40 + 64, 3) for frame in frames)
        assert all(np.array_equal(frame[:, 40:], frames[0][:, 40:]) for frame in frames)
        (given,) = render_frames(model_of(), cameras_of(1), modes=("depth",), depths=(0.0, 2.4))
        # At the far end of the scale.
        assert given[15, 20, 0] > given[15, 20, 2]

    def test_bad_arguments(self):
        cameras = cameras_of(1)
        with pytest.raises(InputError, match="mode: found 'x'"):
            render_frames(model_of(), cameras, modes=("x",))
        for models, some, modes in (
            ([], cameras, ("rgb",)),
            (model_of(), [], ("rgb",)),
            (model_of(), cameras, ()),
        ):
            with pytest.raises(InputError, match="expected some"):
                render_frames(models, some, modes=modes)
        other = [*cameras, Camera(cameras[0].pose, Lens.from_angle(40.0, 10, 10))]
        with pytest.raises(InputError, match="found the sizes"):
            render_frames(model_of(), other)


class TestFiles:
    def test_mp4_plays_and_shows_the_object(self, tmp_path):
        path = tmp_path / "new" / "video.mp4"
        told = []
        # Odd sizes are what H.264 does not take.
        cameras = cameras_of(5, size=(33, 41))
        render_video(model_of(), path, cameras, fps=12.5, progress=lambda *a: told.append(a))
        video, told_by_ffmpeg = decoded(path, 34, 42)
        assert video.shape == (5, 34, 42, 3)
        assert video[2, 16, 20, 0] > 200
        assert video[2, 16, 20, 1] < 60
        assert (video[2, 1, 1] > 240).all()
        assert "h264" in told_by_ffmpeg
        assert "yuv420p" in told_by_ffmpeg
        assert "12.50 fps" in told_by_ffmpeg
        assert [(done, total) for done, total, _ in told] == [(i, 5) for i in range(1, 6)]
        assert told[-1][2] == 0
        assert all(left >= 0 for _, _, left in told)
        assert [p.name for p in path.parent.iterdir()] == ["video.mp4"]

    def test_same_video_twice_is_the_same_file(self, tmp_path):
        for name in ("a.mp4", "b.mp4"):
            render_video(model_of(), tmp_path / name, cameras_of(2))
        assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()

    def test_gif(self, tmp_path):
        render_video(model_of(), tmp_path / "video.gif", cameras_of(4), fps=10)
        with Image.open(tmp_path / "video.gif") as video:
            assert video.n_frames in (1, 2, 3, 4)
            assert video.info["duration"] % 100 == 0
            assert video.info["loop"] == 0
            pixel = video.convert("RGB").getpixel((20, 15))
        assert pixel[0] > 200
        assert pixel[1] < 60

    def test_png_frames_replace_frames_alone(self, tmp_path):
        folder = tmp_path / "frames"
        render_video(model_of(), folder, cameras_of(3))
        render_video(model_of(), folder, cameras_of(2))
        assert sorted(p.name for p in folder.iterdir()) == ["frame_0000.png", "frame_0001.png"]
        assert iio.imread(folder / "frame_0001.png")[15, 20].tolist() == [255, 0, 0]
        assert [p.name for p in tmp_path.iterdir()] == ["frames"]
        (folder / "thesis.tex").write_text("years of work")
        with pytest.raises(InputError, match=r"holds 'thesis\.tex', expected a new folder"):
            render_video(model_of(), folder, cameras_of(1))
        assert len(list(folder.iterdir())) == 3
        with pytest.raises(InputError, match="a file stands where a folder"):
            render_video(model_of(), self._file(tmp_path / "file"), cameras_of(1))

    @staticmethod
    def _file(path):
        path.write_text("x")
        return path

    @pytest.mark.parametrize("name", ["video.mp4", "video.gif", "video"])
    def test_what_fails_half_way_leaves_what_stood_there(self, tmp_path, name):
        path = tmp_path / name
        frames = [np.zeros((8, 8, 3), np.uint8)] * 2
        write_video(path, frames)
        before = self._content(path)

        def broken():
            yield frames[0]
            raise RuntimeError("out of light")

        with pytest.raises(RuntimeError, match="out of light"):
            write_video(path, broken())
        assert self._content(path) == before
        assert [p.name for p in tmp_path.iterdir()] == [name]

    @staticmethod
    def _content(path):
        return path.read_bytes() if path.is_file() else [p.read_bytes() for p in sorted(path.iterdir())]

    def test_no_frames(self, tmp_path):
        for name in ("video.mp4", "video.gif"):
            with pytest.raises(InputError, match="found no frames"):
                write_video(tmp_path / name, [])
        assert list(tmp_path.iterdir()) == []

    def test_bad_targets_are_refused_before_rendering(self, tmp_path):
        model = model_of()
        for name, options, said in (
            ("video.avi", {}, r"found suffix '\.avi', expected \.mp4, \.gif"),
            ("video.mp4", {"fps": 0.0}, r"fps=0\.0"),
            ("video.mp4", {"fps": math.nan}, "fps=nan"),
        ):
            with pytest.raises(InputError, match=said):
                render_video(model, tmp_path / name, cameras_of(1), **options)
        assert model.field.largest_batch == 0
