"""Admission to the viewer's server: every request and every message passes here."""

from __future__ import annotations

import asyncio
import hmac
import html
import http
import logging
import math
import os
import secrets
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import parse_qs, urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_CLIENTS = 16
MOST_BYTES = 1 << 16
"""Size of one message; a camera has a few hundred."""
MOST_PER_SECOND = 200
"""Messages that one browser may send; a camera in motion sends sixty."""
LARGEST_WINDOW = 8192
"""Pixels along an edge."""
_SILENT = logging.getLogger("gridreg.viewer")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False
_CAMERA = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3, "fov": 0, "near": 0, "far": 0}
_TYPES = ("ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage")


class Admission:
    """Answers the viewer's own page alone.

    A page of another site cannot ask: browsers name the origin of what asks, and it must be this server, under a name
    of this machine where it listens on loopback (a name that somebody points to 127.0.0.1 is none). Another user of
    the machine, and anybody on the network, needs the token: from the address that is printed it becomes a cookie.
    On loopback the kernel says which user has connected, and who started the viewer needs no token.

    Args:
        host: address that the server listens on.
        title: of the page, in the browser's tab.
    """

    def __init__(self, host: str, title: str = "gridreg") -> None:
        self.title = title
        self.local = host in LOOPBACK
        self.token = secrets.token_urlsafe(16)
        self.needs_token = not (self.local and Path("/proc/net/tcp").is_file())
        self.server: Any = None

    @contextmanager
    def at_the_door(self) -> Iterator[None]:
        """Let the server that is started within stand behind this one."""
        import websockets.asyncio.server as sockets

        original = sockets.serve

        def serve(handler: Any, *address: Any, process_request: Any, **options: Any) -> Any:
            async def bounded(connection: Any) -> None:
                """Handle a connection, of which only admissible messages arrive."""
                connection.recv = bounded_receive(connection.recv)
                await handler(connection)

            def guarded(connection: Any, request: Any) -> Any:
                try:
                    refused = self.refusal(connection, request)
                    if refused is not None:
                        return connection.respond(*refused)
                    page = urlsplit(request.path).path in ("/", "/index.html")
                    if page and "Accept-Encoding" in request.headers:
                        # Uncompressed, so that its title can be set.
                        del request.headers["Accept-Encoding"]
                    response = process_request(connection, request)
                # A path or an address that is none.
                except (ValueError, OSError):
                    return connection.respond(http.HTTPStatus.BAD_REQUEST, "viewer: a strange request\n")
                if response is not None:
                    self._entitle(response)
                    self._seal(response, request, connection)
                return response

            options["max_size"] = MOST_BYTES
            # Whatever arrives at the port that is no HTTP is no news for whoever trains.
            options["logger"] = _SILENT
            return original(bounded, *address, process_request=guarded, **options)

        with mock.patch.object(sockets, "serve", serve):
            yield

    def refusal(self, connection: Any, request: Any) -> tuple[http.HTTPStatus, str] | None:
        """Return status and text for a request that is not answered; None: it is."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        name = urlsplit(f"//{hosts[0]}").hostname if len(hosts) == 1 else None
        if name is None or (self.local and name not in LOOPBACK):
            return http.HTTPStatus.FORBIDDEN, "viewer: not an address of this server\n"
        if origins and origins != [f"http://{hosts[0]}"]:
            return http.HTTPStatus.FORBIDDEN, "viewer: answers only its own page\n"
        if not (self._has_token(connection, request) or (self.local and of_this_user(connection))):
            return (
                http.HTTPStatus.FORBIDDEN,
                "viewer: expected the address with the token that gridreg printed\n",
            )
        if self.server is not None and len(self.server._live_connections) >= MOST_CLIENTS:
            return http.HTTPStatus.SERVICE_UNAVAILABLE, f"viewer: {MOST_CLIENTS} browsers look already\n"
        return None

    def _has_token(self, connection: Any, request: Any) -> bool:
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        for line in request.headers.get_all("Cookie"):
            pairs = (part.strip().partition("=") for part in line.split(";"))
            given += [value for key, _, value in pairs if key == self._cookie(connection)]
        return any(hmac.compare_digest(text.encode(), self.token.encode()) for text in given)

    def _cookie(self, connection: Any) -> str:
        """Cookies of one host are shared by all its ports."""
        return f"gridreg-{connection.local_address[1]}"

    def _entitle(self, response: Any) -> None:
        body = response.body.replace(
            b"<title>Viser</title>", f"<title>{html.escape(self.title)}</title>".encode()
        )
        if body != response.body:
            response.body = body
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(body))

    def _seal(self, response: Any, request: Any, connection: Any) -> None:
        response.headers["X-Frame-Options"] = "DENY"
        response.headers["Referrer-Policy"] = "no-referrer"
        if self._has_token(connection, request):
            cookie = f"{self._cookie(connection)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = cookie


def of_this_user(connection: Any, folder: Path = Path("/proc/net")) -> bool:
    """Return whether the other end of a connection within this machine belongs to our own user (Linux)."""
    peer, own = (f":{address[1]:04X}" for address in (connection.remote_address, connection.local_address))
    users = set()
    for name in ("tcp", "tcp6"):
        try:
            lines = (folder / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for words in map(str.split, lines):
            if words[1].endswith(peer) and words[2].endswith(own):
                users.add(int(words[7]))
    return users == {os.getuid()}


def bounded_receive(receive: Callable[[], Awaitable[Any]]) -> Callable[[], Awaitable[bytes]]:
    """Return a connection's ``recv`` that passes on what is admissible, at most so many messages a second."""
    began, count = time.monotonic(), 0

    async def bounded() -> bytes:
        """The next admissible message."""
        nonlocal began, count
        while True:
            raw = await receive()
            count += 1
            now = time.monotonic()
            if now - began >= 1:
                began, count = now, 1
            elif count > MOST_PER_SECOND:
                await asyncio.sleep(began + 1 - now)
            if isinstance(raw, bytes) and admissible(raw):
                return raw

    return bounded


def admissible(raw: bytes) -> bool:
    """Return whether a message is one of those that the page has a use for, with values that make sense."""
    import msgspec

    try:
        message = msgspec.msgpack.decode(raw)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return False
    kind = message.get("type") if isinstance(message, dict) else None
    if kind == "ViewerCameraMessage":
        window = (message.get("image_height"), message.get("image_width"))
        sized = all(isinstance(edge, int) and 0 <= edge <= LARGEST_WINDOW for edge in window)
        return sized and all(_finite(message.get(key), length) for key, length in _CAMERA.items())
    if kind == "GuiUpdateMessage":
        updates = message.get("updates")
        return isinstance(updates, dict) and list(updates) == ["value"] and _plain(updates["value"])
    return kind in _TYPES


def _finite(value: Any, length: int) -> bool:
    numbers = value if length else [value]
    if not isinstance(numbers, (list, tuple)) or len(numbers) != (length or 1):
        return False
    return all(isinstance(x, (int, float)) and math.isfinite(x) and abs(x) < 1e9 for x in numbers)


def _plain(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= 100
    return isinstance(value, (int, float)) and math.isfinite(value)
