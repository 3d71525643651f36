"""The viewer's door: its own page and nobody else, and nothing but what that page has a use for."""

from __future__ import annotations

import asyncio
import http.client
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gridreg.export import _admission
from gridreg.export._admission import Admission, admissible, bounded_receive, of_this_user
from gridreg.export.viewer import Viewer
from tests.export_fields import ball_model

viser = pytest.importorskip("viser", reason="viser (extra 'viewer') is not installed")

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, -4.0, 1.0], "fov": 0.8,
    "near": 0.1, "far": 100.0, "image_height": 64, "image_width": 64, "look_at": [0.0] * 3,
    "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip


def packed(**message: Any) -> bytes:
    import msgspec

    return msgspec.msgpack.encode(message)


@pytest.fixture(scope="module")
def local() -> Iterator[Viewer]:
    with Viewer(ball_model(step=100), port=0, quiet=True) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def network() -> Iterator[Viewer]:
    with Viewer(ball_model(step=100), host="0.0.0.0", port=0, quiet=True) as viewer:
        yield viewer


def get(viewer: Viewer, path: str = "/", **headers: str) -> tuple[int, http.client.HTTPMessage, bytes]:
    with closing(http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def sees(viewer: Viewer, **headers: str) -> bool:
    """Whether a program that connects with some headers is sent anything."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import InvalidStatus

    name = headers.pop("Host", f"127.0.0.1:{viewer.port}")
    options = {
        "host": "127.0.0.1", "port": viewer.port, "subprotocols": [f"viser-v{viser.__version__}"],
        "additional_headers": headers, "compression": None, "max_size": None, "proxy": None,
    }  # fmt: skip

    async def ask() -> bool:
        try:
            async with connect(f"ws://{name}", **options) as socket:
                await socket.send(packed(**CAMERA))
                return bool(await asyncio.wait_for(socket.recv(), 20))
        except InvalidStatus as refused:
            return refused.response.status_code != 403

    return asyncio.run(ask())


def test_its_own_page_is_answered(local: Viewer) -> None:
    status, headers, _ = get(local)
    assert status == 200
    assert (headers["X-Frame-Options"], headers["Referrer-Policy"]) == ("DENY", "no-referrer")
    assert sees(local)
    assert sees(local, Origin=f"http://127.0.0.1:{local.port}")
    # Through a tunnel the page has another port.
    assert sees(local, Origin="http://localhost:9000", Host="localhost:9000")


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
        {"Host": "127.0.0.1.evil.example:{port}"},
        {"Host": "[::2]:{port}"},
    ],
)
def test_no_other_page_is(local: Viewer, headers: dict[str, str]) -> None:
    given = {key: value.format(port=local.port) for key, value in headers.items()}
    assert not sees(local, **given)
    assert get(local, **given)[0] == 403


def test_another_user_of_the_machine_needs_the_token(local: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_admission, "of_this_user", lambda connection: False)
    assert not sees(local)
    assert get(local)[0] == 403
    assert get(local, f"/?token={local._admission.token}")[0] == 200


def test_the_network_needs_the_token_that_becomes_a_cookie(network: Viewer) -> None:
    token = network._admission.token
    for path in (
        "/",
        "/?token=",
        f"/?token={token[:-1]}",
        f"/?token={token}x",
        "/?token=%C3%A4",
        "/?token=%FF",
    ):
        assert get(network, path)[0] == 403
    assert not sees(network)
    assert not sees(network, Cookie=f"gridreg-1={token}")
    status, headers, _ = get(network, network.url.partition(str(network.port))[2])
    assert status == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert sees(network, Cookie=f"other=1; {cookie.partition(';')[0]}")
    # A page of another site has no origin of ours, token or not.
    assert not sees(network, Cookie=cookie.partition(";")[0], Origin="http://evil.example")


def test_two_viewers_have_two_tokens() -> None:
    assert Admission("0.0.0.0").token != Admission("0.0.0.0").token
    assert Admission("192.0.2.1").needs_token


def test_no_more_browsers_than_can_be_served(network: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_admission, "MOST_CLIENTS", 0)
    assert get(network, f"/?token={network._admission.token}")[0] == 503


def test_the_kernel_knows_whose_a_connection_is(tmp_path: Path) -> None:
    connection = SimpleNamespace(remote_address=("127.0.0.1", 0xABCD), local_address=("127.0.0.1", 0x1F90))
    line = "   0: 0100007F:ABCD 0100007F:1F90 01 00000000:00000000 00:00000000 00000000  {uid}  0 1\n"
    head = "  sl  local_address rem_address st tx_queue rx_queue tr tm->when retrnsmt uid timeout inode\n"
    table = tmp_path / "tcp"
    for uids, ours in (
        ([os.getuid()], True),
        ([os.getuid() + 1], False),
        ([os.getuid(), 12345], False),
        ([], False),
    ):
        table.write_text(head + "".join(line.format(uid=uid) for uid in uids))
        assert of_this_user(connection, tmp_path) is ours
    assert not of_this_user(connection, tmp_path / "none")


@pytest.mark.parametrize(
    ("change", "right"),
    [
        ({}, True),
        ({"image_height": 9000}, False),
        ({"image_width": -1}, False),
        ({"image_width": "64"}, False),
        ({"fov": float("nan")}, False),
        ({"position": [0.0, float("inf"), 0.0]}, False),
        ({"position": [0.0, 1e300, 0.0]}, False),
        ({"wxyz": [1.0]}, False),
        ({"look_at": None}, False),
        ({"type": "RunJavascriptMessage"}, False),
        ({"type": ["a"]}, False),
    ],
)
def test_cameras_are_checked(change: dict[str, Any], right: bool) -> None:
    assert admissible(packed(**{**CAMERA, **change})) is right


@pytest.mark.parametrize(
    ("updates", "right"),
    [
        ({"value": 512}, True),
        ({"value": True}, True),
        ({"value": "depth"}, True),
        ({"value": float("nan")}, False),
        ({"value": "x" * 1000}, False),
        ({"value": [1, 2]}, False),
        ({"update_cb": []}, False),
        ({"value": 1, "label": "Free money"}, False),
        ([], False),
    ],
)
def test_controls_take_values_alone(updates: Any, right: bool) -> None:
    assert admissible(packed(type="GuiUpdateMessage", uuid="a", updates=updates)) is right


@pytest.mark.parametrize("raw", [b"", b"\xc1", b"\x93", packed(a=1), b"\x91" * 5000, b"\x01"])
def test_noise_is_dropped(raw: bytes) -> None:
    assert not admissible(raw)


def test_only_so_many_messages_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_admission, "MOST_PER_SECOND", 3)
    slept: list[float] = []

    async def nap(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr(_admission.asyncio, "sleep", nap)

    async def receive() -> bytes:
        return packed(**CAMERA)

    async def several() -> None:
        bounded = bounded_receive(receive)
        for _ in range(5):
            await bounded()

    asyncio.run(several())
    assert len(slept) == 2
    assert all(0 < seconds <= 1 for seconds in slept)
