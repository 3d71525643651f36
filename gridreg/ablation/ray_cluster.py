"""Reaching a Ray cluster, or starting one on this machine; an address that does not answer is named soon."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gridreg.errors import InputError

ANSWER_SECONDS = 20.0
"""Time that an address may take to answer."""


def import_ray(address: str | None = None) -> Any:
    """The module ``ray``.

    Args:
        address: that it is going to connect to; None: a cluster of this machine's own, which nobody else shall reach.

    Raises:
        InputError: if it is not installed.
    """
    # Ray would tell its makers about the cluster otherwise, and waits for them when there is no network.
    settings = {"RAY_USAGE_STATS_ENABLED": "0"}
    # Ray warns of a change to come otherwise; tasks here ask for no accelerator.
    settings["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
    if address is None:
        # Whoever reaches Ray's ports runs what they like here. Without clusters, which Ray allows by default on Linux
        # only, it listens on the loopback interface alone; there it asks other users for the token.
        settings["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        settings["RAY_AUTH_MODE"] = "token"
        if "RAY_AUTH_TOKEN_PATH" not in os.environ:
            settings["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    for name, value in settings.items():
        os.environ.setdefault(name, value)
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
        options["address"] = _find(ray) if address == "auto" else address
        check_answers(options["address"])
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
    """Make sure that a Ray cluster answers: ``ray.init`` itself would try for minutes, and print as it does.

    Args:
        address: ``HOST:PORT`` or ``ray://HOST:PORT``.
        seconds: to wait at most.

    Raises:
        InputError: if none does.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--address: found {address!r}, expected auto, HOST:PORT or ray://HOST:PORT")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=seconds).close()
        if not address.startswith("ray://"):
            # Of Ray's client server, which has no health check, an open port must do.
            command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
            subprocess.run(command, capture_output=True, timeout=seconds, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "no answer"
        raise InputError(f"--address: no Ray cluster answers at {address} ({reason})") from error


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
