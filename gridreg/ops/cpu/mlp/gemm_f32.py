"""Blocks of matrix products of float32 by multiplying and adding: what `gridreg.ops.cpu.mlp.fused_f32` is made of.

As in `gridreg.ops.cpu.mlp.gemm_bf16` a block of results stays in registers, and ends with what a layer needs. How large
it is follows from the registers that the processor has.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops.cpu.jit.compiler import inline, intrinsic
from gridreg.ops.cpu.mlp.gemm_tile import (
    INDEX,
    LONG,
    REALS,
    ahead,
    everywhere,
    has,
    places_of,
    relu,
    summed,
)

__all__ = [
    "HIGH",
    "full_one",
    "full_two",
    "gate_one",
    "gate_two",
    "pack",
    "product",
    "relu_one",
    "relu_two",
    "sum_products",
]

_FLAGS = ("contract", "nsz")


# Rows of a block of results, and vectors in each: 16 registers of results of 32 (AVX-512), or 8 of 16.
HIGH, _VECTORS = (8, 2) if has("avx512f") else (4, 1)


def _block(vectors: int, ending: str) -> Any:
    """An intrinsic for a block of results, `HIGH` rows and 16 columns for each of ``vectors``, that stays in registers.

    ``block(a, at, down, along, b, begin, step, panel, count, c, to, row, d, n)``: for ``r < HIGH`` and
    ``j < 16 vectors``, with ``v = j // 16``, the sum over ``k < count`` of
    ``a[at + r down + k along] b[begin + k step + v panel + j % 16]`` ends in ``c[to + r row + j]``. What becomes of the
    sum is the ending's: ``add``: added to what stands in c; ``full``: d from ``n`` on is added; ``relu``: its ReLU;
    ``gate``: 0 where d, ``n`` behind the place of c, is not positive.
    """

    @intrinsic
    def block(
        context: Any, a: Any, at: Any, down: Any, along: Any, b: Any, begin: Any, step: Any, panel: Any, count: Any,
        c: Any, to: Any, row: Any, d: Any, n: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            left, right, out, more = (
                context.make_array(signature.args[k])(context, builder, arguments[k]).data
                for k in (0, 4, 9, 12)
            )
            _, at, down, along, _, begin, step, panel, count, _, to, row, _, n = arguments
            places = places_of(builder, to, row, HIGH, vectors)
            nothing = ir.Constant(REALS, [0.0] * LONG)
            before = [nothing] * len(places)
            if ending == "add":
                before = [builder.load(ahead(builder, out, place), align=4) for place in places]

            def grow(number: Any, sums: Any) -> list[Any]:
                first = builder.add(begin, builder.mul(number, step))
                factors = [
                    builder.load(
                        ahead(builder, right, builder.add(first, builder.mul(panel, INDEX(v)))), align=4
                    )
                    for v in range(vectors)
                ]
                start = builder.add(at, builder.mul(number, along))
                grown: list[Any] = []
                for r in range(HIGH):
                    one = builder.load(builder.gep(left, [builder.add(start, builder.mul(down, INDEX(r)))]))
                    one = everywhere(builder, one)
                    for factor in factors:
                        product = builder.fmul(one, factor, flags=_FLAGS)
                        grown.append(builder.fadd(sums[len(grown)], product, flags=_FLAGS))
                return grown

            sums = summed(builder, before, count, grow)
            for nth, (place, value) in enumerate(zip(places, sums, strict=True)):
                if ending in ("full", "relu"):
                    bias = builder.add(n, INDEX(LONG * (nth % vectors)))
                    value = builder.fadd(value, builder.load(ahead(builder, more, bias), align=4))
                if ending == "relu":
                    value = relu(builder, value)
                if ending == "gate":
                    seen = builder.load(ahead(builder, more, builder.add(place, n)), align=4)
                    value = builder.select(builder.fcmp_ordered(">", seen, nothing), value, nothing)
                builder.store(value, ahead(builder, out, place), align=4)
            return context.get_dummy_value()

        i = types.int64
        return types.void(a, i, i, i, b, i, i, i, i, c, i, i, d, i), generate

    return block


_add_two, _add_one = _block(2, "add"), _block(1, "add")
full_two, full_one = _block(2, "full"), _block(1, "full")
relu_two, relu_one = _block(2, "relu"), _block(1, "relu")
gate_two, gate_one = _block(2, "gate"), _block(1, "gate")


@inline
def product(
    a: Any, at: Any, width: Any, taken: Any, count: Any, weight: Any, columns: Any, out: Any, to: Any, more: Any,
    n: Any, along: Any, two: Any, one: Any,
) -> Any:  # fmt: skip
    """Rows of a, ``width`` wide, of which ``taken`` columns count, from element ``at`` on, times a packed weight, to
    rows of ``columns`` from ``to`` on.

    ``more`` is what the ending takes, from ``n`` on; ``along`` is 1 if it is one number for a column, else 0.
    """
    panel = taken * LONG
    both = columns - columns % (2 * LONG) if _VECTORS == 2 else 0
    for i in range(0, both, 2 * LONG):
        for r in range(0, count, HIGH):
            two(
                a, at + r * width, width, 1, weight, i * taken, LONG, panel, taken,
                out, to + r * columns + i, columns, more, n + i * along,
            )  # fmt: skip
    for i in range(both, columns, LONG):
        for r in range(0, count, HIGH):
            one(
                a, at + r * width, width, 1, weight, i * taken, LONG, panel, taken,
                out, to + r * columns + i, columns, more, n + i * along,
            )  # fmt: skip


@inline
def sum_products(
    slope: Any, high: Any, x: Any, begin: Any, width: Any, count: Any, out: Any, base: Any, across: Any
) -> Any:
    """Add ``slope^T x`` over some rows to out ``(high, across)``.

    Args:
        slope: ``high`` wide, from its first row on.
        x: ``width`` wide, from element ``begin`` on; its first ``across`` columns.
        count: rows.
        out: from ``base`` on.
    """
    both = across - across % (2 * LONG) if _VECTORS == 2 else 0
    for n in range(0, high, HIGH):
        to = base + n * across
        for k in range(0, both, 2 * LONG):
            _add_two(slope, n, 1, high, x, begin + k, width, LONG, count, out, to + k, across, out, 0)
        for k in range(both, across, LONG):
            _add_one(slope, n, 1, high, x, begin + k, width, LONG, count, out, to + k, across, out, 0)


def pack(weight: Tensor) -> Tensor:
    """A weight ``(out, in)`` as `product` reads it: ``(out / 16, in, 16)``, out rounded up."""
    rows = -(-weight.shape[0] // LONG) * LONG
    padded = F.pad(weight.detach(), (0, 0, 0, rows - weight.shape[0]))
    return padded.view(-1, LONG, weight.shape[1]).transpose(1, 2).contiguous()
