"""The plain operations against loops written from their formulas, and the choice between versions."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gridreg import ops
from gridreg.errors import InputError
from gridreg.ops import composite, dispatch, ray_marching
from gridreg.ops.dispatch import chosen_backend, is_cpu_float32, operation, use_backend

accumulate, composite_weights, terminate = ops.accumulate, ops.composite_weights, ops.terminate

F = np.float32


@pytest.fixture(autouse=True)
def _plain_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """These tests see the plain versions."""
    monkeypatch.setattr(dispatch, "_choice", "torch")


def march(*arguments, **named):
    return ops.march(ops.MarchArguments(*arguments, **named))


def march_by_hand(o, d, t_min, t_max, step, cells, bounds, jitter):
    """One sample at a time, in float32, from the definition."""
    counts, index, ts, xs = [0], [], [], []
    shape = np.array(cells.shape)
    scale = (shape.astype(F) / (bounds[1] - bounds[0]).astype(F)).astype(F)
    for r in range(len(o)):
        i = 0
        while t_max[r] > t_min[r]:
            t = F(t_min[r] + F(F(F(i) + jitter[r]) * F(step)))
            if not t < t_max[r]:
                break
            x = (o[r] + (t * d[r]).astype(F)).astype(F)
            cell = ((x - bounds[0]) * scale).astype(F)
            inside = bool(((cell >= F(-1e-3)) & (cell <= (shape.astype(F) + F(1e-3)))).all())
            c = np.clip(np.floor(cell).astype(int), 0, shape - 1)
            if inside and cells[c[0], c[1], c[2]]:
                index.append(i)
                ts.append(t)
                xs.append(x)
            i += 1
        counts.append(len(index))
    return np.array(counts), np.array(index), np.array(ts, F), np.array(xs, F).reshape(-1, 3)


def random_rays(seed: int, rays: int, shape: tuple[int, int, int], fill: float):
    """Rays through and past a box, some of them empty or parallel to its faces."""
    g = torch.Generator().manual_seed(seed)
    bounds = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 1.5, 1.0]])
    directions = torch.randn(rays, 3, generator=g)
    directions[::3, 1] = 0.0
    directions = torch.nn.functional.normalize(directions, dim=-1)
    middle = bounds[0] + torch.rand(rays, 3, generator=g) * (bounds[1] - bounds[0])
    t_min = torch.rand(rays, generator=g)
    origins = middle - 2 * directions
    t_max = 3 + torch.rand(rays, generator=g)
    t_max[::4] = t_min[::4]
    cells = (torch.rand(shape, generator=g) < fill).to(torch.uint8)
    jitter = torch.rand(rays, generator=g)
    return origins, directions, t_min, t_max, cells, bounds, jitter


def random_packed(seed: int, counts: list[int], dtype: torch.dtype = torch.float64):
    g = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    tau = torch.rand(int(offsets[-1]), generator=g, dtype=dtype) * 2
    return tau, offsets


class TestMarch:
    @settings(max_examples=30, deadline=None)
    @given(
        seed=st.integers(0, 2**31),
        rays=st.integers(0, 9),
        shape=st.tuples(*[st.integers(1, 6)] * 3),
        fill=st.sampled_from([0.0, 0.3, 1.0]),
        step=st.floats(0.05, 1.0),
    )
    def test_definition(self, seed, rays, shape, fill, step):
        o, d, t_min, t_max, cells, bounds, jitter = random_rays(seed, rays, shape, fill)
        found = march(o, d, t_min, t_max, step, cells, bounds, jitter)
        hand = march_by_hand(
            *(x.numpy() for x in (o, d, t_min, t_max)), step, cells, bounds.numpy(), jitter.numpy()
        )
        for tensor, array in zip(found, hand, strict=True):
            np.testing.assert_array_equal(tensor.numpy(), array)
        assert [x.dtype for x in found] == [torch.int64, torch.int64, torch.float32, torch.float32]

    def test_blocks_do_not_matter(self, monkeypatch):
        o, d, t_min, t_max, cells, bounds, jitter = random_rays(3, 40, (4, 5, 6), 0.5)
        whole = march(o, d, t_min, t_max, 0.1, cells, bounds, jitter)
        monkeypatch.setattr(ray_marching, "_BLOCK", 100)
        for a, b in zip(whole, march(o, d, t_min, t_max, 0.1, cells, bounds, jitter), strict=True):
            assert torch.equal(a, b)

    def test_full_box_holds_every_step(self):
        bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
        o, d = torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]])
        cells = torch.ones(2, 2, 2, dtype=torch.bool)
        offsets, index, t, x = march(o, d, torch.ones(1), torch.full((1,), 2.0), 0.125, cells, bounds, 0.5)
        assert offsets.tolist() == [0, 8]
        assert index.tolist() == list(range(8))
        torch.testing.assert_close(t, 1.0625 + 0.125 * torch.arange(8))
        torch.testing.assert_close(x[:, 0], t - 1)

    def test_range_past_the_box_is_empty(self):
        bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
        o, d = torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]])
        cells = torch.ones(2, 2, 2, dtype=torch.uint8)
        _, _, t, _ = march(o, d, torch.zeros(1), torch.full((1,), 9.0), 0.25, cells, bounds, 0.5)
        assert t.tolist() == [1.125, 1.375, 1.625, 1.875]

    def test_nan_range_has_no_samples(self):
        o, d, t_min, t_max, cells, bounds, jitter = random_rays(3, 4, (2, 2, 2), 1.0)
        t_max[1] = math.nan
        offsets = march(o, d, t_min, t_max, 0.1, cells, bounds, jitter)[0]
        assert offsets[2] == offsets[1]

    @pytest.mark.parametrize(
        ("change", "word"),
        [
            ({"step": 0.0}, "step"),
            ({"step": math.nan}, "step"),
            ({"t_max": torch.full((3,), math.inf)}, "t_max"),
            ({"t_min": torch.zeros(2)}, "t_min"),
            ({"origins": torch.zeros(3, 2)}, "origins"),
            ({"cells": torch.ones(2, 2, 2)}, "cells"),
            ({"cells": torch.ones(2, 2, dtype=torch.uint8)}, "cells"),
            ({"bounds": torch.zeros(3, 2)}, "bounds"),
            ({"jitter": torch.zeros(2)}, "jitter"),
        ],
    )
    def test_bad_arguments(self, change, word):
        names = ("origins", "directions", "t_min", "t_max", "cells", "bounds", "jitter")
        arguments = dict(zip(names, random_rays(0, 3, (2, 2, 2), 1.0), strict=True), step=0.1) | change
        with pytest.raises(InputError, match=word):
            march(**arguments)


counts_lists = st.lists(st.integers(0, 6), max_size=8)


class TestCompositing:
    @settings(max_examples=30, deadline=None)
    @given(counts=counts_lists, seed=st.integers(0, 2**31))
    def test_definition(self, counts, seed):
        tau, offsets = random_packed(seed, counts)
        values = torch.rand(tau.numel(), 2, dtype=tau.dtype)
        weights, seen = composite_weights(tau, offsets), terminate(tau, offsets, 0.25)
        sums = accumulate(weights, values, offsets)
        for r in range(len(counts)):
            behind, total = 1.0, np.zeros(2)
            for n in range(int(offsets[r]), int(offsets[r + 1])):
                assert seen[n] == (behind >= 0.25)
                weight = behind * (1 - math.exp(-tau[n]))
                assert weights[n].item() == pytest.approx(weight, rel=1e-9)
                total += weight * values[n].numpy()
                behind *= math.exp(-tau[n])
            np.testing.assert_allclose(sums[r].numpy(), total, rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize("counts", [[3], [0, 2, 0, 4, 1], []])
    def test_gradcheck(self, counts):
        tau, offsets = random_packed(5, counts)
        tau.requires_grad_()
        values = torch.rand(tau.numel(), 3, dtype=tau.dtype, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x: composite_weights(x, offsets), (tau,))
        assert torch.autograd.gradcheck(lambda w, v: accumulate(w, v, offsets), (tau, values))

    def test_opaque_sample_hides_the_rest(self):
        tau = torch.tensor([0.5, math.inf, 1.0, 2.0], requires_grad=True)
        weights = composite_weights(tau, torch.tensor([0, 3, 4]))
        weights.sum().backward()
        assert weights[2] == 0
        assert weights[:3].sum().item() == pytest.approx(1.0)
        assert tau.grad is not None
        assert torch.isfinite(tau.grad).all()

    def test_blocks_do_not_matter(self, monkeypatch):
        tau, offsets = random_packed(8, [3, 0, 9, 1, 4, 0])
        whole = composite_weights(tau, offsets)
        monkeypatch.setattr(composite, "_BLOCK", 5)
        assert torch.equal(whole, composite_weights(tau, offsets))

    def test_termination_changes_a_colour_by_less_than_the_bound(self):
        tau, offsets = random_packed(2, [60] * 20)
        for bound in (0.0, 1e-2, 1e-4):
            seen = terminate(tau, offsets, bound)
            weights = composite_weights(tau, offsets)
            lost = accumulate(
                torch.where(seen, 0.0, weights), torch.ones(tau.numel(), 1, dtype=tau.dtype), offsets
            )
            assert float(lost.max()) <= bound
            assert bool(seen.all()) == (bound == 0.0)

    def test_bad_arguments(self):
        tau, offsets = random_packed(2, [2, 3])
        with pytest.raises(InputError, match="expected 4"):
            composite_weights(tau[:4], offsets)
        with pytest.raises(InputError, match="int64"):
            terminate(tau, offsets.float(), 0.1)
        with pytest.raises(InputError, match=r"expected \(5, K\)"):
            accumulate(tau, torch.ones(4, 2, dtype=tau.dtype), offsets)
        with pytest.raises(InputError, match=r"expected \(N,\)"):
            composite_weights(tau[None], offsets)


class TestChoice:
    def test_names(self, monkeypatch):
        with pytest.raises(InputError, match="expected one of auto, compiled, torch"):
            use_backend("cuda")
        monkeypatch.setattr(dispatch, "_compiled", set())
        with pytest.raises(InputError, match="numba is not installed"):
            use_backend("compiled")

    def test_function_and_context(self):
        use_backend("torch")
        assert chosen_backend() == "torch"
        with use_backend("auto"):
            assert chosen_backend() == "auto"
        assert chosen_backend() == "torch"
        with pytest.raises(RuntimeError, match="inside"), use_backend("auto"):
            raise RuntimeError("inside")
        assert chosen_backend() == "torch"

    def test_the_version_follows_choice_and_tensors(self, monkeypatch):
        monkeypatch.setattr(dispatch, "_compiled", set())

        def check(x, others=()):
            if x.dim() != 1:
                raise InputError("x: expected one axis")

        @operation(check=check)
        def version(x, others=()):
            """Which ran."""
            return "plain"

        assert version.__doc__ == "Which ran."
        assert version.__module__ == __name__
        with use_backend("auto"):
            assert version(torch.zeros(1)) == "plain"

        @version.register_cpu()
        def compiled(x, others=()):
            return "compiled"

        x = torch.zeros(3)
        for name, expected in (("auto", "compiled"), ("compiled", "compiled"), ("torch", "plain")):
            with use_backend(name):
                assert version(x) == expected
                assert (
                    version(x.double()) == version(x, others=[x.double()]) == version(x.to("meta")) == "plain"
                )
                assert version(x, others=[torch.zeros(2, dtype=torch.int64)]) == expected
                with pytest.raises(InputError, match="one axis"):
                    version(x[None])
        version.register_cpu(suits=lambda x, others=(): len(x) > 3)(compiled)
        with use_backend("auto"):
            assert (version(x), version(torch.zeros(4))) == ("plain", "compiled")

    def test_what_suits_compiled_code(self):
        x = torch.zeros(2)
        assert is_cpu_float32(x, (x, [x]), torch.zeros(1, dtype=torch.uint8), 1.0, None, flag=True)
        assert not is_cpu_float32(x, (x, [x.double()]))
        assert not is_cpu_float32(x, named=x.half())
        assert not is_cpu_float32(torch.zeros(1, dtype=torch.int64, device="meta"))
        assert not is_cpu_float32(torch.zeros(1, dtype=torch.uint8).expand(2**31))

    def test_a_field_of_ones_own_is_marched_and_composited_by_compiled_code(self):
        """Registration comes with `gridreg.rendering`; nothing else has to be imported."""
        code = """if True:
            import torch
            from gridreg import rendering
            class Ball:
                bounds = torch.tensor([[-1.0] * 3, [1.0] * 3])
                def density(self, x):
                    return torch.where(x.norm(dim=-1) < 0.5, 20.0, 0.0)
                def colour(self, x, d):
                    return x * 0 + 0.5
            rays = rendering.Rays(torch.tensor([[-3.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
            grid = rendering.OccupancyGrid.full(Ball.bounds, (4, 4, 4))
            from gridreg import ops
            for one in (ops.march, ops.composite_weights, ops.terminate, ops.merge_samples, ops.pixels):
                def refuse(*arguments, **named):
                    raise AssertionError("plain")
                one.reference = refuse
            out = rendering.render_rays(Ball(), rays, grid, rendering.MarchSettings(0.01), background=torch.ones(3))
            print(round(float(out.colour[0, 0]), 3))
        """
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.stdout.strip() == "0.5", done.stderr

    def test_without_numba_all_is_plain(self):
        code = """if True:
            import sys
            class Missing:
                def find_spec(self, name, path=None, target=None):
                    if name.split(".")[0] in ("numba", "llvmlite"):
                        raise ModuleNotFoundError(name)
            sys.meta_path.insert(0, Missing())
            import torch
            from backbones.vm import VMField
            from gridreg import ops
            field = VMField(torch.tensor([[-1.0] * 3, [1.0] * 3]), (5, 5, 5))
            x = torch.rand(4, 3)
            optimizer = field.make_optimizer(field.parameter_groups(), (0.9, 0.99))
            with field.gradient_context():
                (field.density(x).sum() + field.colour(x, x).sum()).backward()
            optimizer.step()
            assert not any(isinstance(one, ops.dispatch.Operation) and one.compiled for one in vars(ops).values())
            try:
                ops.use_backend("compiled")
            except ValueError as error:
                print(error)
        """
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.stdout.startswith("backend 'compiled': numba is not installed"), done.stderr
