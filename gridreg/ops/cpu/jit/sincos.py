"""Sine and cosine of vectors, for kernels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils

from gridreg.ops.cpu.jit.compiler import intrinsic

__all__ = ["sine_and_cosine"]

# Half of pi in three parts, each a float32; what is multiplied and added at once is not rounded between.
_PARTS = (1.5707963705062866, -4.371138828673793e-08, -1.7151245100058819e-15)
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)


@intrinsic
def sine_and_cosine(context: Any, value: Any) -> Any:
    """``sine_and_cosine(x)``: both of each lane, to 2e-7 for sizes up to a million; not-a-number for what has none.

    The nearest multiple of a quarter turn is taken away in three parts (Cody and Waite 1980), and what is left goes
    into the polynomials of Cephes' sinf and cosf. No operation may be reordered here, so all is written out.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments
        lanes = x.type.count if isinstance(x.type, ir.VectorType) else 0
        name = f"v{lanes}f32" if lanes else "f32"
        word = ir.VectorType(ir.IntType(32), lanes) if lanes else ir.IntType(32)

        def constant(number: float | int, kind: Any) -> Any:
            return ir.Constant(kind, [number] * lanes if lanes else number)

        def real(number: float) -> Any:
            return constant(number, x.type)

        def function(symbol: str, count: int, result: Any) -> Any:
            kind = ir.FunctionType(result, [x.type] * count)
            return cgutils.get_or_insert_function(builder.module, kind, symbol)  # type: ignore[no-untyped-call]

        def multiply_add(a: Any, b: Any, c: Any) -> Any:
            return builder.call(function(f"llvm.fma.{name}", 3, x.type), [a, b, c])

        nearest = function(f"llvm.rint.{name}", 1, x.type)
        turns = builder.call(nearest, [builder.fmul(x, real(0.6366197724))])
        rest = x
        for part in _PARTS:
            rest = multiply_add(turns, real(-part), rest)
        square = builder.fmul(rest, rest)
        sine, cosine = real(_SINE[0]), real(_COSINE[0])
        for s, c in zip(_SINE[1:], _COSINE[1:], strict=True):
            sine, cosine = multiply_add(sine, square, real(s)), multiply_add(cosine, square, real(c))
        sine = multiply_add(builder.fmul(sine, square), rest, rest)
        cosine = multiply_add(
            builder.fmul(cosine, square), square, multiply_add(square, real(-0.5), real(1.0))
        )
        to_word = f"llvm.fptosi.sat.v{lanes}i32.{name}" if lanes else f"llvm.fptosi.sat.i32.{name}"
        quarter = builder.call(function(to_word, 1, word), [turns])

        def bit(value: Any, which: int) -> Any:
            return builder.icmp_signed("!=", builder.and_(value, constant(which, word)), constant(0, word))

        odd = bit(quarter, 1)
        sine, cosine = builder.select(odd, cosine, sine), builder.select(odd, sine, cosine)
        sine = builder.select(bit(quarter, 2), builder.fneg(sine), sine)
        ahead = builder.add(quarter, constant(1, word))
        cosine = builder.select(bit(ahead, 2), builder.fneg(cosine), cosine)
        return context.make_tuple(builder, signature.return_type, [sine, cosine])

    return types.UniTuple(value, 2)(value), generate  # type: ignore[no-untyped-call]
