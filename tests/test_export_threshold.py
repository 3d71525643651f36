"""The density at which a surface is cut out: that of the field's shadows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gridreg.export.mesh import extract_mesh
from gridreg.export.volume import DensityVolume, SeenDensity, sample_density, surface_threshold
from tests.export_fields import AnalyticField, ball, union
from tests.export_meshes import radii


class TestThreshold:
    def volume(self, function, resolution=33):
        field = AnalyticField(function)
        return sample_density(SeenDensity(field), field.bounds, resolution)

    @pytest.mark.parametrize("resolution", [17, 33, 65])
    def test_half_of_a_homogeneous_solid_at_any_resolution(self, resolution):
        assert surface_threshold(self.volume(ball(0.7, 12.0), resolution)) == pytest.approx(6.0)

    def test_haze_does_not_move_it(self):
        solid = self.volume(ball(0.7, 200.0))
        hazy = self.volume(union(ball(0.7, 200.0), lambda x: torch.full((len(x),), 0.2)))
        assert surface_threshold(hazy) == pytest.approx(surface_threshold(solid))

    def test_a_denser_field_is_seen_further_out(self):
        def soft(x: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.softplus((0.6 - x.norm(dim=-1)) * 40)

        faint, dense = (AnalyticField(lambda x, k=k: k * soft(x)) for k in (0.5, 50.0))
        sizes = [radii(extract_mesh(field, resolution=33)).mean() for field in (faint, dense)]
        assert 0.5 < sizes[0] < sizes[1] < 0.75

    def test_surface_of_a_soft_solid_is_where_rays_see_it(self):
        def soft(x: torch.Tensor) -> torch.Tensor:
            return 200 * ((0.6 - x.norm(dim=-1)) / 0.1).clamp(0, 1)

        mesh = extract_mesh(AnalyticField(soft), resolution=65)
        # A ray to the centre has lost half of its light where 200 / 0.1 * depth^2 / 2 = log 2.
        seen = 0.6 - math.sqrt(2 * math.log(2) * 0.1 / 200)
        assert np.abs(radii(mesh) - seen).max() < 2 / 64

    @pytest.mark.parametrize("scale", [0.5, 2.0, 8.0])
    def test_matches_a_plain_loop_over_rays(self, scale):
        rng = np.random.default_rng(0)
        values = rng.exponential(scale, (5, 6, 7)).astype(np.float32)
        volume = DensityVolume(values, np.zeros(3), np.array([0.3, 0.2, 0.1]))
        found, largest, opaque = [], [], 0
        for axis, spacing in enumerate(volume.spacing):
            for ray in np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis]):
                largest.append(ray.max())
                opaque += math.exp(-float(ray.sum()) * spacing) <= 0.5
                for line in (ray, ray[::-1]):
                    light = 1.0
                    for density in line:
                        light *= math.exp(-density * spacing)
                        if light <= 0.5:
                            found.append(density)
                            break
        largest = [*sorted(largest, reverse=True), 0.0]
        expected = min((largest[opaque - 1] + largest[opaque]) / 2, np.median(found) / 2)
        assert surface_threshold(volume) == pytest.approx(expected, rel=1e-5)

    def test_shadows_of_the_mesh_are_those_of_the_field(self):
        def blurred(x: torch.Tensor) -> torch.Tensor:
            return 40 * torch.sigmoid((0.5 - x.norm(dim=-1)) * 20)

        volume = self.volume(blurred, 65)
        level = surface_threshold(volume)
        seen = sum((volume.values.sum(axis=a) * volume.spacing[a] >= math.log(2)).sum() for a in range(3))
        hit = sum((volume.values.max(axis=a) >= level).sum() for a in range(3))
        assert hit == pytest.approx(seen, rel=0.02)
        # Half of the density inside would be where the blur has its middle; rays see it further out.
        assert np.abs(radii(extract_mesh(AnalyticField(blurred), resolution=65))).mean() > 0.53

    def test_override(self):
        field = AnalyticField(lambda x: 100 * (1 - x.norm(dim=-1)).clamp(min=0))
        mesh = extract_mesh(field, resolution=33, threshold=60.0)
        assert mesh.threshold == 60.0
        assert np.abs(radii(mesh) - 0.4).max() < 1e-3
