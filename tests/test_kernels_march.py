"""The compiled march keeps exactly the samples of the plain one."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg import ops
from gridreg.errors import InputError

BOUNDS = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 1.5, 1.0]])


def random_scene(seed: int, rays: int, shape: tuple[int, int, int], fill: float):
    """Rays through and past the box, some parallel to its faces, some along cell faces, some empty."""
    g = torch.Generator().manual_seed(seed)
    directions = torch.randn(rays, 3, generator=g)
    directions[::3, 1] = 0.0
    directions[1::3, :2] *= 1e-6
    directions = torch.nn.functional.normalize(directions, dim=-1)
    middle = BOUNDS[0] + torch.rand(rays, 3, generator=g) * (BOUNDS[1] - BOUNDS[0])
    middle[::2] = BOUNDS[0] + ((middle[::2] - BOUNDS[0]) * 4).round() / 4
    t_min = torch.rand(rays, generator=g)
    t_max = 3 + torch.rand(rays, generator=g)
    t_max[::4] = t_min[::4]
    cells = (torch.rand(shape, generator=g) < fill).to(torch.uint8)
    jitter = torch.rand(rays, generator=g)
    return middle - 2 * directions, directions, t_min, t_max, cells, jitter


def march(*arguments):
    return ops.march.compiled(ops.MarchArguments(*arguments))


def plain_march(*arguments):
    return ops.march.reference(ops.MarchArguments(*arguments))


def run(implementation, scene, step, jitter=None):
    o, d, t_min, t_max, cells, drawn = scene
    return implementation(o, d, t_min, t_max, step, cells, BOUNDS, drawn if jitter is None else jitter)


def assert_same(found, expected):
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    rays=st.integers(0, 40),
    shape=st.tuples(*[st.integers(1, 19)] * 3),
    fill=st.sampled_from([0.0, 0.001, 0.02, 0.3, 1.0]),
    step=st.floats(0.004, 1.5),
)
def test_same_samples(seed, rays, shape, fill, step):
    scene = random_scene(seed, rays, shape, fill)
    assert_same(run(march, scene, step), run(plain_march, scene, step))


@pytest.mark.parametrize("offset", [0.0, 1e-7, -1e-7, 5e-4])
def test_rays_along_cell_faces(offset):
    cells = torch.zeros(8, 8, 8, dtype=torch.uint8)
    cells[3:5, ::3] = 1
    y = torch.linspace(-0.5, 1.5, 17) + offset
    o = torch.stack([torch.full_like(y, -2.0), y, torch.full_like(y, 0.5)], -1)
    d = torch.tensor([[1.0, 0.0, 0.0]]).expand(17, 3)
    arguments = (o, d, torch.full((17,), 0.5), torch.full((17,), 3.5), 0.0625, cells, BOUNDS)
    for jitter in (0.0, 0.5):
        assert_same(march(*arguments, jitter), plain_march(*arguments, jitter))


def test_number_or_tensor_as_jitter():
    scene = random_scene(4, 30, (7, 6, 5), 0.2)
    assert_same(run(march, scene, 0.05, 0.5), run(march, scene, 0.05, torch.full((30,), 0.5)))


def test_bool_cells_and_strided_inputs():
    o, d, t_min, t_max, cells, jitter = random_scene(4, 30, (7, 6, 5), 0.2)
    plainly = run(march, (o, d, t_min, t_max, cells, jitter), 0.05)
    strided = (
        o.T.contiguous().T,
        d.T.contiguous().T,
        torch.stack([t_min, t_min], 1)[:, 0],
        t_max,
        cells.permute(2, 1, 0).contiguous().permute(2, 1, 0).bool(),
        jitter,
    )
    assert_same(run(march, strided, 0.05), plainly)


def test_long_rays():
    """More lattice steps than fit a few words, and empty space that is crossed in one stride."""
    o = torch.tensor([[-900.0, 0.3, 0.4]])
    d = torch.tensor([[1.0, 0.0, 0.0]])
    cells = torch.zeros(64, 64, 64, dtype=torch.uint8)
    cells[60] = 1
    arguments = (o, d, torch.zeros(1), torch.full((1,), 2000.0), 0.25, cells, BOUNDS * 100, 0.25)
    found = march(*arguments)
    assert_same(found, plain_march(*arguments))
    assert found[1].numel() > 0


def test_nan_and_infinite_ranges():
    scene = random_scene(4, 8, (7, 6, 5), 0.5)
    scene[3][1] = math.nan
    scene[0][2] = math.nan
    assert_same(run(march, scene, 0.05), run(plain_march, scene, 0.05))
    scene[3][1] = math.inf
    with pytest.raises(InputError, match="steps"):
        run(march, scene, 0.05)


def test_thread_count_does_not_matter():
    scene = random_scene(11, 500, (16, 16, 16), 0.1)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = run(march, scene, 0.01)
        torch.set_num_threads(2)
        assert_same(run(march, scene, 0.01), alone)
    finally:
        torch.set_num_threads(threads)
