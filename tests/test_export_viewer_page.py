"""The viewer's page: its title, a photograph beside its render, curve and pause, a telephone, and strange requests."""

from __future__ import annotations

import http.client
import json
import math
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gridreg.cli.view import described
from gridreg.export import browser
from gridreg.export.runs import LiveView, smoothed
from gridreg.export.viewer import Viewer
from gridreg.export.viewer_panel import short_labels
from gridreg.ops.compilation import work_clock
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import Views
from gridreg.training import RunConfig
from tests.export_fields import ball_model, ring_of_views
from tests.export_viewing import FakeClient

pytest.importorskip("viser", reason="viser (extra 'viewer') is not installed")


def until(condition: Any, seconds: float = 60.0) -> Any:
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "not in time"
        time.sleep(0.02)
    return value


class Client(FakeClient):
    """A browser that may be moved."""

    def atomic(self) -> Any:
        return threading.Lock()


def photographs(scale: float) -> Views:
    """What a ring of cameras sees of the ball, darkened."""
    views, model = ring_of_views(3), ball_model(step=100)
    rgba = views.rgba.clone()
    for i in range(3):
        camera = Camera(views.poses[i], Lens.from_tensor(views.intrinsics[i], 30, 40))
        rendered = model.render(camera)
        assert rendered is not None
        rgba[i, ..., :3] = scale * rendered.colour
    return Views(rgba, views.poses, views.intrinsics, views.names, views.ids)


def test_who_clicks_a_camera_sees_render_and_photograph_with_their_psnr() -> None:
    views = photographs(0.9)
    with Viewer(ball_model(step=100), views, port=0, quiet=True) as viewer:
        client = Client(views.poses[0])
        viewer._cameras.visit(client, 1)
        image, text = until(lambda: viewer._panel._compared)
        shown = until(lambda: text.content if "dB" in text.content else None)
        # The photographs are 0.9 of the renders, so the error is a tenth of them.
        expected = -20 * math.log10(0.1 * float((views.rgba[1, ..., :3] / 0.9).square().mean().sqrt()))
        assert shown == f"**view_1**: render, photograph; {expected:.2f} dB at 40x30"
        pixels = np.asarray(image.image)
        assert pixels.shape == (30, 84, 3)
        assert np.abs(0.9 * pixels[:, :40].astype(float) - pixels[:, 44:]).max() <= 1
        assert np.allclose(client.camera.position, views.poses[1, :3, 3])


def test_the_camera_that_is_stood_in_makes_room_and_comes_back() -> None:
    views = ring_of_views(3)
    with Viewer(ball_model(step=100), views, port=0, quiet=True) as viewer:
        cameras, client = viewer._cameras, Client(views.poses[0])
        cameras.visit(client, 1)
        assert [frustum.visible for frustum in cameras.frustums.values()] == [True, False, True]
        cameras.come_back(client.camera.position)
        assert not cameras.frustums[1].visible
        cameras.visit(client, 2)
        assert [frustum.visible for frustum in cameras.frustums.values()] == [True, True, False]
        cameras.come_back(client.camera.position + 0.1)
        assert all(frustum.visible for frustum in cameras.frustums.values())


def test_large_photographs_are_compared_reduced() -> None:
    views = ring_of_views(1, size=(600, 800))
    with Viewer(ball_model(step=100), views, port=0, quiet=True) as viewer:
        found = viewer._cameras.comparison(ball_model(step=100), 0, lambda: False)
    assert found is not None
    assert found[0].shape == (300, 804, 3)


def test_the_page_has_the_run_in_its_title() -> None:
    with Viewer(ball_model(step=100), port=0, quiet=True, title="mine, 28.13 dB, <lego>") as viewer:
        for path in ("/", "/index.html", "/?a=b"):
            connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=20)
            connection.request("GET", path, headers={"Accept-Encoding": "gzip"})
            answer = connection.getresponse()
            assert b"<title>mine, 28.13 dB, &lt;lego&gt;</title>" in answer.read()
            connection.close()


def test_a_run_is_described_by_its_files(tmp_path: Path) -> None:
    run: Any = SimpleNamespace(config=RunConfig(scene="scenes/lego"))
    folder = tmp_path / "mine"
    folder.mkdir()
    assert described(run, folder) == ("mine, lego", [])
    (folder / "metrics.json").write_text(json.dumps({"mean": {"psnr": 28.126}}))
    (folder / "history.jsonl").write_text('{"step": 1, "psnr": 10.5}\n{"step": 1, "masks": {}}\n')
    assert described(run, folder) == ("mine, 28.13 dB, lego", [(1.0, 10.5)])
    (folder / "metrics.json").write_text("[")
    assert described(run, folder)[0] == "mine, lego"


@pytest.mark.parametrize(
    "request_",
    [
        b"\x16\x03\x01\x02\x00\x01",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n",
        b"GET /%00 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET //[ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET /?token=%ED%A0%80 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/9\r\n\r\n",
    ],
)
def test_a_strange_request_is_no_news(request_: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
        with socket.create_connection(("127.0.0.1", viewer.port), timeout=20) as connection:
            connection.sendall(request_)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1 << 16):
                pass
        # It still answers.
        with socket.create_connection(("127.0.0.1", viewer.port), timeout=20) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert connection.recv(15) == b"HTTP/1.1 200 OK"
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_labels_stay_on_one_line() -> None:
    masks = ["FrequencyMask(encoding.direction)", "FrequencyMask(a_long_name_of_a_site)"]
    assert short_labels(masks) == ["encoding.direction", "a_long_name_of_a_…"]
    assert short_labels(["FixedMask(x)", "CosineMask(x)"]) == ["FixedMask(x)", "CosineMask(x)"]


@pytest.mark.parametrize(("size", "expected"), [((844, 390), 90.5), ((600, 900), 50.0), ((0, 0), 50.0)])
def test_a_telephone_sees_the_whole_width(size: tuple[int, int], expected: float) -> None:
    client = FakeClient(torch.eye(4), size)
    browser.fit_upright(client, math.radians(50))
    assert math.degrees(client.camera.fov) == pytest.approx(expected, abs=0.2)


def test_curves() -> None:
    assert smoothed([]) == ([], [])
    x, y = smoothed([(i, 2.0 * i) for i in range(1000)])
    assert len(x) == 200
    assert (x[0], y[0]) == (2.0, 4.0)
    with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
        viewer.curve([1], [1])
        assert viewer._panel._chart is None
        viewer.curve([1, 2], [10, 11])
        viewer.curve([1, 2, 3], [10, 11, 12])
        assert [list(axis) for axis in viewer._panel._chart.data] == [[1, 2, 3], [10, 11, 12]]


def test_a_paused_training_waits_and_its_clock_stands_still() -> None:
    model, stopped = ball_model(step=100), threading.Event()
    run: Any = SimpleNamespace(
        trainer=SimpleNamespace(model=model, step=1),
        scene=SimpleNamespace(train=ring_of_views(2), name="lego", protocol="views2"),
        out=Path("mine"),
        stopping=stopped.is_set,
    )
    look, report = LiveView(port=0), {"psnr": 20.0}
    look.start(run)
    viewer = look.viewer
    assert viewer is not None
    assert viewer._admission.title == "mine, lego, views2"
    try:
        viewer._panel._turn()
        began = time.perf_counter()
        look.step(report)  # type: ignore[arg-type]
        assert time.perf_counter() - began < 5, "with nobody looking it goes on"
        client = FakeClient(torch.eye(4))
        viewer._connected(client)
        assert viewer.paused
        clock = work_clock()
        waiting = threading.Thread(target=look.step, args=(report,))
        waiting.start()
        time.sleep(1.0)
        assert waiting.is_alive()
        viewer._panel._turn()
        waiting.join(10)
        assert not waiting.is_alive()
        assert work_clock() - clock < 0.8
        # Ctrl-C ends the pause as well.
        viewer._panel._turn()
        stopped.set()
        look.step(report)  # type: ignore[arg-type]
    finally:
        look.close()
