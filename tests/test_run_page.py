"""The page of a run: right geometry and colours, whole in one file, nothing that could be markup, and in a browser."""

from __future__ import annotations

import base64
import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from gridreg.errors import InputError
from gridreg.export import Mesh, save_mesh, write_page
from gridreg.export import page as page_module
from gridreg.rendering import Rendered
from gridreg.scenes import Scene, Views, World
from gridreg.training.evaluate import Scored
from gridreg.training.files import write_json
from gridreg.training.outputs import save_scored
from tests.chromium import open_page
from tests.export_fields import ring_of_views

NAME = '<img src=x onerror="document.title=1">'
WORLD = World((10.0, 20.0, 30.0), 2.0)
#: Red, green, blue by the direction of the nearest face: +x red, +y green, +z blue, the others grey.
HALF = np.array([0.5, 0.4, 0.8])


def box_mesh() -> Mesh:
    """A box around the origin whose faces have one colour each."""
    box = trimesh.creation.box(extents=2 * HALF)
    vertices, faces = box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(12, 3)
    colours = np.full((12, 3), 90, dtype=np.uint8)
    for axis in range(3):
        colours[box.face_normals[:, axis] > 0.9] = 200 * np.eye(3, dtype=np.uint8)[axis]
    return Mesh(WORLD.outward(vertices), faces, colours.repeat(3, axis=0))


def scene_of(views: Views) -> Scene:
    bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return Scene("box", "all", views, views, 0.5, 6.0, bounds, torch.ones(3), "print", world=WORLD)


@pytest.fixture(scope="module")
def views() -> Views:
    found = ring_of_views(6)
    found.rgba[..., 3] = 1
    found.rgba[..., :3] = torch.linspace(0.2, 0.9, 6)[:, None, None, None]
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's folder as train leaves it, but for the checkpoint."""
    save_mesh(box_mesh(), tmp_path / "mesh.ply")
    (tmp_path / "test").mkdir()
    scores = {}
    for name, value in (("r_2", 0.25), ("r_10", 0.5)):
        image, target = torch.full((30, 40, 3), value), torch.full((30, 40, 3), value / 2)
        scores[name] = {"psnr": 20 + value, "ssim_gaussian": value}
        rendered = Rendered(image, image[..., 0], image[..., 0])
        save_scored(tmp_path / "test", Scored(name, rendered, target, scores[name]))
    record = {"scene": NAME, "mean": {"psnr": 20.375, "ssim_gaussian": 0.375}, "images": scores}
    more = {
        "test_views": 2,
        "protocol": "all",
        "train_views": list("abcdef"),
        "command": ["gridreg", NAME, "a/long/path" * 20],
    }
    write_json(tmp_path / "metrics.json", {**record, **more})
    lines = [json.dumps({"step": step, "psnr": 10.0 + step}) for step in range(1, 9)]
    (tmp_path / "history.jsonl").write_text("\n".join(lines) + "\n")
    (tmp_path / "turntable.mp4").write_bytes(b"not really a video")
    return tmp_path


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None
    return dict(json.loads(found[1]))


def test_one_file_that_asks_for_nothing(folder: Path, views: Views) -> None:
    path = write_page(folder, scene_of(views))
    text = path.read_text()
    assert path == folder / "index.html"
    assert not re.search(
        r"(https?:)?//[a-z]", re.sub(r'"[A-Za-z0-9+/=]{40,}"|base64,[A-Za-z0-9+/=]+', "", text)
    )
    assert set(re.findall(r'src="(.{5})', text)) == {"data:"}
    assert "default-src 'none'" in text
    assert "<img src=x" not in text
    assert "&lt;img src=x onerror=" in text
    assert "Made of 6 photographs" in text
    assert "20.38 dB" in text
    # The views in the order of their numbers, with their own scores.
    assert text.index("20.25 dB") < text.index("20.50 dB")
    assert base64.b64encode(b"not really a video").decode() in text
    assert "training batches" in text


def test_the_mesh_is_the_one_of_the_file(folder: Path, views: Views) -> None:
    data = data_of(write_page(folder, scene_of(views)).read_text())
    mesh = box_mesh()
    low, high = np.array(data["low"]), np.array(data["high"])
    np.testing.assert_allclose([low, high], WORLD.outward(np.stack([-HALF, HALF])), atol=1e-5)
    places = np.frombuffer(base64.b64decode(data["places"]), "<u2").reshape(-1, 3) / 65535
    np.testing.assert_allclose(low + places * (high - low), mesh.vertices, atol=1e-4)
    assert (np.frombuffer(base64.b64decode(data["colours"]), "u1").reshape(-1, 3) == mesh.colours).all()
    assert (np.frombuffer(base64.b64decode(data["faces"]), "<u2").reshape(-1, 3) == mesh.faces).all()
    # The first camera is three units from the middle, in the world of the mesh.
    pose = np.array(data["cameras"][0]["pose"]).reshape(3, 4)
    assert np.linalg.norm(pose[:, 3] - WORLD.origin) == pytest.approx(6.0, abs=1e-4)
    fx, fy, cx, cy = views.intrinsics[0].tolist()
    np.testing.assert_allclose(
        data["cameras"][0]["edges"], [-cx / fx, (40 - cx) / fx, (cy - 30) / fy, cy / fy], rtol=1e-6
    )


def test_a_large_mesh_has_fewer_faces(folder: Path, views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    red = np.tile(np.array([200, 0, 0], dtype=np.uint8), (len(ball.vertices), 1))
    save_mesh(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces), red), folder / "mesh.ply")
    monkeypatch.setattr(page_module, "FACES", 500)
    data = data_of(write_page(folder).read_text())
    assert 400 < len(base64.b64decode(data["faces"])) / 6 <= 500
    assert set(np.frombuffer(base64.b64decode(data["colours"]), "u1").reshape(-1, 3)[:, 0]) == {200}


def test_a_large_video_is_a_link_where_the_page_is(folder: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(page_module, "VIDEO_BYTES", 4)
    assert '<a href="turntable.mp4">' in write_page(folder).read_text()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    text = write_page(elsewhere, run=folder).read_text()
    assert "turntable" not in text
    assert 'id="data"' in text


def test_a_folder_with_nothing_says_so(tmp_path: Path) -> None:
    text = write_page(tmp_path).read_text()
    assert "There is no mesh to turn: gridreg mesh makes one" in text
    for part in ("score", "views", "curves", "video", "provenance"):
        assert f'id="{part}"' not in text


@pytest.mark.parametrize("content", ["{", "[]", '{"mean": 1}'])
def test_a_damaged_score_is_named(folder: Path, content: str) -> None:
    (folder / "metrics.json").write_text(content)
    before = (folder / "index.html").exists()
    with pytest.raises(InputError, match=r"metrics\.json: (cannot read the score|found no score)"):
        write_page(folder)
    assert (folder / "index.html").exists() == before


def projected(pose: np.ndarray, edges: list[float], size: tuple[int, int], point: np.ndarray) -> np.ndarray:
    """The pixel of a point in a window that shows the whole image in its middle (a pinhole camera, by hand)."""
    local = (point - pose[:, 3]) @ pose[:, :3]
    scale = max((edges[1] - edges[0]) / size[0], (edges[3] - edges[2]) / size[1])
    return np.array([size[0] / 2 + local[0] / -local[2] / scale, size[1] / 2 - local[1] / -local[2] / scale])


def test_in_a_browser(folder: Path, views: Views, tmp_path: Path) -> None:
    path = write_page(folder, scene_of(views))
    data = data_of(path.read_text())
    with open_page(tmp_path, (900, 900)) as page:
        page.open(path.as_uri())
        page.evaluate("document.getElementById('cameras').click()")
        box = page.evaluate(
            "(b => [b.x, b.y, b.width, b.height])(document.querySelector('canvas').getBoundingClientRect())"
        )
        corner, size = np.array(box[:2]), (box[2], box[3])
        middles = {axis: WORLD.outward(HALF[axis] * np.eye(3)[axis]) for axis in range(3)}
        for number, axis in ((0, 0), (1, 1), (1, 2)):
            pose = np.array(data["cameras"][number]["pose"]).reshape(3, 4)
            page.evaluate(f"document.querySelectorAll('.strip button')[{number}].click()")
            page.until(lambda n=number: page.evaluate(f"strip[{n}].getAttribute('aria-pressed')") == "true")
            time.sleep(0.9)
            # The middle of a face is seen where the camera's pinhole puts it, in the colour of the face.
            x, y = (
                (corner + projected(pose, data["cameras"][number]["edges"], size, middles[axis]))
                .round()
                .astype(int)
            )
            assert page.screenshot()[y, x].tolist() == (200 * np.eye(3, dtype=int)[axis]).tolist()
        # A drag turns the object, the button brings it back.
        before = page.evaluate("view.axes[2]")
        page.drag((corner[0] + 60, corner[1] + 60), (corner[0] + 200, corner[1] + 60))
        after = page.evaluate("view.axes[2]")
        angle = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
        assert np.cos(angle + 140 / 130) == pytest.approx(1.0, abs=1e-3)
        page.evaluate("document.getElementById('reset').click()")
        page.until(lambda: np.allclose(page.evaluate("view.target"), WORLD.origin, atol=1e-4))
        # A photograph in the scene is a way to its camera.
        page.evaluate("document.getElementById('cameras').click()")
        time.sleep(0.9)
        assert page.evaluate("strip.some(b => b.getAttribute('aria-pressed') === 'true')") is False
        page.evaluate("nearer(3)")
        time.sleep(0.3)
        pixels = page.evaluate("data.cameras.map(pixelOf)")
        inside = [
            (w, i)
            for i, (x, y, w) in enumerate(pixels)
            if (np.abs(corner + np.array(size) / 2 - (x, y)) < 0.48 * np.array(size)).all()
        ]
        nearest = min(inside)[1]
        x, y = pixels[nearest][:2]
        shade = round(255 * float(views.rgba[nearest, 0, 0, 0]))
        assert np.abs(page.screenshot()[int(y), int(x)].astype(int) - shade).max() <= 4
        page.click((x, y))
        page.until(lambda: page.evaluate(f"strip[{nearest}].getAttribute('aria-pressed')") == "true")
        assert page.evaluate("document.title") == NAME
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert page.problems == []


def test_on_a_telephone(folder: Path, views: Views, tmp_path: Path) -> None:
    path = write_page(folder, scene_of(views))
    with open_page(tmp_path, (390, 844)) as page:
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.call("Emulation.setEmulatedMedia", features=dark)
        page.open(path.as_uri())
        time.sleep(0.5)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        # The page goes on below the object, so that a thumb can scroll it.
        assert page.evaluate("document.querySelector('canvas').clientHeight < 0.6 * innerHeight")
        shot = page.screenshot()
        assert shot[300, 30].max() < 60
        assert page.problems == []
