"""Elementary functions of the vectors of `gridreg.ops.cpu.jit.simd`, and of single float32, for kernels.

All but `softplus` are rounded as written: they are LLVM instructions without leave to reorder.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types

from gridreg.ops.cpu.jit.compiler import inline
from gridreg.ops.cpu.jit.table import float32, intrinsic

# No moment of an optimizer matters below, and subnormal numbers are slow on some processors.
TINY = 1e-30
# Half of pi in three parts, each a float32; what is multiplied and added at once is not rounded between.
_QUARTER_TURN = (1.5707963705062866, -4.371138828673793e-08, -1.7151245100058819e-15)
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_INT32 = ir.IntType(32)


def _shaped(kind: Any, value: Any) -> Any:
    """The type ``kind`` with as many lanes as ``value``."""
    return ir.VectorType(kind, value.type.count) if isinstance(value.type, ir.VectorType) else kind


def _constant(value: Any, number: float, kind: Any = None) -> Any:
    """``number`` in every lane of ``value``, of its own type or of ``kind``."""
    shaped = _shaped(kind, value) if kind is not None else value.type
    return ir.Constant(shaped, [number] * shaped.count if isinstance(shaped, ir.VectorType) else number)


def _call(builder: Any, name: str, *values: Any, result: Any = None) -> Any:
    """The LLVM intrinsic ``llvm.<name>`` for the type of the values, which need not be that of the result."""
    kind = values[0].type
    lanes = f"v{kind.count}" if isinstance(kind, ir.VectorType) else ""
    function = f"llvm.{name}.{lanes}f32" if result is None else f"llvm.{name}.{lanes}i32.{lanes}f32"
    known = builder.module.globals.get(function)
    if known is None:
        signature = ir.FunctionType(kind if result is None else result, [kind] * len(values))
        known = ir.Function(builder.module, signature, function)
    return builder.call(known, values)


def _elementwise(write: Callable[..., Any]) -> Any:
    """Make an intrinsic of a function that writes instructions for one or two values of a type."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return write(builder, *arguments)

    def unary(context: Any, value: Any) -> Any:
        return value(value), generate

    def binary(context: Any, left: Any, right: Any) -> Any:
        return left(left, left), generate

    typed = unary if write.__code__.co_argcount == 2 else binary
    typed.__name__, typed.__doc__ = write.__name__, write.__doc__
    return intrinsic(typed)


@_elementwise
def divide(builder: Any, a: Any, b: Any) -> Any:
    """``divide(a, b)``: ``a / b``, correctly rounded."""
    return builder.fdiv(a, b)


@_elementwise
def square_root(builder: Any, x: Any) -> Any:
    """``square_root(x)``, correctly rounded."""
    return _call(builder, "sqrt", x)


@_elementwise
def magnitude(builder: Any, x: Any) -> Any:
    """``magnitude(x)``: ``|x|``."""
    return _call(builder, "fabs", x)


@_elementwise
def sign(builder: Any, x: Any) -> Any:
    """``sign(x)``: -1, 0 or 1; 0 for not-a-number."""
    zero, one, minus = (_constant(x, number) for number in (0.0, 1.0, -1.0))
    positive = builder.select(builder.fcmp_ordered(">", x, zero), one, zero)
    return builder.select(builder.fcmp_ordered("<", x, zero), minus, positive)


@_elementwise
def flush(builder: Any, x: Any) -> Any:
    """``flush(x)``: 0 where ``|x| <= TINY``, and ``x`` elsewhere, not-a-number included."""
    small = builder.fcmp_ordered("<=", _call(builder, "fabs", x), _constant(x, TINY))
    return builder.select(small, _constant(x, 0.0), x)


@_elementwise
def _at_least(builder: Any, x: Any, bound: Any) -> Any:
    """``_at_least(x, bound)``: the larger one, ``x`` if it is not a number."""
    return builder.select(builder.fcmp_ordered("<", x, bound), bound, x)


@_elementwise
def _rounded(builder: Any, x: Any) -> Any:
    """``_rounded(x)``: the nearest integer, -126 if it is less or not a number."""
    least = _constant(x, -126.0)
    return builder.select(builder.fcmp_ordered(">", x, least), _call(builder, "rint", x), least)


@_elementwise
def _power_of_two(builder: Any, x: Any) -> Any:
    """``_power_of_two(n)``: 2^n, for integral n in [-126, 127]."""
    biased = builder.add(builder.fptosi(x, _shaped(_INT32, x)), _constant(x, 127, _INT32))
    return builder.bitcast(builder.shl(biased, _constant(x, 23, _INT32)), x.type)


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


@intrinsic
def sine_and_cosine(context: Any, value: Any) -> Any:
    """``sine_and_cosine(x)``: both of each lane, to 2e-7 for sizes up to a million; not-a-number for what has none.

    The nearest multiple of a quarter turn is taken away in three parts (Cody and Waite 1980), and what is left goes
    into the polynomials of Cephes' sinf and cosf.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments

        def real(number: float) -> Any:
            return _constant(x, number)

        def bit(number: Any, which: int) -> Any:
            kept = builder.and_(number, _constant(x, which, _INT32))
            return builder.icmp_signed("!=", kept, _constant(x, 0, _INT32))

        turns = _call(builder, "rint", builder.fmul(x, real(0.6366197724)))
        rest = x
        for part in _QUARTER_TURN:
            rest = _call(builder, "fma", turns, real(-part), rest)
        square = builder.fmul(rest, rest)
        sine, cosine = real(_SINE[0]), real(_COSINE[0])
        for s, c in zip(_SINE[1:], _COSINE[1:], strict=True):
            sine = _call(builder, "fma", sine, square, real(s))
            cosine = _call(builder, "fma", cosine, square, real(c))
        sine = _call(builder, "fma", builder.fmul(sine, square), rest, rest)
        falling = _call(builder, "fma", square, real(-0.5), real(1.0))
        cosine = _call(builder, "fma", builder.fmul(cosine, square), square, falling)
        quarter = _call(builder, "fptosi.sat", turns, result=_shaped(_INT32, x))
        odd = bit(quarter, 1)
        sine, cosine = builder.select(odd, cosine, sine), builder.select(odd, sine, cosine)
        sine = builder.select(bit(quarter, 2), builder.fneg(sine), sine)
        next_quarter = builder.add(quarter, _constant(x, 1, _INT32))
        cosine = builder.select(bit(next_quarter, 2), builder.fneg(cosine), cosine)
        return context.make_tuple(builder, signature.return_type, [sine, cosine])

    return types.UniTuple(value, 2)(value), generate  # type: ignore[no-untyped-call]
