"""The readers on official and exported data, when it is at hand."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import get_protocol, load_scene
from gridreg.scenes.load import read_folder

DATA = Path(os.environ.get("GRIDREG_DATA", Path(__file__).parents[2] / "shared" / "data"))


def folder(name: str) -> Path:
    path = DATA / name
    if not path.is_dir():
        pytest.skip(f"{name} is not under GRIDREG_DATA or beside the checkout")
    return path


def test_lego_under_dietnerf8() -> None:
    lego = folder("nerf_synthetic/lego")
    scene = load_scene(lego, "dietnerf8", test=[0, 192])
    assert scene.train.names == ("r_26", "r_86", "r_2", "r_55", "r_75", "r_93", "r_16", "r_73")
    assert scene.train.rgba.shape == (8, 400, 400, 4)
    assert scene.test.names == ("r_0", "r_192")
    assert (scene.near, scene.far, scene.builtin) == (2.0, 6.0, False)
    torch.testing.assert_close(scene.train.intrinsics[0], torch.tensor([555.5555, 555.5555, 200, 200]))
    stored = np.asarray(Image.open(lego / "train/r_26.png")).astype(np.float64) / 255
    mean = (stored[::2, ::2] + stored[1::2, ::2] + stored[::2, 1::2] + stored[1::2, 1::2]) / 4
    np.testing.assert_allclose(scene.train.rgba[0], mean, atol=1e-6)
    white = mean[..., :3] * mean[..., 3:] + 1 - mean[..., 3:]
    np.testing.assert_allclose(scene.train.composited("white")[0], white, atol=1e-6)


@pytest.mark.parametrize("name", ["lego", "chair"])
def test_all_test_views_of_the_protocol_are_there(name: str) -> None:
    scene = load_scene(folder(f"nerf_synthetic/{name}"), "dietnerf8", size=50)
    assert scene.test.ids == tuple(range(0, 200, 8))
    assert scene.test.names == tuple(f"r_{k}" for k in range(0, 200, 8))


def test_lists_more_frames_than_there_are_files() -> None:
    lego = folder("nerf_synthetic/lego")
    with pytest.raises(InputError, match=r"transforms_test\.json: frame 1: image .*test/r_1 not found"):
        load_scene(lego, "first1", test=[1], size=50)


@pytest.mark.parametrize("subject", ["subject_a", "subject_b"])
def test_bodies(subject: str) -> None:
    scene = load_scene(folder(f"human/{subject}"), "human8", size=100)
    assert scene.train.names == ("0001", "0007", "0013", "0019", "0025", "0031", "0037", "0043")
    assert len(scene.test) == 25
    # fl_x counts: camera_angle_y of this exporter would say 800 pixels and more.
    torch.testing.assert_close(
        scene.train.intrinsics[0], torch.tensor([555.5555 / 4, 555.5555 / 4, 50.0, 50.0])
    )
    assert scene.bounds.tolist() == [[-1.5] * 3, [1.5] * 3]


def test_fifty_views_of_a_body() -> None:
    scene = load_scene(folder("human/subject_b"), "human50", size=25, test=[0], validation=3)
    assert scene.train.ids == tuple(range(50))
    assert set(scene.validation.ids) <= set(range(50, 60))


@pytest.mark.parametrize(
    ("name", "protocol", "views"),
    [
        ("lego", "splatfields8", (1, 6, 15, 47, 54, 63, 69, 92)),
        ("lego", "splatfields8-ninit10", (0, 3, 6, 8, 22, 47, 70, 96)),
        ("chair", "splatfields8", (5, 8, 28, 36, 46, 78, 81, 87)),
        ("chair", "splatfields8-ninit10", (8, 13, 28, 51, 71, 76, 81, 94)),
    ],
)
def test_views_of_splatfields(name: str, protocol: str, views: tuple[int, ...]) -> None:
    files = read_folder(folder(f"nerf_synthetic/{name}"))
    positions = np.stack([frame.pose[:3, 3] for frame in files.train])
    assert get_protocol(protocol).train.select(positions) == views


def test_fox_from_its_own_list() -> None:
    scene = load_scene(folder("real/fox"), "spread3", test=[0])
    assert len(scene.train) == 3
    assert (scene.train.width, scene.train.height) == (540, 960)
    assert any("17 of 67 frames have no image and are left out" in note for note in scene.notes)
