"""Pixels that are stored as bytes are the floats they were, everywhere they are taken."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.scenes import Views, builtin_scene, load_scene
from gridreg.scenes.images import read_rgba
from gridreg.scenes.pixels import as_bytes, as_floats
from gridreg.training.rays import RayBank
from tests.test_scenes_images import encode_png16


def test_every_byte_is_the_float_that_numpy_makes_of_it() -> None:
    levels = np.tile(np.arange(256, dtype=np.uint8), 33)
    floats = np.divide(levels, 255, dtype=np.float32)
    assert torch.equal(as_floats(torch.from_numpy(levels)), torch.from_numpy(floats))
    np.testing.assert_array_equal(as_bytes(floats), levels)
    assert as_bytes(np.nextafter(floats, np.float32(2))) is None


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_scene(tmp_path_factory.mktemp("pixels"), size=24)


def test_images_of_8_bits_are_stored_as_bytes_and_seen_as_floats(scene: Path) -> None:
    views = load_scene(scene, "first8").train
    assert (views.pixels.dtype, views.rgba.dtype) == (torch.uint8, torch.float32)
    for number, name in enumerate(views.names):
        read = torch.from_numpy(read_rgba(scene / "train" / f"{name}.png"))
        assert torch.equal(views.image(number), read)
        assert torch.equal(views.rgba[number], read)


def test_one_image_of_16_bits_makes_all_of_them_floats(scene: Path, tmp_path: Path) -> None:
    listed = json.loads((scene / "transforms_train.json").read_text())
    listed["frames"] = listed["frames"][:4]
    wanted = {}
    for number, frame in enumerate(listed["frames"]):
        pixels = imageio.imread(scene / f"{frame['file_path']}.png")
        if number == 2:
            deep = np.minimum(pixels.astype(np.uint16) * 257, 65500)
            wanted[str(number)] = np.divide(deep, 65535, dtype=np.float32)
            (tmp_path / "2.png").write_bytes(encode_png16(deep, [0] * len(deep)))
        else:
            wanted[str(number)] = np.divide(pixels, 255, dtype=np.float32)
            imageio.imwrite(tmp_path / f"{number}.png", pixels)
        frame["file_path"] = f"{number}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(listed))
    views = load_scene(tmp_path, "first2", test=()).train
    assert "2" in views.names
    assert torch.equal(views.rgba, torch.from_numpy(np.stack([wanted[name] for name in views.names])))


def test_reduced_images_keep_their_means(scene: Path) -> None:
    whole, half = load_scene(scene, "first8").train, load_scene(scene, "first8", size=12).train
    means = whole.rgba.reshape(8, 12, 2, 12, 2, 4)[..., 3].mean(dim=(2, 4))
    assert half.pixels.dtype == torch.float32
    torch.testing.assert_close(half.rgba[..., 3], means)


def test_bytes_and_floats_are_the_same_to_training_and_scoring(scene: Path) -> None:
    stored = load_scene(scene, "first8").train
    floats = replace(stored, pixels=stored.rgba)
    assert floats.pixels.dtype == torch.float32
    assert torch.equal(stored.composited((0.2, 0.5, 0.7)), floats.composited((0.2, 0.5, 0.7)))
    assert torch.equal(stored.silhouettes, floats.silhouettes)
    assert stored.plain == floats.plain
    assert stored.shows_room == floats.shows_room
    opaque = stored.pixels.clone()
    opaque[..., 3] = 255
    opaque[:, :3], opaque[:, -3:], opaque[:, :, :3], opaque[:, :, -3:] = 204, 204, 204, 204
    opaque[..., 3] = 255
    paper = replace(stored, pixels=opaque), replace(stored, pixels=as_floats(opaque))
    assert paper[0].backdrop is not None
    assert torch.equal(paper[0].backdrop, paper[1].backdrop)
    torch.testing.assert_close(paper[0].silhouettes, paper[1].silhouettes, rtol=0, atol=0, equal_nan=True)
    for alpha in (None, torch.full(stored.pixels.shape[:3], torch.nan)):
        drawn = []
        for views in (stored, floats):
            bank = RayBank(views, reshuffle=alpha is None, alpha=alpha)
            bank.restrict(lambda rays: rays.directions[:, 0] > 0, chunk=1000)
            rays, rgba = bank.draw(5000, torch.Generator().manual_seed(1))
            assert rgba.dtype == torch.float32
            drawn.append((rays.origins, rays.directions, rgba, bank.active))
        for one, two in zip(*drawn, strict=True):
            torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)


def test_other_kinds_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"pixels: found torch.float64, expected float32 in \[0, 1\] or uint8"
    ):
        Views(torch.ones(1, 2, 2, 4).double(), torch.eye(4)[None], torch.ones(1, 4), ("a",), (0,))
