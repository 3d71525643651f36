"""The softplus of densities, for kernels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]

from gridreg.ops.cpu.jit.compiler import float32, inline, intrinsic
from gridreg.ops.cpu.jit.simd_math import divide, magnitude

__all__ = ["softplus"]


def _typed(value: Any, number: float | int, kind: Any) -> Any:
    """``number`` in every lane, as an LLVM constant of ``kind`` with as many lanes as ``value``."""
    if isinstance(value.type, ir.VectorType):
        return ir.Constant(ir.VectorType(kind, value.type.count), [number] * value.type.count)
    return ir.Constant(kind, number)


@intrinsic
def _at_least(context: Any, value: Any, bound: Any) -> Any:
    """``_at_least(x, bound)``: the larger one, ``x`` if it is not a number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x, bound = arguments
        return builder.select(builder.fcmp_ordered("<", x, bound), bound, x)

    return value(value, value), generate


@intrinsic
def _rounded(context: Any, value: Any) -> Any:
    """``_rounded(x)``: the nearest integer, -126 if it is less or not a number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments
        name = f"llvm.rint.v{x.type.count}f32" if isinstance(x.type, ir.VectorType) else "llvm.rint.f32"
        nearest = builder.module.globals.get(name)
        if nearest is None:
            nearest = ir.Function(builder.module, ir.FunctionType(x.type, [x.type]), name)
        least = _typed(x, -126.0, ir.FloatType())
        return builder.select(builder.fcmp_ordered(">", x, least), builder.call(nearest, [x]), least)

    return value(value), generate


@intrinsic
def _power_of_two(context: Any, value: Any) -> Any:
    """``_power_of_two(n)``: 2^n, for integral n in [-126, 127]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments
        word = ir.IntType(32)
        kind = ir.VectorType(word, x.type.count) if isinstance(x.type, ir.VectorType) else word
        biased = builder.add(builder.fptosi(x, kind), _typed(x, 127, word))
        return builder.bitcast(builder.shl(biased, _typed(x, 23, word)), x.type)

    return value(value), generate


@inline
def softplus(x: Any, zero: Any) -> Any:
    """``log(1 + exp(x))`` to 1e-6 relative down to -87, where it is 1e-38, and constant below.

    In a few polynomials, eight at a time: exp(-|x|) as in Cephes' expf, and log(1 + y) = 2 artanh(y / (2 + y)), a short
    series for y in [0, 1].

    Args:
        x: float32, or a vector of them.
        zero: of the same type.
    """
    least = _at_least(zero - magnitude(x), zero - float32(87))
    n = _rounded(least * float32(1.44269504))
    r = least - n * float32(0.693147181)
    p = r * float32(1.9875691500e-4) + float32(1.3981999507e-3)
    p = p * r + float32(8.3334519073e-3)
    p = p * r + float32(4.1665795894e-2)
    p = p * r + float32(1.6666665459e-1)
    p = p * r + float32(5.0000001201e-1)
    y = (p * r * r + r + float32(1)) * _power_of_two(n)
    z = divide(y, y + float32(2))
    q = z * z
    s = q * float32(1 / 15) + float32(1 / 13)
    s = s * q + float32(1 / 11)
    s = s * q + float32(1 / 9)
    s = s * q + float32(1 / 7)
    s = s * q + float32(1 / 5)
    s = s * q + float32(1 / 3)
    return _at_least(x, zero) + (s * q * z + z) * float32(2)
