"""CP-TensoRF against a dense tensor built by einsum, its masks, and the surgery on its lines."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gridreg
from backbones.cp import CPField
from gridreg import ops
from gridreg.fields import make_field
from gridreg.ops import use_backend
from gridreg.ops.interpolation import LINE_AXES
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, render_rays

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 3.0]])
LETTERS = "xyz"


def small(resolution=(5, 6, 7), seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    settings = {"density_components": 6, "appearance_components": 4, "generator": generator, "scale": 1.0}
    if options.get("decoder", "mlp").startswith("mlp"):
        settings["precision"] = "float32"
    return CPField(BOX, resolution, **{**settings, **options})


def outer(lines, subscripts="xyz"):
    """Outer products of lines, by the axis that each runs along: (X, Y, Z) or (X, Y, Z, C)."""
    operands = ",".join(f"{LETTERS[axis]}c" for axis in LINE_AXES)
    return np.einsum(f"{operands}->{subscripts}", *(line.detach().double().numpy() for line in lines))


def nodes(field):
    axes = [torch.linspace(0, 1, n) for n in field.resolution]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def seen(field):
    """What masks and low-passes leave of a field, at random places."""
    u = torch.rand(64, 3, generator=torch.Generator().manual_seed(3))
    return field.density_features(u), field.appearance_features(u)


@given(seed=st.integers(0, 100), resolution=st.tuples(*[st.integers(2, 7)] * 3))
def test_density_features_at_the_nodes_are_the_dense_tensor(seed, resolution):
    field = small(resolution, seed)
    found = field.density_features(nodes(field)).detach().reshape(resolution).numpy()
    np.testing.assert_allclose(found, outer(field.density_lines), atol=5e-5)


def test_appearance_keeps_the_products_of_components_apart():
    field = small()
    found = field.appearance_features(nodes(field)).detach().reshape(*field.resolution, 4).numpy()
    np.testing.assert_allclose(found, outer(field.appearance_lines, "xyzc"), atol=5e-5)


@given(u=st.tuples(*[st.floats(0, 1, width=32)] * 3))
def test_between_nodes_lines_are_interpolated_before_they_multiply(u):
    field = small((2, 2, 2), density_components=3)
    values = 1.0
    for line, axis in zip(field.density_lines, LINE_AXES, strict=True):
        values = values * (line[0] * (1 - u[axis]) + line[1] * u[axis])
    found = field.density_features(torch.tensor([u]))[0]
    torch.testing.assert_close(found, values.sum(), atol=1e-5, rtol=1e-5)


def test_density_is_scaled_softplus_inside_and_zero_outside():
    field = small(density_shift=-3.0, distance_scale=10.0)
    inside = torch.tensor([[0.0, 0.0, 1.5]])
    feature = field.density_features(field.normalise(inside))
    torch.testing.assert_close(field.density(inside), 10 * torch.log1p(torch.exp(feature - 3)))
    outside = torch.tensor([[1.001, 0.0, 1.5], [0.0, -2.1, 1.0], [0.0, 0.0, 3.1]])
    assert torch.equal(field.density(outside), torch.zeros(3))


def test_the_published_sizes_and_initial_values_are_the_defaults():
    field = CPField(BOX, (40, 50, 60), generator=torch.Generator().manual_seed(0))
    for lines, channels in ((field.density_lines, 96), (field.appearance_lines, 288)):
        assert [tuple(line.shape) for line in lines] == [(60, channels), (50, channels), (40, channels)]
        assert all(float(line.detach().std()) == pytest.approx(0.2, rel=0.03) for line in lines)
    assert tuple(field.basis.weight.shape) == (27, 288)
    assert field.density_shift == -10.0


def test_the_same_seed_gives_the_same_lines():
    one, two, other = small(seed=1), small(seed=1), small(seed=2)
    assert all(torch.equal(a, b) for a, b in zip(one.density_lines, two.density_lines, strict=True))
    assert not torch.equal(one.appearance_lines[0], other.appearance_lines[0])


@pytest.mark.parametrize("kind", ["density", "appearance"])
@given(step=st.integers(0, 100))
def test_a_mask_enters_once_though_three_lines_multiply(kind, step):
    field = small(appearance_components=6)
    u = nodes(field)
    products = ops.cp_features.reference(u, list(getattr(field, f"{kind}_lines")))
    mask = gridreg.frequency_mask(6, step, 90)
    with gridreg.apply(field, gridreg.FrequencyMask(kind, until=90), total_steps=100) as handle:
        handle.step(step)
        if kind == "density":
            torch.testing.assert_close(field.density_features(u), products @ mask, atol=1e-4, rtol=1e-4)
        else:
            torch.testing.assert_close(field.appearance_features(u), products * mask, atol=1e-5, rtol=1e-5)


def test_closed_channels_have_no_effect_and_no_gradient_in_any_line():
    field = small()
    with gridreg.apply(field, gridreg.FixedMask("density", visible_ratio=0.5), total_steps=10):
        before = field.density_features(nodes(field)).detach()
        with torch.no_grad():
            for line in field.density_lines:
                line.data[:, 3:] = 7.0
        raw = [field.density_lines._parameters[str(k)] for k in range(3)]
        raw[1].data[:, 3:] = float("inf")
        found = field.density_features(nodes(field))
        assert torch.equal(found, before)
        found.sum().backward()
        for line in raw:
            assert torch.equal(line.grad[:, 3:], torch.zeros_like(line.grad[:, 3:]))
            assert (line.grad[:, :3] != 0).any()


def test_sites_hold_all_lines_as_grids():
    field = small()
    sites = gridreg.sites_of(field)
    assert {"density", "density.lines", "appearance", "appearance.lines"} <= set(sites)
    assert {"encoding.features", "encoding.direction"} <= set(sites)
    assert sites["density"] == sites["density.lines"]
    handle = gridreg.apply(field, gridreg.L1("density", weight=1.0), total_steps=10)
    expected = sum(line.detach().abs().mean() for line in field.density_lines)
    torch.testing.assert_close(handle.loss().detach(), expected)
    handle.remove()
    with gridreg.apply(field, gridreg.FourierLowPass("appearance", keep=0.0), total_steps=10):
        mean = torch.stack([line.mean(0) for line in field.appearance_lines]).prod(0)
        found = field.appearance_features(torch.rand(5, 3))
        torch.testing.assert_close(found, mean.expand(5, 4), atol=1e-5, rtol=1e-4)


def test_removing_masks_restores_the_field_exactly():
    field = small()
    before, keys = seen(field), list(field.state_dict())
    composition = [
        gridreg.FrequencyMask("density"),
        gridreg.GridBlur("appearance"),
        gridreg.TotalVariation("density", weight=1e-3),
    ]
    handle = gridreg.apply(field, *composition, total_steps=20)
    assert not torch.equal(seen(field)[0], before[0])
    assert list(field.state_dict()) == keys
    handle.remove()
    for now, then in zip(seen(field), before, strict=True):
        assert torch.equal(now, then)


def test_masks_go_on_over_a_resampling():
    field = small()
    with gridreg.apply(field, gridreg.FixedMask("density", visible_ratio=0.5), total_steps=10) as handle:
        with handle.suspended():
            field.resample((9, 9, 9))
        handle.step(1)
        products = ops.cp_features.reference(nodes(field), list(field.density_lines))
        torch.testing.assert_close(
            field.density_features(nodes(field)), products[:, :3].sum(1), atol=1e-5, rtol=1e-5
        )


@pytest.mark.parametrize("factor", [2, 3])
def test_refining_by_a_whole_factor_keeps_the_values_at_the_old_nodes(factor):
    field = small()
    u = nodes(field)
    before = field.density_features(u), field.appearance_features(u)
    field.resample(tuple(factor * (n - 1) + 1 for n in field.resolution))
    torch.testing.assert_close(field.density_features(u), before[0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(field.appearance_features(u), before[1], atol=1e-4, rtol=1e-4)
    assert [len(line) for line in field.density_lines] == [
        factor * (field_nodes - 1) + 1 for field_nodes in (7, 6, 5)
    ]
    assert all(isinstance(line, torch.nn.Parameter) for line in field.parameters())


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
    directions = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    density, colour = field.density(points).detach(), field.colour(points, directions).detach()
    field.shrink(wanted)
    assert bool((field.bounds[0] <= wanted[0] + 1e-3).all())
    assert bool((field.bounds[1] >= wanted[1] - 1e-3).all())
    torch.testing.assert_close(field.density(points), density, atol=5e-4, rtol=5e-4)
    torch.testing.assert_close(field.colour(points, directions), colour, atol=5e-4, rtol=5e-4)
    assert [len(line) for line in field.density_lines] == list(reversed(field.resolution))


def test_colour_by_ray_is_colour_by_sample():
    field = small(decoder="mlp_fea")
    x = BOX[0] + torch.rand(20, 3) * (BOX[1] - BOX[0])
    directions = torch.nn.functional.normalize(torch.randn(4, 3), dim=-1)
    rays = torch.randint(4, (20,))
    torch.testing.assert_close(field.colour_of_rays(x, directions, rays), field.colour(x, directions[rays]))


def test_gradients_of_lines_are_those_of_finite_differences():
    lines = [torch.rand(4, 2, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    u = torch.rand(5, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *grids: ops.cp_density.reference(u, grids), lines)
    assert torch.autograd.gradcheck(lambda *grids: ops.cp_features.reference(u, grids), lines)


@pytest.mark.parametrize("visible", [1.0, 0.5])
def test_compiled_and_plain_lookups_agree(visible):
    field = small(density_components=24, appearance_components=16)
    with gridreg.apply(
        field,
        gridreg.FixedMask("density", visible_ratio=visible),
        gridreg.FixedMask("appearance", visible_ratio=visible),
        total_steps=10,
    ):
        results = []
        for backend in ("torch", "auto"):
            field.zero_grad()
            with use_backend(backend):
                density, features = seen(field)
                (density.square().sum() + features.sin().sum()).backward()
            gradients = [
                lines._parameters[str(k)].grad.clone()
                for lines in (field.density_lines, field.appearance_lines)
                for k in range(3)
            ]
            results.append([density.detach(), features.detach(), *gradients])
    for plain, compiled in zip(*results, strict=True):
        torch.testing.assert_close(compiled, plain, atol=2e-4, rtol=2e-4)


class Apart(torch.nn.Module):
    """A field without a march of its own, so that march, density and termination run one after the other."""

    def __init__(self, field):
        super().__init__()
        self.field, self.bounds = field, field.bounds

    def density(self, x):
        return self.field.density(x)

    def colour(self, x, d):
        return self.field.colour(x, d)


@pytest.mark.parametrize("backend", ["torch", "auto"])
@given(seed=st.integers(0, 20), bound=st.sampled_from([0.0, 1e-3]), visible=st.sampled_from([1.0, 0.5]))
def test_marching_in_one_call_is_marching_step_by_step(backend, seed, bound, visible):
    field = small((9, 8, 10), seed, density_components=16, density_shift=-1.0)
    generator = torch.Generator().manual_seed(seed)
    aim = BOX[0] + torch.rand(12, 3, generator=generator) * (BOX[1] - BOX[0])
    directions = torch.nn.functional.normalize(torch.randn(12, 3, generator=generator), dim=-1)
    rays = Rays(aim - 5 * directions, directions)
    grid = OccupancyGrid.full(BOX, (6, 6, 6))
    grid.cells[2] = 0
    results = []
    with (
        use_backend(backend),
        gridreg.apply(field, gridreg.FixedMask("density", visible_ratio=visible), total_steps=10),
    ):
        for one in (field, Apart(field)):
            field.zero_grad()
            out = render_rays(
                one, rays, grid, MarchSettings(0.07, transmittance_bound=bound), background=torch.ones(3)
            )
            out.opacity.square().sum().backward()
            gradients = [field.density_lines._parameters[str(k)].grad.clone() for k in range(3)]
            assert len(out.samples) > 0
            results.append([out.samples.offsets, out.samples.index, out.opacity.detach(), *gradients])
    for fused, apart in zip(*results, strict=True):
        torch.testing.assert_close(fused, apart, atol=1e-4, rtol=1e-3)


def test_a_few_steps_of_training_bring_a_picture_closer():
    field = small(
        (16, 16, 16), scale=0.2, density_components=24, appearance_components=24, density_shift=None
    )
    generator = torch.Generator().manual_seed(0)
    targets = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator), dim=-1)
    origins = torch.tensor([0.0, -0.5, 1.5]) - 4 * targets
    rays = Rays(origins, targets)
    colours = torch.rand(64, 3, generator=generator)
    grid = OccupancyGrid.full(field.bounds, (8, 8, 8))
    optimizer = torch.optim.Adam(
        [
            {**group, "lr": {"grid": 0.02, "network": 1e-3}[group["name"]]}
            for group in field.parameter_groups()
        ]
    )
    losses = []
    for _ in range(25):
        rendered = render_rays(field, rays, grid, MarchSettings(0.1), background=torch.ones(3))
        loss = (rendered.colour - colours).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


def test_it_is_found_by_name_and_refuses_unknown_options():
    field = make_field("cp", BOX, (4, 4, 4), density_components=2, appearance_components=3)
    assert isinstance(field, CPField)
    groups = field.parameter_groups()
    assert (groups[0]["name"], len(groups[0]["params"])) == ("grid", 6)
    assert sorted(id(p) for g in groups for p in g["params"]) == sorted(id(p) for p in field.parameters())
    with pytest.raises(gridreg.InputError, match="backbone 'cp'"):
        make_field("cp", BOX, (4, 4, 4), density_planes=2)
    with pytest.raises(ValueError, match=r"resolution=\(1, 4, 4\)"):
        CPField(BOX, (1, 4, 4))
