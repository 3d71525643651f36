"""A headless Chromium, driven through its DevTools protocol, for tests of pages."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class Page:
    """One tab: what it logs, what it looks like, and a mouse."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._last = socket, 0
        self.problems: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, timeout: float = 90.0, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol; what the page says meanwhile is collected."""
        self._last += 1
        self._socket.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        end = time.monotonic() + timeout
        while True:
            message = json.loads(self._socket.recv(timeout=max(0.1, end - time.monotonic())))
            if message.get("id") == self._last:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        method, said = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(said["exceptionDetails"])[:500])
        if method == "Runtime.consoleAPICalled" and said["type"] in ("error", "assert"):
            self.problems.append(json.dumps(said["args"])[:500])
        if method == "Log.entryAdded" and said["entry"]["level"] == "error":
            self.problems.append(json.dumps(said["entry"])[:500])

    def open(self, url: str) -> None:
        """Go to an address and wait until it is loaded."""
        self.call("Page.navigate", url=url)
        self.until(lambda: self.evaluate("document.readyState + location.href").startswith(f"complete{url}"))

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def screenshot(self) -> NDArray[np.uint8]:
        """What is seen, ``(H, W, 3)``."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def until(self, condition: Callable[[], Any], seconds: float = 90.0) -> Any:
        """Wait for a condition; its value."""
        end = time.monotonic() + seconds
        while True:
            value = condition()
            if value:
                return value
            assert time.monotonic() < end, f"not within {seconds} s; the page said {self.problems}"
            time.sleep(0.1)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 5) -> None:
        """Press the left button at one place, move, release at another."""
        self._mouse("mouseMoved", start, 0)
        self._mouse("mousePressed", start, 1)
        for i in range(1, steps + 1):
            share = i / steps
            self._mouse(
                "mouseMoved",
                (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])),
                1,
            )
            time.sleep(0.02)
        self._mouse("mouseReleased", end, 0)

    def click(self, place: tuple[float, float]) -> None:
        self.drag(place, place, steps=1)

    def press(self, key: str) -> None:
        """A key by its DOM name, such as "Home" or "ArrowRight"."""
        codes = {"Home": 36, "End": 35, "ArrowLeft": 37, "ArrowRight": 39, "ArrowDown": 40, "Enter": 13}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=codes[key]
            )

    def _mouse(self, kind: str, place: tuple[float, float], buttons: int) -> None:
        self.call(
            "Input.dispatchMouseEvent",
            type=kind, x=place[0], y=place[1], button="left", buttons=buttons, clickCount=1,
        )  # fmt: skip


@contextlib.contextmanager
def open_page(folder: Path, size: tuple[int, int] = (900, 600)) -> Iterator[Page]:
    """A new headless browser with one empty tab; the test is skipped where there is none.

    Args:
        folder: for its profile and downloads.
        size: of the window, pixels.
    """
    client = pytest.importorskip(
        "websockets.sync.client", reason="websockets (of the viewer extra) is missing"
    )
    program = next((path for name in PROGRAMS if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(PROGRAMS)} is installed")
    profile = folder / "profile"
    command = [
        program, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--mute-audio",
        "--disable-extensions", "--disable-background-networking", "--remote-debugging-port=0",
        # Without a graphics card, WebGL is drawn by the processor.
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "about:blank",
    ]  # fmt: skip
    with open(folder / "chromium.log", "wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            port = _devtools_port(profile / "DevToolsActivePort", process)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=20) as answer:
                tabs = [tab for tab in json.loads(answer.read()) if tab["type"] == "page"]
            with client.connect(tabs[0]["webSocketDebuggerUrl"], max_size=None, proxy=None) as socket:
                page = Page(socket)
                page.call(
                    "Emulation.setDeviceMetricsOverride",
                    width=size[0], height=size[1], deviceScaleFactor=1, mobile=False,
                )  # fmt: skip
                yield page
        finally:
            process.terminate()
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _devtools_port(file: Path, process: subprocess.Popen[bytes], seconds: float = 90.0) -> int:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if process.poll() is not None:
            pytest.skip(f"the browser does not start here (status {process.returncode})")
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(file.read_text().splitlines()[0])
        time.sleep(0.1)
    pytest.skip(f"the browser did not start within {seconds} s")
