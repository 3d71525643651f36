"""Reaching a Ray cluster, or starting one on this machine; an address that does not answer is named soon."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gridreg.errors import InputError

__all__ = ["ANSWER_SECONDS", "check_answers", "connected", "import_ray"]

ANSWER_SECONDS = 5.0
"""How long an address may take to answer."""

# HTTP/2 (RFC 9113): the types of frames that matter here, and the flags that end headers and a stream.
_DATA, _HEADERS, _SETTINGS = 0, 1, 4
_END_STREAM, _END_HEADERS = 1, 4
_STATUS_200 = 0x88


def import_ray(address: str | None = None) -> Any:
    """The module ``ray``.

    Args:
        address: that it is going to connect to.

    Raises:
        InputError: if it is not installed.
    """
    # Ray would tell its makers about the cluster otherwise, and waits for them when there is no network.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Ray warns of a change to come otherwise; tasks here ask for no accelerator.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if address is not None:
        # Ray asks once a second, by default for twenty.
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "8")
    try:
        import ray
    except ImportError as error:
        raise InputError(f"--runner ray: Ray is not installed ({error}); install gridreg[ray]") from None
    return ray


@contextmanager
def connected(address: str | None, cpus: int) -> Iterator[Any]:
    """The module ``ray`` while it is connected.

    Args:
        address: ``auto``, ``HOST:PORT`` or ``ray://HOST:PORT``; None: a cluster of this machine's own, which ends with
            the block.
        cpus: of that one.

    Raises:
        InputError: if the address does not answer, or Ray is not installed.
    """
    ray = import_ray(address)
    if ray.is_initialized():
        # The caller's own connection, which the caller ends.
        yield ray
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": True}
    if address is None:
        options |= {"address": "local", "num_cpus": cpus, "include_dashboard": False}
    else:
        place = _find(ray) if address == "auto" else address
        check_answers(place)
        options["address"] = place
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError) as error:
        line = " ".join(str(error).split())
        raise InputError(
            f"--address: no use of the Ray cluster at {address or 'this machine'}: {line}"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def check_answers(address: str, seconds: float = ANSWER_SECONDS) -> None:
    """Make sure that something answers at an address that speaks Ray's protocol.

    Args:
        address: ``HOST:PORT`` or ``ray://HOST:PORT``.
        seconds: to wait at most.

    Raises:
        InputError: if nothing does.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--address: found {address!r}, expected auto, HOST:PORT or ray://HOST:PORT")
    end = time.monotonic() + seconds
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=seconds) as connection:
            # With TLS the greeting would have to be encrypted; that the port is open must do.
            if os.environ.get("RAY_USE_TLS", "0") != "1":
                _greet(connection, end)
    except OSError as error:
        reason = "no answer" if isinstance(error, TimeoutError) else error.strerror or str(error)
        raise InputError(f"--address: no Ray cluster answers at {address} ({reason})") from error


def _greet(connection: socket.socket, end: float) -> None:
    """Ask for its health, as every gRPC server lets one: Ray itself would try for long, and print as it does."""
    connection.sendall(
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
        + _frame(_SETTINGS, 0, 0, b"")
        + _frame(_HEADERS, _END_HEADERS, 1, _question())
        + _frame(_DATA, _END_STREAM, 1, bytes(5))
    )
    kind, content = -1, b""
    while kind != _HEADERS:
        head = _receive(connection, 9, end)
        kind, length = head[3], int.from_bytes(head[:3], "big")
        if length > 1 << 14:
            raise OSError(0, "another program listens there")
        content = _receive(connection, length, end)
    # The status is the first header; it stands in the table that every HTTP/2 program knows (RFC 7541).
    if content[:1] != bytes([_STATUS_200]):
        raise OSError(0, "another program listens there")


def _question() -> bytes:
    """Headers of a gRPC call, without Huffman codes."""

    def text(value: bytes) -> bytes:
        return bytes([len(value)]) + value

    return (
        bytes([0x83, 0x86])  # :method POST, :scheme http
        + b"\x04"  # :path
        + text(b"/grpc.health.v1.Health/Check")
        + b"\x01"  # :authority
        + text(b"ray")
        + b"\x0f\x10"  # content-type
        + text(b"application/grpc")
        + b"\x00"
        + text(b"te")
        + text(b"trailers")
    )


def _frame(kind: int, flags: int, stream: int, content: bytes) -> bytes:
    return len(content).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + content


def _receive(connection: socket.socket, count: int, end: float) -> bytes:
    data = b""
    while len(data) < count:
        connection.settimeout(max(0.01, end - time.monotonic()))
        part = connection.recv(count - len(data))
        if not part:
            raise OSError(0, "the connection was closed")
        data += part
    return data


def _find(ray: Any) -> str:
    """The address that ``auto`` stands for."""
    found = os.environ.get("RAY_ADDRESS")
    if not found or found in ("auto", "local"):
        with contextlib.suppress(Exception):
            found = ray._private.services.canonicalize_bootstrap_address("auto")
    if not found:
        raise InputError(
            "--address auto: found no Ray cluster on this machine; start one with `ray start --head`, or give HOST:PORT"
        )
    return str(found)
