"""Runs as models, videos, meshes, and watched while they are under way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gridreg.errors import InputError
from gridreg.export import LiveView, draw_run, live_view, save_cameras, video_path, write_mesh
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import Scene, World, builtin_scene, load_scene
from gridreg.training import Execution, RunConfig, build_trainer, execute, load_run
from gridreg.training.curves import History
from gridreg.training.rays import warp_of
from tests.export_viewing import FakeClient
from tests.forward_scene import write_forward_scene
from tests.tiny_training import NO_EVENTS

FIELD = {"density_components": 3, "appearance_components": 3, "density_shift": None, "width": 8}
SETTINGS = replace(NO_EVENTS, steps=6, voxels_end=1500, resample_at=(3,))
CONFIG = RunConfig(
    field=FIELD,
    train=SETTINGS,
    composition=[{"name": "FixedMask", "site": "density", "visible_ratio": 0.4}],
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(builtin_scene(tmp_path_factory.mktemp("scene"), size=16), "builtin8", test=(0,))


@pytest.fixture(scope="module")
def forward(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_forward_scene(tmp_path_factory.mktemp("forward") / "f", size=16), "holdout8")


def started(scene: Scene, out: Path) -> Execution:
    return Execution(CONFIG, scene, out, build_trainer(CONFIG, scene), History(1), {})


def test_a_loaded_run_looks_like_the_trained_one(scene: Scene, tmp_path: Path) -> None:
    run, _ = execute(CONFIG, scene, tmp_path / "run")
    run.trainer.field.eval()
    views = scene.train
    camera = Camera(views.poses[0], Lens.from_tensor(views.intrinsics[0], views.height, views.width))
    trained = run.trainer.model
    loaded = load_run(tmp_path / "run")
    assert loaded.handle is not None
    assert loaded.handle.current_step == 6
    # The mask is never fully open, so a dropped handle would be seen.
    assert min(float(mask.min()) for mask in loaded.handle.masks().values()) < 1
    one, two = trained.render(camera), loaded.render(camera)
    assert one is not None
    assert two is not None
    torch.testing.assert_close(two.colour, one.colour)
    loaded.handle.remove()
    bare = loaded.render(camera)
    assert bare is not None
    assert not torch.equal(bare.colour, two.colour)


def test_a_run_in_a_world_that_was_moved(scene: Scene, tmp_path: Path) -> None:
    far = replace(scene, world=World((430_000.0, 5_200_000.0, 300.0), 50.0))
    run, _ = execute(CONFIG, far, tmp_path / "run")
    loaded = load_run(tmp_path / "run")
    assert loaded.world == far.world
    options = {"resolution": 16, "threshold": 0.01, "colours": False, "min_component": 0.0}
    at_home = write_mesh(loaded.field, tmp_path / "home.ply", **options)
    outside = write_mesh(loaded.field, tmp_path / "far.ply", world=loaded.world, **options)
    np.testing.assert_allclose(outside.vertices, far.world.outward(at_home.vertices))
    # A camera file counts in the world of the scene's files, as its mesh does.
    camera = Camera(torch.eye(4), Lens((9.0, 9.0, 4.0, 4.0), 8, 8))
    moved = torch.eye(4)
    moved[:3, 3] = torch.tensor([430_050.0, 5_200_000.0, 300.0])
    save_cameras(tmp_path / "path.json", [replace(camera, pose=moved)])
    (found,) = video_path(loaded, None, tmp_path / "path.json", world=loaded.world)
    torch.testing.assert_close(found.pose[:3, 3], torch.tensor([1.0, 0, 0]))
    assert run.scene.world == far.world


def test_video_paths(scene: Scene, forward: Scene) -> None:
    model = build_trainer(CONFIG, scene).model
    assert len(video_path(model, None, frames=3)) == 3
    turn = video_path(model, scene.train, frames=4, width=8)
    assert {camera.lens.width for camera in turn} == {8}
    # Once around: opposite cameras look in opposite directions across the vertical axis.
    assert float(turn[0].pose[:2, 2] @ turn[2].pose[:2, 2]) < 0

    facing = build_trainer(CONFIG, forward).model
    assert facing.warp == warp_of(forward)
    sway = video_path(facing, forward.train, frames=5)
    assert all(float(camera.pose[2, 2]) > 0.9 for camera in sway)
    assert len(video_path(facing, forward.train, "train", frames=2)) == 2
    with pytest.raises(InputError, match="a forward-facing scene has no back"):
        video_path(facing, forward.train, "turntable")
    with pytest.raises(InputError, match="needs the training cameras"):
        video_path(facing)


def test_what_is_drawn_of_a_run(
    scene: Scene, forward: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = started(scene, tmp_path)
    run.trainer.occupancy.cells.zero_()
    page = tmp_path / "index.html"
    assert draw_run(run, video=False) == [page]
    assert capsys.readouterr().err.startswith("no mesh: ")
    assert draw_run(run, mesh=False, video=False) == [page]
    facing = started(forward, tmp_path)
    assert draw_run(facing) == [tmp_path / "spiral.mp4", page]
    assert "not in world coordinates" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"spiral.mp4", "index.html"}


def test_nobody_asked_for_a_view() -> None:
    with live_view(False) as look:
        assert look is None


def test_a_run_that_is_watched(scene: Scene, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    with live_view(True, port=0) as look:
        assert look is not None
        assert look.viewer is None
        seen = []

        class Watched:
            """Somebody opens the page before the first iteration."""

            def start(self, run: Execution) -> None:
                look.start(run)
                assert look.viewer is not None
                assert not (tmp_path / "run/config.yaml").exists()
                look.viewer._refresh = 0.0
                look.viewer._connected(FakeClient(run.scene.train.poses[0]))

            def step(self, report: dict[str, float]) -> None:
                look.step(report)  # type: ignore[arg-type]
                assert look.viewer is not None
                seen.append(look.viewer._preview.step)

        plain, _ = execute(CONFIG, scene, tmp_path / "plain")
        run, metrics = execute(CONFIG, scene, tmp_path / "run", watch=Watched())
        assert metrics is not None
        assert seen == [0, 1, 2, 3, 4, 5]
        for name, value in plain.trainer.field.state_dict().items():
            assert torch.equal(run.trainer.field.state_dict()[name], value), name
        assert look.viewer is not None
        assert look.viewer.watched
        look.viewer._screens.clear()
        # Nobody looks any more, so there is nothing to wait for.
        look.finish()
        viewer = look.viewer
    assert viewer._closed


def test_a_view_that_was_never_started_closes() -> None:
    pytest.importorskip("viser")
    look = LiveView(port=0)
    look.finish()
    look.close()
    assert look.viewer is None
    assert replace(CONFIG, seed=1) != CONFIG
