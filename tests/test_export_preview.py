"""Private copies of a field: masks at any step, nothing of it felt by the original."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import gridreg
from gridreg.errors import InputError
from gridreg.export.cameras import look_at
from gridreg.export.preview import Preview
from gridreg.export.viewer_screen import Pace
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model
from tests.export_fields import MaskedBall, ball_model


def colour(model: Model) -> list[float]:
    """Of the field at the middle of the box."""
    return [round(v, 4) for v in model.field.colour(torch.zeros(1, 3), torch.zeros(1, 3))[0].tolist()]


def test_masks_at_any_step_and_off_leave_the_original_alone():
    model = ball_model(step=100)
    before = {name: value.clone() for name, value in model.field.state_dict().items()}
    preview = Preview(model)
    assert preview.masks == ("FrequencyMask(weight)",)
    assert (preview.step, preview.total_steps) == (100, 100)
    assert colour(preview.at()) == [0.5, 0.5, 0.5]
    assert colour(preview.at(step=0)) == [0.5, 0.0, 0.0]
    assert colour(preview.at(step=50)) == [0.5, 0.5, 0.25]
    assert colour(preview.at(step=0, off={"FrequencyMask(weight)"})) == [0.5, 0.5, 0.5]
    assert colour(preview.at(step=0, off={"something else"})) == [0.5, 0.0, 0.0]
    assert colour(preview.at()) == [0.5, 0.5, 0.5]
    assert model.handle.current_step == 100
    assert colour(model) == [0.5, 0.5, 0.5]
    after = model.field.state_dict()
    assert list(after) == list(before)
    assert all(torch.equal(after[name], before[name]) for name in before)


def test_as_trained_is_the_step_of_the_handle():
    assert colour(Preview(ball_model(step=0)).at()) == [0.5, 0.0, 0.0]


def test_later_training_does_not_reach_the_copy():
    model = ball_model(step=100)
    preview = Preview(model)
    with torch.no_grad():
        model.field.weight.mul_(0)
    model.occupancy.cells.zero_()
    assert colour(model) == [0.0, 0.0, 0.0]
    assert colour(preview.at()) == [0.5, 0.5, 0.5]
    assert bool(preview.at().occupancy.cells.all())


def test_copy_has_no_gradients_and_training_goes_on_with_its_own():
    model = ball_model(step=100)
    optimizer = torch.optim.Adam(model.field.parameters(), lr=0.1)
    model.field.colour(torch.zeros(1, 3), torch.zeros(1, 3)).sum().backward()
    preview = Preview(model)
    copied = preview.at().field
    assert all(p.grad is None and not p.requires_grad for p in copied.parameters())
    assert not copied.training
    assert model.field.training
    assert model.field.weight.grad is not None
    assert model.field.weight is optimizer.param_groups[0]["params"][0]
    optimizer.step()
    assert colour(preview.at()) == [0.5, 0.5, 0.5]


def test_training_beside_copies_is_the_same_bit_for_bit():
    def trained(look: bool) -> torch.Tensor:
        model = ball_model(
            step=0, extra=(gridreg.ComponentDropout(gridreg.parameters("weight", dim=0), p=0.3),)
        )
        optimizer = torch.optim.Adam(model.field.parameters(), lr=0.01)
        for step in range(6):
            model.handle.step(step)
            optimizer.zero_grad()
            model.field.colour(torch.ones(1, 3), torch.zeros(1, 3)).square().sum().backward()
            optimizer.step()
            if look:
                Preview(model).at(step=80).field.colour(torch.ones(1, 3), torch.zeros(1, 3))
        return model.field.weight.detach().clone()

    assert torch.equal(trained(look=True), trained(look=False))


def test_a_field_without_masks_or_of_no_module():
    model = Model.of_field(MaskedBall())
    assert Preview(model).masks == ()
    assert colour(Preview(model).at(step=3)) == [0.5, 0.5, 0.5]


def test_a_field_that_cannot_be_copied_is_named():
    class Stubborn(MaskedBall):
        def __deepcopy__(self, memo: dict[int, object]) -> nn.Module:
            raise TypeError("cannot pickle 'socket' object")

    with pytest.raises(
        InputError, match="field: Stubborn cannot be copied for viewing: cannot pickle 'socket'"
    ):
        Preview(Model.of_field(Stubborn()))


class TestPace:
    def test_slow_rays_make_small_images(self):
        fast, slow = Pace(), Pace()
        for _ in range(10):
            fast.saw(10_000, 0.01)
            slow.saw(10_000, 10.0)
        assert fast.moving(800, 4 / 3) == pytest.approx((0.12 / 1e-6 * 4 / 3) ** 0.5, rel=0.05)
        assert slow.moving(800, 4 / 3) == 48
        assert slow.moving(30, 4 / 3) == 30

    def test_sharpens_in_steps_to_the_full_width(self):
        width, widths = 50, []
        while width < 700:
            width = Pace.sharper(width, 700)
            widths.append(width)
        assert widths == [100, 200, 400, 700] or widths == [100, 200, 700]

    def test_images_without_rays_tell_nothing(self):
        pace = Pace()
        before = pace.moving(10_000, 1.0)
        pace.saw(0, 3.0)
        assert pace.moving(10_000, 1.0) == before


#: From the x axis: y to the right, z up.
CAMERA = Camera(
    look_at(np.array([3.0, 0, 0]), np.zeros(3), np.array([0.0, 0, 1])), Lens.from_angle(40, 32, 32)
)
HALF = np.array([[-9.0, 0, -9], [9, 9, 9]])


def test_a_box_cuts_what_is_rendered():
    preview = Preview(ball_model(step=100))
    whole = preview.at().render(CAMERA)
    assert bool((whole.opacity[16, [11, 21]] > 0.99).all())
    half = preview.at(crop=HALF).render(CAMERA)
    assert bool((half.opacity[:, :16] == 0).all())
    assert bool((half.colour[:, :16] == 1).all())
    torch.testing.assert_close(half.opacity[:, 17:], whole.opacity[:, 17:], atol=0.02, rtol=0)
    # Cut across, it begins later.
    back = preview.at(crop=np.array([[-9.0, -9, -9], [0, 9, 9]])).render(CAMERA)
    assert whole.depth[16, 16] == pytest.approx(2.4, abs=0.05)
    assert back.depth[16, 16] == pytest.approx(3.0, abs=0.05)
    nothing = preview.at(crop=np.array([[5.0, 5, 5], [6, 6, 6]])).render(CAMERA)
    assert bool((nothing.opacity == 0).all())
    # What is set for one image is not left behind.
    assert torch.equal(preview.at().render(CAMERA).opacity, whole.opacity)


def test_a_box_cuts_the_members_of_an_ensemble():
    members = tuple(replace(ball_model(step=step), handle=None) for step in (100, 100))
    with torch.no_grad():
        members[0].field.weight.mul_(0.5)
    preview = Preview(replace(ball_model(step=100), members=members))
    whole = preview.at().render(CAMERA, deviation=True).deviation
    half = preview.at(crop=HALF).render(CAMERA, deviation=True).deviation
    assert bool((whole[16, [11, 21]] > 0.1).all())
    assert bool((half[:, :16] == 0).all())
    torch.testing.assert_close(half[16, 21], whole[16, 21], atol=0.02, rtol=0)
