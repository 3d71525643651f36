"""Browsers before a viewer that all move their cameras: ``python -m timing.browsers PORT COUNT SECONDS``.

Prints how many images each was sent from when all were connected on, as a list.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import struct
import sys
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import viser
import zstandard
from websockets.asyncio.client import connect


def _moved(angle: float) -> bytes:
    """Return what a browser sends of a camera on a circle around the origin."""
    still: dict[str, Any] = {"near": 0.1, "far": 100.0, "look_at": [0.0] * 3, "up_direction": [0.0, 0.0, 1.0]}
    where = {"position": [-4 * math.sin(angle), 0.0, -4 * math.cos(angle)], "fov": 0.8}
    turn = {"wxyz": [math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]}
    window = {"type": "ViewerCameraMessage", "image_height": 512, "image_width": 512}
    return msgspec.msgpack.encode(window | still | where | turn)


async def _browser(port: int, all_here: Callable[[], Awaitable[Any]], seconds: float) -> int:
    protocol: Any = f"viser-v{viser.__version__}"
    options: dict[str, Any] = {
        "max_size": None,
        "compression": None,
        "open_timeout": 60,
        "ping_timeout": None,
    }
    count = 0
    async with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], **options) as socket:

        async def move() -> None:
            for tick in range(1 << 30):
                await socket.send(_moved(0.05 * tick))
                await asyncio.sleep(0.05)

        async def look() -> None:
            nonlocal count
            while True:
                raw = await socket.recv()
                assert isinstance(raw, bytes)
                length, packed = struct.unpack("<QQ", raw[:16])
                plain = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=length)
                messages = msgspec.msgpack.decode(plain)["messages"]
                count += sum(message["type"] == "BackgroundImageMessage" for message in messages)

        tasks = [asyncio.create_task(move()), asyncio.create_task(look())]
        await all_here()
        count = 0
        await asyncio.sleep(seconds)
        counted = count
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    return counted


async def _all(port: int, count: int, seconds: float) -> list[int]:
    here, full = 0, asyncio.Event()

    async def all_here() -> None:
        nonlocal here
        here += 1
        if here == count:
            full.set()
        await full.wait()

    return await asyncio.gather(*(_browser(port, all_here, seconds) for _ in range(count)))


if __name__ == "__main__":
    print(json.dumps(asyncio.run(_all(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))))
