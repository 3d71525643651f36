"""The VM field's march in one call, and which components it reads."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F

import gridreg
from backbones.vm import VMField
from gridreg.ops import use_backend
from gridreg.rendering import MarchSettings, OccupancyGrid, Rays, render_rays

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 3.0]])


def small(seed=0, components=32, cls=VMField):
    generator = torch.Generator().manual_seed(seed)
    return cls(
        BOX,
        (9, 8, 10),
        density_components=components,
        appearance_components=4,
        generator=generator,
        scale=0.5,
        density_shift=-1.0,
        precision="float32",
    )


class Apart(torch.nn.Module):
    """A field without a march of its own, so that march, density and termination run one after the other."""

    def __init__(self, field):
        super().__init__()
        self.field, self.bounds = field, field.bounds

    def density(self, x):
        return self.field.density(x)

    def colour(self, x, d):
        return self.field.colour(x, d)


def some_rays(seed):
    generator = torch.Generator().manual_seed(seed)
    aim = BOX[0] + torch.rand(12, 3, generator=generator) * (BOX[1] - BOX[0])
    directions = F.normalize(torch.randn(12, 3, generator=generator), dim=-1)
    return Rays(aim - 5 * directions, directions)


def gradients_of(field):
    return [p.grad.clone() for name, p in field.named_parameters() if name.startswith("density")]


@pytest.mark.parametrize("backend", ["torch", "auto"])
@given(seed=st.integers(0, 20), bound=st.sampled_from([0.0, 1e-3]), visible=st.sampled_from([1.0, 0.6]))
def test_marching_in_one_call_is_marching_step_by_step(backend, seed, bound, visible):
    field, rays = small(seed), some_rays(seed)
    grid = OccupancyGrid.full(BOX, (6, 6, 6))
    grid.cells[2] = 0
    results = []
    with (
        use_backend(backend),
        gridreg.apply(field, gridreg.FixedMask("density", visible_ratio=visible), total_steps=10),
    ):
        for one in (field, Apart(field)):
            field.zero_grad()
            march = MarchSettings(0.07, transmittance_bound=bound)
            out = render_rays(one, rays, grid, march, background=torch.ones(3))
            out.opacity.square().sum().backward()
            assert len(out.samples) > 0
            results.append(
                [out.samples.offsets, out.samples.index, out.opacity.detach(), *gradients_of(field)]
            )
    for fused, apart in zip(*results, strict=True):
        torch.testing.assert_close(fused, apart, atol=1e-4, rtol=1e-3)


MASKED = {
    "all lines": ["density_lines.*"],
    "one line": ["density_lines.0"],
    "two lines": ["density_lines.1", "density_lines.2"],
    "all planes": ["density_planes.*"],
    "lines and a plane": ["density_lines.0", "density_lines.1", "density_planes.2"],
}


@pytest.mark.parametrize("globs", MASKED.values(), ids=MASKED)
def test_a_mask_on_some_factors_closes_only_their_products(globs):
    field, rays = small(), some_rays(3)
    grid = OccupancyGrid.full(BOX, (6, 6, 6))
    masks = [gridreg.FixedMask(gridreg.parameters(glob, dim=-1), visible_ratio=0.5) for glob in globs]
    results = []
    with gridreg.apply(field, *masks, total_steps=10):
        for backend in ("torch", "auto"):
            with use_backend(backend):
                density = field.density(rays.origins + 5 * rays.directions).detach()
                out = render_rays(field, rays, grid, MarchSettings(0.1), background=torch.ones(3))
                results.append([density, out.opacity.detach()])
        # What the masked factors, written out, give.
        plain = small()
        for glob in globs:
            kind, number = glob.split(".")
            for k in range(3) if number == "*" else [int(number)]:
                with torch.no_grad():
                    getattr(plain, kind)[k][..., 16:] = 0
        results.append([plain.density(rays.origins + 5 * rays.directions).detach(), results[0][1]])
    for one in results[1:]:
        for found, expected in zip(one, results[0], strict=True):
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_a_subclass_with_its_own_density_is_marched_through_it():
    class Doubled(VMField):
        def density(self, x):
            return 2 * super().density(x)

    field, plain, rays = small(cls=Doubled), small(), some_rays(1)
    grid = OccupancyGrid.full(BOX, (6, 6, 6))
    march = MarchSettings(0.1, transmittance_bound=0.0)
    doubled = render_rays(field, rays, grid, march, background=torch.ones(3)).samples.density
    single = render_rays(plain, rays, grid, march, background=torch.ones(3)).samples.density
    torch.testing.assert_close(doubled, 2 * single)
