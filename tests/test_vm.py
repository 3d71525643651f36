"""VM-TensoRF against a dense tensor built by einsum, and the surgery on its grids."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from backbones.tensorial import density_shift_for
from backbones.vm import VMField
from gridreg.ops.interpolation import LINE_AXES, PLANE_AXES

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 3.0]])
LETTERS = "xyz"


def small(resolution=(5, 6, 7), seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    settings = {"density_components": 3, "appearance_components": 2, "generator": generator, "scale": 1.0}
    if options.get("decoder", "mlp").startswith("mlp"):
        settings["precision"] = "float32"
    return VMField(BOX, resolution, **{**settings, **options})


def dense(field):
    """The tensor that the density factors stand for, at every node: (X, Y, Z)."""
    total = np.zeros(field.resolution)
    for k in range(3):
        a, b = (LETTERS[axis] for axis in PLANE_AXES[k])
        v = LETTERS[LINE_AXES[k]]
        plane, line = field.density_planes[k].detach().numpy(), field.density_lines[k].detach().numpy()
        total += np.einsum(f"{a}{b}c,{v}c->xyz", plane, line)
    return total


def nodes(field):
    axes = [torch.linspace(0, 1, n) for n in field.resolution]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


@given(seed=st.integers(0, 100), resolution=st.tuples(*[st.integers(2, 7)] * 3))
def test_density_features_at_the_nodes_are_the_dense_tensor(seed, resolution):
    field = small(resolution, seed)
    found = field.density_features(nodes(field)).detach().reshape(resolution).numpy()
    np.testing.assert_allclose(found, dense(field), atol=2e-5)


def test_between_nodes_plane_and_line_are_interpolated_before_they_multiply():
    field = small((2, 2, 2), density_components=1)
    u = torch.tensor([[0.3, 0.6, 0.9]])
    expected = 0.0
    for k in range(3):
        (a, b), v = PLANE_AXES[k], LINE_AXES[k]
        plane, line = field.density_planes[k][..., 0], field.density_lines[k][:, 0]
        p = sum(
            plane[i, j] * (u[0, a] if i else 1 - u[0, a]) * (u[0, b] if j else 1 - u[0, b])
            for i in range(2)
            for j in range(2)
        )
        expected = expected + p * (line[0] * (1 - u[0, v]) + line[1] * u[0, v])
    torch.testing.assert_close(field.density_features(u)[0], expected)


def test_appearance_concatenates_the_products():
    field = small()
    u = nodes(field)
    found = field.appearance_features(u).detach().reshape(*field.resolution, 6)
    for k in range(3):
        a, b = (LETTERS[axis] for axis in PLANE_AXES[k])
        plane, line = field.appearance_planes[k].detach(), field.appearance_lines[k].detach()
        product = torch.einsum(f"{a}{b}c,{LETTERS[LINE_AXES[k]]}c->xyzc", plane, line)
        torch.testing.assert_close(found[..., 2 * k : 2 * k + 2], product, atol=1e-5, rtol=1e-5)


def test_density_is_scaled_softplus_inside_and_zero_outside():
    field = small(density_shift=-3.0, distance_scale=10.0)
    inside = torch.tensor([[0.0, 0.0, 1.5]])
    feature = field.density_features(field.normalise(inside))
    torch.testing.assert_close(field.density(inside), 10 * torch.log1p(torch.exp(feature - 3)))
    outside = torch.tensor([[1.001, 0.0, 1.5], [0.0, -2.1, 1.0], [0.0, 0.0, 3.1]])
    assert torch.equal(field.density(outside), torch.zeros(3))


@pytest.mark.parametrize("factor", [2, 3])
def test_refining_by_a_whole_factor_keeps_the_values_at_the_old_nodes(factor):
    field = small()
    u = nodes(field)
    before = field.density_features(u), field.appearance_features(u)
    field.resample(tuple(factor * (n - 1) + 1 for n in field.resolution))
    torch.testing.assert_close(field.density_features(u), before[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(field.appearance_features(u), before[1], atol=1e-5, rtol=1e-5)
    # Linear interpolation of plane and line reproduces the field between the nodes, too.
    assert field.density_planes[0].shape == (factor * 4 + 1, factor * 5 + 1, 3)


def test_resampling_to_the_same_resolution_changes_nothing():
    field = small()
    before = {name: value.clone() for name, value in field.state_dict().items()}
    field.resample(field.resolution)
    for name, value in field.state_dict().items():
        torch.testing.assert_close(value, before[name])


@given(
    seed=st.integers(0, 100),
    lower=st.tuples(*[st.floats(0.0, 0.45)] * 3),
    upper=st.tuples(*[st.floats(0.55, 1.0)] * 3),
)
def test_shrinking_keeps_the_field_inside_the_new_box(seed, lower, upper):
    field = small((9, 8, 10), seed)
    size = BOX[1] - BOX[0]
    wanted = torch.stack([BOX[0] + torch.tensor(lower) * size, BOX[0] + torch.tensor(upper) * size])
    points = wanted[0] + torch.rand(50, 3) * (wanted[1] - wanted[0])
    density = field.density(points).detach()
    directions = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    # The position enters the colour only in decoders that read it.
    colour = field.colour(points, directions).detach()
    field.shrink(wanted)
    assert bool((field.bounds[0] <= wanted[0] + 1e-3).all())
    assert bool((field.bounds[1] >= wanted[1] - 1e-3).all())
    torch.testing.assert_close(field.density(points), density, atol=2e-4, rtol=2e-4)
    torch.testing.assert_close(field.colour(points, directions), colour, atol=2e-4, rtol=2e-4)
    assert field.density_planes[0].shape[:2] == field.resolution[:2]


def test_shrinking_to_the_own_box_changes_nothing():
    field = small()
    before = {name: value.clone() for name, value in field.state_dict().items()}
    field.shrink(BOX)
    assert field.resolution == (5, 6, 7)
    for name, value in field.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_initial_opacity_sets_the_shift():
    field = VMField(BOX, (4, 4, 4), scale=0.0, density_shift=None, initial_opacity=0.3)
    length = float((BOX[1] - BOX[0]).mean())
    density = field.density(torch.tensor([[0.0, 0.0, 1.0]])).item()
    assert 1 - np.exp(-density * length) == pytest.approx(0.3, abs=1e-5)
    for wrong in (0.0, 1.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="initial_opacity"):
            density_shift_for(wrong, 1.0, 25.0)


def test_colour_by_ray_is_colour_by_sample():
    for decoder in ("mlp_fea", "mlp_pe", "mlp", "sh"):
        field = small(decoder=decoder)
        x = BOX[0] + torch.rand(20, 3) * (BOX[1] - BOX[0])
        directions = torch.nn.functional.normalize(torch.randn(4, 3), dim=-1)
        rays = torch.randint(4, (20,))
        torch.testing.assert_close(
            field.colour_of_rays(x, directions, rays), field.colour(x, directions[rays])
        )


def test_parameter_groups_hold_every_parameter_once():
    field = small()
    groups = field.parameter_groups()
    assert [g["name"] for g in groups] == ["grid", "network"]
    listed = [id(p) for g in groups for p in g["params"]]
    assert sorted(listed) == sorted(id(p) for p in field.parameters())
    assert len(groups[0]["params"]) == 12


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"resolution=\(1, 4, 4\)"):
        VMField(BOX, (1, 4, 4))
    with pytest.raises(ValueError, match="bounds="):
        VMField(BOX.flip(0), (4, 4, 4))
    with pytest.raises(ValueError, match="decoder='mlpp'"):
        VMField(BOX, (4, 4, 4), decoder="mlpp")
