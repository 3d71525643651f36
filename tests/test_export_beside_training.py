"""Looking at a backbone while it is trained: the same numbers bit for bit, through resampling, and no crash."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import torch

import gridreg
from backbones.vm import VMField
from gridreg.export.camera_paths import turntable
from gridreg.export.cameras import orbit_of_box
from gridreg.export.preview import Preview
from gridreg.export.viewer import Viewer
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, render_rays
from gridreg.rendering.cameras import Lens
from gridreg.rendering.model import Model
from gridreg.training.events import cell_size
from tests.export_viewing import FakeClient

BOUNDS = torch.tensor([[-1.0] * 3, [1.0] * 3])
CAMERAS = turntable(orbit_of_box(BOUNDS), Lens.from_angle(40.0, 12, 16), 6)


class Run:
    """A few iterations of a small field with masks, resampled on the way."""

    def __init__(self) -> None:
        self.field = VMField(
            BOUNDS, (9, 9, 9), density_components=4, appearance_components=4, width=16,
            density_shift=0.0, generator=torch.Generator().manual_seed(0),
        )  # fmt: skip
        torch.manual_seed(0)
        for parameter in self.field.network_parameters():
            torch.nn.init.normal_(parameter, std=0.1)
        masks = [gridreg.FrequencyMask(site, until=0.9) for site in ("density", "appearance")]
        self.handle = gridreg.apply(
            self.field, *masks, gridreg.ComponentDropout("density", p=0.2), total_steps=12
        )
        self.step = 0
        self._restart()

    def _restart(self) -> None:
        self.optimizer = torch.optim.Adam(self.field.parameters(), lr=0.02)

    @property
    def model(self) -> Model:
        march = MarchSettings(step=0.5 * cell_size(self.field))
        return Model(self.field, OccupancyGrid.full(BOUNDS, (4, 4, 4)), march, torch.ones(3), self.handle)

    def iterate(self) -> None:
        self.handle.step(self.step)
        generator = torch.Generator().manual_seed(self.step)
        origins = torch.tensor([[0.0, 0.0, 3.0]]).repeat(64, 1)
        directions = torch.nn.functional.normalize(
            torch.randn(64, 3, generator=generator) * 0.2 - origins, dim=-1
        )
        model = self.model
        rendered = render_rays(
            self.field, Rays(origins, directions), model.occupancy, model.march, background=torch.ones(3)
        )
        self.optimizer.zero_grad()
        (rendered.colour - torch.tensor([1.0, 0.2, 0.1])).square().mean().backward()
        self.optimizer.step()
        self.step += 1
        if self.step in (4, 8):
            with self.handle.suspended():
                self.field.resample((9 + self.step, 9, 10))
            self._restart()

    def parameters(self) -> list[torch.Tensor]:
        return [p.detach().clone() for p in self.field.parameters()]


@pytest.fixture(scope="module")
def alone() -> list[torch.Tensor]:
    """The parameters after twelve iterations that nobody watched."""
    run = Run()
    for _ in range(12):
        run.iterate()
    return run.parameters()


def test_copies_between_iterations_change_nothing(alone):
    run = Run()
    for i in range(12):
        preview = Preview(run.model)
        copied = preview.at(step=i // 2, off=preview.masks[:1]).render(CAMERAS[0])
        assert copied is not None
        assert preview.at().field.resolution == run.field.resolution
        run.iterate()
    assert all(torch.equal(a, b) for a, b in zip(alone, run.parameters(), strict=True))


def test_a_copy_renders_what_the_field_renders():
    run = Run()
    for _ in range(9):
        run.iterate()
    run.field.eval()
    run.handle.step(7)
    preview = Preview(run.model)
    ours, theirs = run.model.render(CAMERAS[1]), preview.at().render(CAMERAS[1])
    assert torch.equal(ours.colour, theirs.colour)
    assert torch.equal(ours.depth, theirs.depth)
    run.handle.step(11)
    later = run.model.render(CAMERAS[1])
    assert torch.equal(preview.at(step=11).render(CAMERAS[1]).colour, later.colour)
    with run.handle.suspended():
        bare = run.model.render(CAMERAS[1])
    assert torch.equal(preview.at(off=preview.masks).render(CAMERAS[1]).colour, bare.colour)
    assert not torch.equal(bare.colour, ours.colour)


def test_a_viewer_that_never_rests_changes_nothing_and_survives(alone):
    pytest.importorskip("viser", reason="viser (extra 'viewer') is not installed")
    run = Run()
    client = FakeClient(CAMERAS[0].pose, size=(12, 16))
    stop = threading.Event()

    def wander() -> None:
        i = 0
        while not stop.wait(0.005):
            i += 1
            client.place(CAMERAS[i % len(CAMERAS)].pose)
            client.moved(client.camera)

    with Viewer(run.model, port=0, quiet=True, refresh=0.0) as viewer:
        viewer._connected(client)
        wanderer = threading.Thread(target=wander)
        wanderer.start()
        updates = 0
        try:
            for _ in range(12):
                run.iterate()
                if viewer.wants_update:
                    viewer.update(run.model)
                    updates += 1
                shown = len(client.images)
                end = time.monotonic() + 20
                while len(client.images) == shown and time.monotonic() < end:
                    time.sleep(0.005)
        finally:
            stop.set()
            wanderer.join()
        assert "cannot draw" not in viewer._panel._status.content
    assert updates == 12
    assert len(client.images) > 12
    assert np.isfinite(np.stack([p.mean() for p in client.images])).all()
    assert all(torch.equal(a, b) for a, b in zip(alone, run.parameters(), strict=True))
