"""A browser that a test plays, for the viewer's server side."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation


class FakeClient:
    """What the viewer asks of a browser, without one."""

    def __init__(self, pose: torch.Tensor, size: tuple[int, int] = (60, 80)) -> None:
        self.client_id = 7
        self.images: list[np.ndarray] = []
        self.files: list[tuple[str, bytes]] = []
        self.moved: Any = None
        self.camera = SimpleNamespace(
            image_height=size[0], image_width=size[1], fov=math.radians(50), on_update=self._listen
        )
        self.scene = SimpleNamespace(set_background_image=self._show)
        self.place(pose)

    def _listen(self, callback: Any) -> Any:
        self.moved = callback
        return callback

    def _show(self, pixels: np.ndarray, **_: Any) -> None:
        self.images.append(pixels)

    def send_file_download(self, name: str, content: bytes, **_: Any) -> None:
        self.files.append((name, content))

    def place(self, pose: torch.Tensor) -> None:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3].double().numpy() @ np.diag([1, -1, -1])).as_quat()
        self.camera.wxyz, self.camera.position = np.array([w, x, y, z]), pose[:3, 3].numpy()
