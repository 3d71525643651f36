"""Solids: rays, distances, normals, samples and meshes against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg.scenes.builtin.solids import Ball, Cuboid, Frustum, Solid
from gridreg.scenes.builtin.tessellate import tessellate

lengths = st.floats(0.05, 1.5)
solids = st.one_of(
    st.builds(Ball, lengths),
    st.builds(lambda x, y, z: Cuboid((x, y, z)), lengths, lengths, lengths),
    st.builds(Frustum, lengths, lengths, lengths),
    st.builds(lambda r, h: Frustum(r, r, h), lengths, lengths),
    st.builds(lambda r, h: Frustum(r, 0.0, h), lengths, lengths),
)


class TestSolids:
    @settings(max_examples=80, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_rays_end_on_the_surface_and_cross_nothing_before(self, solid: Solid, seed: int) -> None:
        rng = np.random.default_rng(seed)
        origin = rng.standard_normal(3) * 3
        aim = np.array(solid.middle) + solid.reach * rng.uniform(-1, 1, (64, 3))
        direction = (aim - origin) * rng.uniform(0.2, 3, (64, 1))
        t = solid.intersect(origin, direction.T)
        hit = np.isfinite(t)
        assert np.abs(solid.distance(origin + t[hit, None] * direction[hit])).max(initial=0) < 1e-7
        # Marched by hand: no point before the hit, and no point of a missing ray, lies on the other side.
        side = np.sign(solid.distance(origin[None])[0])
        share = np.linspace(0, 1, 200)
        for ray in range(64):
            end = t[ray] * (1 - 1e-6) if hit[ray] else 4.0
            along = origin + (share * end)[:, None] * direction[ray]
            assert (side * solid.distance(along) > -1e-7).all()

    @settings(max_examples=60, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_distance_is_that_to_the_nearest_surface_point(self, solid: Solid, seed: int) -> None:
        rng = np.random.default_rng(seed)
        surface = solid.sample(20_000, rng)
        points = np.array(solid.middle) + 2 * solid.reach * rng.uniform(-1, 1, (20, 3))
        brute = np.linalg.norm(points[:, None] - surface, axis=-1).min(axis=1)
        spacing = math.sqrt(solid.area / len(surface))
        measured = np.abs(solid.distance(points))
        assert (measured <= brute + 1e-9).all()
        # Ten spacings of slack: few points fall near the tip of a cone.
        assert (brute <= measured + 10 * spacing).all()

    @settings(max_examples=60, deadline=None)
    @given(solids, st.integers(0, 2**16))
    def test_normals_are_the_gradient_of_the_distance(self, solid: Solid, seed: int) -> None:
        points = solid.sample(50, np.random.default_rng(seed))
        assert np.abs(solid.distance(points)).max() < 1e-9
        normals = solid.normal(points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)
        step = 1e-6
        np.testing.assert_allclose(solid.distance(points + step * normals), step, rtol=1e-3)
        assert (solid.distance(points - step * normals) < 0).all()

    @settings(max_examples=40, deadline=None)
    @given(solids)
    def test_meshes_and_areas_agree(self, solid: Solid) -> None:
        vertices, faces = tessellate(solid, solid.reach / 15)
        assert np.abs(solid.distance(vertices)).max() < 1e-9
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.area == pytest.approx(solid.area, rel=0.06)
        centre = np.array(solid.middle)
        outward = ((mesh.triangles_center - centre) * mesh.face_normals).sum(axis=1)
        assert (outward[mesh.area_faces > 1e-12] > 0).all()

    def test_samples_are_uniform(self) -> None:
        # Shares of a cone's base and side, and of a box's faces, by their areas.
        rng = np.random.default_rng(0)
        cone = Frustum(1.0, 0.0, 1.0)
        base = (np.abs(cone.sample(40_000, rng)[:, 2]) < 1e-12).mean()
        assert base == pytest.approx(1 / (1 + math.sqrt(2)), abs=0.01)
        side = cone.sample(40_000, rng)[:, 2]
        # The area of a cone's side above height h is (1 - h)^2 of the whole.
        assert (side[side > 0] > 0.5).mean() == pytest.approx(0.25, abs=0.01)
        box = Cuboid((1.0, 0.5, 0.25)).sample(40_000, rng)
        assert (np.abs(box[:, 2]) == 0.25).mean() == pytest.approx(0.5 / 0.875, abs=0.01)

    def test_no_tessellation_for_others(self) -> None:
        with pytest.raises(TypeError, match="no tessellation for a str"):
            tessellate("cone", 0.1)  # type: ignore[arg-type]
