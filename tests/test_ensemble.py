"""Several runs as one: the mean of fields, its checkpoint, and the command that writes it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from gridreg.cli import main
from gridreg.errors import InputError
from gridreg.export import MODES, next_view, to_image
from gridreg.export.images import MAX_DEVIATION
from gridreg.export.next_view import NextView
from gridreg.export.preview import Preview
from gridreg.rendering import (
    Camera,
    Ensemble,
    Lens,
    MarchSettings,
    OccupancyGrid,
    Rays,
    Rendered,
    render_rays,
)
from gridreg.rendering.model import Model
from gridreg.scenes import builtin_scene, load_scene
from gridreg.training import RunConfig, TrainSettings, execute, load_run, save_ensemble

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
FIELD = {"density_components": 4, "appearance_components": 4, "decoder": "sh"}


class Flat(nn.Module):
    """The same density and colour everywhere."""

    def __init__(self, density: float, colour: tuple[float, float, float], bounds: Tensor = BOX) -> None:
        super().__init__()
        self.value, self.shade = nn.Parameter(torch.tensor(density)), torch.tensor(colour)
        self.bounds = bounds

    def density(self, x: Tensor) -> Tensor:
        return self.value.expand(len(x))

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        return self.shade.expand(len(x), 3)


def full(bounds: Tensor = BOX, cells: int = 4) -> OccupancyGrid:
    return OccupancyGrid.full(bounds, (cells, cells, cells))


def test_density_is_the_mean_and_colour_is_mixed_by_density():
    field = Ensemble([Flat(3.0, (1.0, 0.0, 0.0)), Flat(1.0, (0.0, 1.0, 0.0))], [full(), full()])
    x = torch.zeros(2, 3)
    assert field.density(x).tolist() == [2.0, 2.0]
    torch.testing.assert_close(field.colour(x, x), torch.tensor([0.75, 0.25, 0.0]).expand(2, 3))


def test_where_nothing_is_colour_is_the_plain_mean():
    field = Ensemble([Flat(0.0, (1.0, 0.0, 0.0)), Flat(0.0, (0.0, 1.0, 0.0))], [full(), full()])
    assert field.colour(torch.zeros(1, 3), torch.zeros(1, 3)).tolist() == [[0.5, 0.5, 0.0]]


def test_an_ensemble_of_one_renders_as_its_member():
    member = Flat(1.5, (0.2, 0.4, 0.6))
    rays = Rays(torch.tensor([[0.0, 0.1, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    march, black = MarchSettings(0.1), torch.zeros(3)
    alone = render_rays(member, rays, full(), march, background=black)
    joined = render_rays(Ensemble([member], [full()]), rays, full(), march, background=black)
    torch.testing.assert_close(joined.colour, alone.colour)
    torch.testing.assert_close(joined.depth, alone.depth)


def test_members_have_nothing_outside_their_cells_and_boxes():
    small = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 2.0]])
    half = full(small, 2)
    half.cells[0] = 0
    field = Ensemble([Flat(2.0, (1.0, 0.0, 0.0)), Flat(4.0, (0.0, 0.0, 1.0), small)], [full(), half])
    assert field.bounds.tolist() == [[-1.0, -1.0, -1.0], [1.0, 1.0, 2.0]]
    x = torch.tensor(
        [[-0.5, 0.5, 0.5], [0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [0.75, 0.5, 1.5], [-0.5, 0.0, 1.5]]
    )
    assert field.density(x).tolist() == [1.0, 1.0, 3.0, 2.0, 0.0]
    torch.testing.assert_close(
        field.colour(x[2:4], x[2:4]), torch.tensor([[1 / 3, 0, 2 / 3], [0.0, 0.0, 1.0]])
    )
    cells = field.occupancy()
    assert cells.resolution == (4, 4, 4)
    assert cells.contains(x).tolist() == [True, True, True, True, False]
    assert cells.hull is None
    # What silhouettes leave of the members counts if all of them have it.
    for one in field.occupancies:
        one.hull = one.cells.clone()
    hull = field.occupancy().hull
    assert hull is not None
    assert torch.equal(hull, cells.cells)


def test_gradients_reach_every_member():
    first, second = Flat(3.0, (1.0, 0.0, 0.0)), Flat(1.0, (0.0, 1.0, 0.0))
    field = Ensemble([first, second], [full(), full()])
    x = torch.zeros(1, 3)
    (field.density(x).sum() + field.colour(x, x)[:, 0].sum()).backward()
    # Density: 1/2 each. Red is a / (a + b): b / (a + b)^2 and -a / (a + b)^2.
    assert first.value.grad == pytest.approx(0.5 + 1 / 16)
    assert second.value.grad == pytest.approx(0.5 - 3 / 16)


def test_members_and_cells_must_match():
    with pytest.raises(InputError, match="found 0 members"):
        Ensemble([], [])
    with pytest.raises(InputError, match="found 1 members with 2 occupancies"):
        Ensemble([Flat(1.0, (0.0, 0.0, 0.0))], [full(), full()])


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs `a`, `b` (another seed, closed masks) and `c` (another scene)."""
    folder = tmp_path_factory.mktemp("ensembles")
    settings = TrainSettings(
        steps=40,
        rays=128,
        voxels_start=4096,
        voxels_end=8000,
        resample_at=(20,),
        occupancy_at=(30,),
        occupancy_every=0,
        occupancy_resolution=24,
        shrink_at=(30,),
        learning_rate_grid=0.1,
    )
    for name, seed, size, composition in (
        ("a", 0, 32, []),
        ("b", 1, 32, [{"name": "FixedMask", "site": "density", "visible_ratio": 0.5}]),
        ("c", 0, 24, []),
    ):
        place = builtin_scene(folder / "scenes", size=size)
        config = RunConfig(
            scene=str(place), seed=seed, backbone="vm", field=FIELD, train=settings, composition=composition
        )
        execute(config, load_scene(place, "builtin8"), folder / name)
    return folder


def test_a_saved_ensemble_is_the_mean_of_its_runs(desk, tmp_path):
    assert save_ensemble([desk / "a", desk / "b" / "checkpoint"], tmp_path / "both") == 2
    one, other, both = load_run(desk / "a"), load_run(desk / "b"), load_run(tmp_path / "both")
    assert both.fingerprint == one.fingerprint
    assert both.step == 40
    assert both.handle is None
    assert [run.config.seed for run in both.members] == [0, 1]
    assert both.march.step == min(one.march.step, other.march.step)
    low, high = both.field.bounds
    x = low + torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * (high - low)
    parts = [torch.where(run.occupancy.contains(x), run.field.density(x), 0.0) for run in (one, other)]
    torch.testing.assert_close(both.field.density(x), (parts[0] + parts[1]) / 2)
    assert both.occupancy.contains(x)[one.occupancy.contains(x) | other.occupancy.contains(x)].all()
    # The mask of the second is half closed, and part of what it is.
    other.handle.remove()
    assert not torch.equal(torch.where(other.occupancy.contains(x), other.field.density(x), 0.0), parts[1])


def test_the_checkpoint_is_smaller_than_its_runs(desk, tmp_path):
    save_ensemble([desk / "a", desk / "b"], tmp_path)
    size = sum((desk / name / "checkpoint" / "tensors.safetensors").stat().st_size for name in ("a", "b"))
    assert (tmp_path / "checkpoint" / "tensors.safetensors").stat().st_size < 0.6 * size


def test_ensembles_join_by_their_members(desk, tmp_path):
    save_ensemble([desk / "a", desk / "b"], tmp_path / "two")
    assert save_ensemble([tmp_path / "two", desk / "a"], tmp_path / "three") == 3
    assert [run.config.seed for run in load_run(tmp_path / "three").members] == [0, 1, 0]


def test_a_viewer_copies_it_masks_included(desk, tmp_path):
    save_ensemble([desk / "a", desk / "b"], tmp_path)
    run = load_run(tmp_path)
    preview = Preview(run)
    assert preview.masks == ()
    x = run.field.bounds.mean(0) + 0.3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(preview.at().field.density(x), run.field.density(x))


def test_runs_that_do_not_go_together(desk, tmp_path):
    with pytest.raises(InputError, match="ensemble: found 1 run, expected at least two"):
        save_ensemble([desk / "a"], tmp_path / "x")
    with pytest.raises(InputError, match=r"c: trained on another scene than .*a \(fingerprint"):
        save_ensemble([desk / "a", desk / "c"], tmp_path / "x")
    with pytest.raises(InputError, match="holds no checkpoint"):
        save_ensemble([desk / "a", desk / "scenes"], tmp_path / "x")
    assert not (tmp_path / "x" / "checkpoint").exists()
    before = (desk / "b" / "checkpoint" / "state.json").read_bytes()
    with pytest.raises(InputError, match="holds a run already"):
        save_ensemble([desk / "a", desk / "b"], desk / "b")
    assert (desk / "b" / "checkpoint" / "state.json").read_bytes() == before


def test_an_ensemble_cannot_be_resumed(desk, tmp_path):
    save_ensemble([desk / "a", desk / "b"], tmp_path)
    config = load_run(desk / "a").config
    scene = load_scene(Path(config.scene or ""), "builtin8")
    with pytest.raises(InputError, match="an ensemble, which cannot be trained; resume its members"):
        execute(config, scene, tmp_path, resume=True)


def test_the_command_and_those_that_read_what_it_wrote(desk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    out = os.fspath(tmp_path / "joined")
    assert main(["ensemble", "a", "b", "--out", out]) == 0
    assert "the mean of 2 fields" in capsys.readouterr().out
    assert main(["eval", out, "--out", f"{out}/score"]) == 0
    record = json.loads((tmp_path / "joined" / "score" / "metrics.json").read_text())
    assert record["members"] == [
        {"preset": "", "seed": 0, "steps": 40},
        {"preset": "", "seed": 1, "steps": 40},
    ]
    assert np.isfinite(record["mean"]["psnr"])
    assert main(["render", out, "--frames", "2", "--width", "16", "--out", f"{out}/video"]) == 0
    assert len(list((tmp_path / "joined" / "video").glob("*.png"))) == 2
    assert main(["mesh", out, "--resolution", "24", "--threshold", "0.5"]) == 0
    assert (tmp_path / "joined" / "mesh.ply").exists()
    capsys.readouterr()
    assert main(["ensemble", "a", "c", "--out", f"{out}2"]) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: c: trained on another scene than a")
    assert len(text.splitlines()) == 1


# --- where members differ


@pytest.fixture(scope="module")
def both(desk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ensemble of `a` and `b`."""
    folder = tmp_path_factory.mktemp("both")
    save_ensemble([desk / "a", desk / "b"], folder)
    return folder


def test_deviation_is_that_of_the_members_images(both):
    run = load_run(both)
    scene = load_scene(Path(run.config.scene or ""), "builtin8")
    camera = Camera(scene.train.poses[0], Lens.from_tensor(scene.train.intrinsics[0], 32, 32))
    found = run.render(camera, deviation=True)
    one, other = (member.render(camera).colour.double().numpy() for member in run.members)
    # Two numbers: their standard deviation (n - 1) is the distance over the root of 2.
    expected = np.sqrt((((one - other) ** 2) / 2).mean(axis=-1))
    np.testing.assert_allclose(found.deviation.numpy(), expected, atol=1e-6)
    assert expected.max() > 0.01
    plain = run.render(camera)
    assert plain.deviation is None
    assert torch.equal(plain.colour, found.colour)
    assert run.render(camera, deviation=True, stop=lambda: True) is None
    with pytest.raises(InputError, match="deviation: found one run, expected an ensemble"):
        run.members[0].render(camera, deviation=True)


def test_an_image_of_the_deviation(both):
    values = torch.tensor([[0.0, MAX_DEVIATION]])
    image = to_image(
        Rendered(torch.zeros(1, 2, 3), torch.ones(1, 2), torch.ones(1, 2), deviation=values), "deviation"
    )
    assert image[0, 0].max() < 10
    assert image[0, 1].min() > 150
    with pytest.raises(InputError, match="found a render without it"):
        to_image(Rendered(torch.zeros(1, 2, 3), torch.ones(1, 2), torch.ones(1, 2)), "deviation")
    run = load_run(both)
    assert Preview(run).modes == MODES
    assert Preview(run.members[0]).modes == ("rgb", "depth", "opacity")


class Lopsided(Model):
    """Members differ when looked at from a direction, and the less the further away."""

    place = torch.tensor([0.6, -0.8, 0.0])

    def render(self, camera, *, deviation=False, **_):
        direction = camera.pose[:3, 3] / camera.pose[:3, 3].norm()
        value = torch.full((4, 4), float((direction @ self.place).clamp(min=0)))
        return Rendered(torch.zeros(4, 4, 3), value, value, deviation=value)


def test_next_photograph_is_where_members_differ_most(desk):
    scene = load_scene(Path(load_run(desk / "a").config.scene or ""), "builtin8")
    field = Flat(1.0, (0.0, 0.0, 0.0))
    found = next_view(Lopsided(field, full(), MarchSettings(0.1)), scene.train, candidates=200)
    direction = found.camera.pose[:3, 3] / found.camera.pose[:3, 3].norm()
    assert float(direction @ Lopsided.place) > 0.97
    assert found.deviation > found.usual
    assert found.elevation == pytest.approx(float(torch.asin(direction[2]).rad2deg()), abs=2)
    # Turning the nearest photograph's camera around z by the angle leads there.
    places = dict(zip(scene.train.names, scene.train.poses[:, :3, 3].numpy(), strict=True))
    cosines = {name: p @ direction.numpy() / np.linalg.norm(p) for name, p in places.items()}
    assert found.nearest == max(cosines, key=cosines.get)
    start = np.arctan2(places[found.nearest][1], places[found.nearest][0])
    end = np.arctan2(float(direction[1]), float(direction[0]))
    assert np.cos(end - start - np.radians(found.turn)) == pytest.approx(1.0, abs=2e-3)
    text = str(NextView(found.camera, 31.4, "r_3", -40.2, 0.05, 0.02))
    assert text.startswith(
        "photograph here next: 40 degrees to the left of r_3, 31 degrees above the horizon"
    )
    with pytest.raises(InputError, match="and two candidates"):
        next_view(Lopsided(field, full(), MarchSettings(0.1)), scene.train, candidates=1)


def test_the_commands_show_where_not_to_trust_it(desk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    out = tmp_path / "joined"
    assert main(["ensemble", "a", "b", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "photograph here next: " in said
    about = json.loads((out / "next.json").read_text())["about"]
    assert about in said
    # The file is a path of cameras.
    words = ["--path", str(out / "next.json"), "--modes", "rgb", "deviation", "--out", f"{out}/video"]
    assert main(["render", str(out), *words]) == 0
    assert len(list((out / "video").glob("*.png"))) == 1
    assert (
        main(["render", "a", "--frames", "1", "--width", "8", "--modes", "deviation", "--out", f"{out}/no"])
        == 2
    )
    assert "expected an ensemble" in capsys.readouterr().err
    assert main(["mesh", str(out), "--resolution", "24", "--threshold", "0.5"]) == 0
    assert main(["page", str(out)]) == 0
    text = (out / "index.html").read_text()
    assert "Where not to trust it" in text
    assert about[1:] in text
    assert text.count('alt="deviation of the members"') == 4
    assert main(["page", "a"]) == 0
    assert "Where not to trust it" not in (desk / "a/index.html").read_text()
