"""The viewer's server side: addresses, cameras, and images for clients that a test plays."""

from __future__ import annotations

import math
import socket
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export.browser import camera_of, image_shape, start_server
from gridreg.export.cameras import look_at
from gridreg.export.crop_box import load_crop
from gridreg.export.images import z_depth
from gridreg.export.viewer import Viewer
from gridreg.rendering import Rendered, camera_rays
from gridreg.rendering.model import Model
from gridreg.scenes import World
from tests.export_fields import AnalyticField, ball, ball_model, ring_of_views
from tests.export_viewing import FakeClient

pytest.importorskip("viser", reason="viser (extra 'viewer') is not installed")


def taken_port() -> tuple[socket.socket, int]:
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    return listener, listener.getsockname()[1]


FRONT = look_at(np.array([3.0, 0, 0]), np.zeros(3), np.array([0.0, 0, 1]))


def until(condition: Any, seconds: float = 90.0) -> Any:
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "not in time"
        time.sleep(0.02)
    return value


class TestServer:
    def test_says_where_it_listens_and_stops(self, capsys):
        with Viewer(ball_model(step=100), port=0) as viewer:
            assert viewer.url == f"http://127.0.0.1:{viewer.port}"
            with socket.create_connection(("127.0.0.1", viewer.port), timeout=10):
                pass
        captured = capsys.readouterr()
        assert captured.err == f"viewer: {viewer.url} (reached from this machine only)\n"
        assert captured.out == ""
        viewer.close()
        with pytest.raises(OSError):  # noqa: PT011  (whichever way the system says it)
            socket.create_connection(("127.0.0.1", viewer.port), timeout=2)

    def test_everybody_is_named_when_everybody_can_look(self, capsys):
        with Viewer(ball_model(step=100), host="0.0.0.0", port=0) as viewer:
            assert viewer.url.startswith(f"http://127.0.0.1:{viewer.port}/?token=")
        assert (
            capsys.readouterr().err == f"viewer: {viewer.url} (reached from the network, with this token)\n"
        )

    def test_taken_port_is_one_line(self):
        listener, port = taken_port()
        with (
            listener,
            pytest.raises(InputError, match=rf"cannot listen on 127\.0\.0\.1:{port}: .*") as e,
        ):
            Viewer(ball_model(step=100), port=port, quiet=True)
        assert "\n" not in str(e.value)

    @pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 65536), ("127.0.0.1", -1), ("203.0.113.1", 0)])
    def test_bad_addresses(self, host, port):
        with pytest.raises(InputError, match=r"port=|cannot listen on 203"):
            start_server(host, port)

    def test_without_viser(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "viser", None)
        with pytest.raises(
            InputError, match=r"viser is not installed, expected: pip install 'gridreg\[viewer\]'"
        ):
            start_server("127.0.0.1", 0)

    def test_nobody_can_publish_the_page(self):
        server = start_server("127.0.0.1", 0)
        try:
            assert server.request_share_url() is None
        finally:
            server.stop()

    def test_wait_ends_when_it_is_closed(self):
        viewer = Viewer(ball_model(step=100), port=0, quiet=True)
        waiting = threading.Thread(target=viewer.wait)
        waiting.start()
        viewer.close()
        waiting.join(timeout=10)
        assert not waiting.is_alive()


class TestCameras:
    def test_a_browser_sees_what_a_camera_sees(self):
        client = FakeClient(FRONT)
        camera = camera_of(client, image_shape(client, 512), 80)
        torch.testing.assert_close(camera.pose, FRONT, atol=1e-6, rtol=0)
        assert (camera.lens.height, camera.lens.width) == (60, 80)
        rays = camera_rays(camera.pose, torch.tensor(camera.lens.intrinsics), 60, 80)
        first, last = rays.directions[0], rays.directions[59 * 80]
        # Half a pixel is missing at either edge.
        angle = math.degrees(math.acos(float(first @ last) / 1))
        assert angle < 50
        top = math.degrees(math.atan(float(rays.directions[40][2] / -rays.directions[40][0])))
        assert top == pytest.approx(25, abs=0.5)

    def test_small_images_show_the_same(self):
        client = FakeClient(FRONT, size=(600, 800))
        shape = image_shape(client, 200)
        assert shape == (150, 200)
        assert image_shape(client, 1600) == (600, 800)
        small = camera_of(client, shape, 50)
        fx, fy, cx, cy = small.lens.intrinsics
        assert (small.lens.height, small.lens.width) == (38, 50)
        assert (fx / 50, fy / 38, cx, cy) == pytest.approx(
            (fy / 38 * 38 / 50, fx / 50 * 50 / 38, 25, 19), rel=0.02
        )

    def test_depth_along_the_axis_of_a_wall_is_the_same_everywhere(self):
        intrinsics = (20.0, 25.0, 8.0, 6.0)
        rays = camera_rays(torch.eye(4), torch.tensor(intrinsics), 12, 16)
        along = (2.0 / -rays.directions[:, 2]).reshape(12, 16)
        opacity = torch.full((12, 16), 0.8)
        opacity[0, 0] = 0.2
        found = z_depth(Rendered(torch.zeros(12, 16, 3), opacity, along * opacity), intrinsics)
        np.testing.assert_allclose(found.reshape(-1)[1:], 2.0, rtol=1e-5)
        assert found[0, 0] > 100


class TestDrawing:
    def start(self, model: Model | None = None, **options: Any) -> tuple[Viewer, FakeClient]:
        viewer = Viewer(model or ball_model(step=100), port=0, quiet=True, **options)
        client = FakeClient(FRONT)
        viewer._connected(client)
        return viewer, client

    def test_sharpens_to_full_size_and_then_rests(self):
        viewer, client = self.start()
        with viewer:
            until(lambda: client.images and client.images[-1].shape[:2] == (60, 80))
            widths = [p.shape[1] for p in client.images]
            assert widths == sorted(widths)
            middle = client.images[-1][30, 40].astype(int)
            # The near side of the ball: x = 0.6, so red, and half of green and blue.
            assert middle == pytest.approx([0.8 * 255, 127, 127], abs=8)
            assert (client.images[-1][0, 0] == 255).all()
            count = len(client.images)
            time.sleep(0.5)
            assert len(client.images) == count

    def test_follows_the_camera(self):
        viewer, client = self.start()
        with viewer:
            until(lambda: client.images)
            client.place(look_at(np.array([0.0, 3, 0]), np.zeros(3), np.array([0.0, 0, 1])))
            client.moved(client.camera)
            found = until(lambda: [p for p in client.images if p[p.shape[0] // 2, p.shape[1] // 2, 1] > 190])
            assert found[-1][found[-1].shape[0] // 2, found[-1].shape[1] // 2, 0] < 140

    def test_training_is_shown_when_it_is_wanted(self):
        model = ball_model(step=0)
        viewer = Viewer(model, port=0, quiet=True, refresh=0.1)
        with viewer:
            time.sleep(0.2)
            assert not viewer.wants_update, "nobody looks"
            client = FakeClient(FRONT)
            viewer._connected(client)
            until(lambda: client.images and viewer.wants_update)
            assert client.images[-1].reshape(-1, 3)[:, 2].min() < 10
            model.handle.step(100)
            viewer.update(model)
            assert not viewer.wants_update
            until(lambda: client.images[-1].reshape(-1, 3)[:, 2].min() > 50)
            assert viewer._panel._step.value == 100
            viewer._disconnected(client)
            time.sleep(0.2)
            assert not viewer.wants_update

    def test_an_error_is_told_and_does_not_end_it(self):
        broken = AnalyticField(ball(0.6))
        viewer, client = self.start(Model.of_field(broken, resolution=8))
        with viewer:
            until(lambda: client.images)
            failing = viewer._preview.at().field

            def fails(x: torch.Tensor) -> torch.Tensor:
                raise RuntimeError("no light\nat all")

            failing.function = fails
            client.moved(client.camera)
            until(lambda: "cannot draw" in viewer._panel._status.content)
            assert viewer._panel._status.content == "**cannot draw:** RuntimeError: no light"
            failing.function = ball(0.6)
            count = len(client.images)
            client.moved(client.camera)
            until(lambda: len(client.images) > count)

    def test_snapshot_is_the_full_image_as_a_file(self):
        import imageio.v3 as iio

        viewer, client = self.start()
        with viewer:
            viewer._ask(viewer._save, client)
            name, content = until(lambda: client.files)[0]
            assert name.startswith("gridreg_rgb_")
            assert name.endswith(".png")
            assert iio.imread(content).shape == (60, 80, 3)

    def test_who_has_waited_longest_is_served_first(self):
        viewer, _ = self.start()
        with viewer:
            clients = [FakeClient(FRONT) for _ in range(4)]
            for number, client in enumerate(clients):
                client.client_id = 100 + number
                viewer._connected(client)
            end = time.monotonic() + 4
            while time.monotonic() < end:
                for client in clients:
                    client.moved(client.camera)
                time.sleep(0.01)
            counts = [len(client.images) for client in clients]
        assert min(counts) >= 3
        assert max(counts) <= 2 * min(counts)

    def test_what_a_browser_says_is_bounded(self):
        viewer, client = self.start()
        with viewer:
            panel = viewer._panel
            panel._size.value, panel._mode.value = 9000, "no such mode"
            assert (panel.look.size, panel.look.mode) == (1600, "rgb")
            panel._size.value = -5
            assert panel.look.size == 64
            for _ in range(5):
                viewer._ask(viewer._save, client)
            assert len(viewer._wishes) <= 1

    def test_training_views_are_there_to_click(self):
        with Viewer(ball_model(step=100), ring_of_views(4), port=0, quiet=True) as viewer:
            assert viewer._panel.cameras.visible
            np.testing.assert_allclose(
                np.linalg.norm(viewer._server.initial_camera.position), 0.8 * 3.0, rtol=1e-4
            )
        with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
            assert not viewer._panel.cameras.visible


class TestCropBox:
    def test_a_box_is_shown_and_saved_in_the_world_of_the_files(self, tmp_path):
        world, path = World((10.0, 0.0, 0.0), 2.0), tmp_path / "crop.json"
        with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
            crop = viewer.offer_crop(path, torch.tensor([[-1.0] * 3, [1.0] * 3]), world)
            assert crop.box.tolist() == [[8, -2, -2], [12, 2, 2]]
            assert not crop.low.visible
            crop.shown.value = True
            until(lambda: crop.low.visible and crop._lines is not None)
            # The twelve edges, in the coordinates of what is shown.
            points = np.asarray(crop._lines.points)
            assert points.shape == (12, 2, 3)
            assert (np.abs(points) == 1).all()
            assert {tuple(np.abs(a - b)) for a, b in points} == {(2, 0, 0), (0, 2, 0), (0, 0, 2)}
            # Corners the wrong way round mean the same box.
            crop.low.value, crop.high.value = (11.0, 1.0, 1.0), (9.0, -1.0, 0.0)
            crop._save(SimpleNamespace(client=None))
            assert load_crop([str(path)]).tolist() == [[9, -1, 0], [11, 1, 1]]
            crop.shown.value = False
            until(lambda: crop._lines is None and crop.inner is None)

    def test_it_cuts_what_a_browser_is_sent(self, tmp_path):
        client, world = FakeClient(FRONT), World((0.0, 0.0, 0.0), 1.0)
        with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
            crop = viewer.offer_crop(tmp_path / "crop.json", torch.tensor([[-1.0] * 3, [1.0] * 3]), world)
            viewer._connected(client)
            whole = until(lambda: [image for image in client.images if image.shape[1] == 80])[-1]
            assert (whole[30, [30, 50]] < 250).any(axis=1).all()
            crop.low.value, crop.shown.value = (-1.0, 0.0, -1.0), True
            cut = until(lambda: [i for i in client.images if i.shape[1] == 80 and (i[:, :39] > 250).all()])[
                -1
            ]
            assert (cut[30, 50] < 250).any()
            crop.shown.value = False
            until(lambda: np.array_equal(client.images[-1], whole))
