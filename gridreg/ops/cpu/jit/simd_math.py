"""Elementary functions of the vectors of `gridreg.ops.cpu.jit.simd`, and of single float32, for kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.extending import intrinsic

__all__ = ["TINY", "divide", "flush", "gate", "magnitude", "sign", "square_root"]

# No moment of an optimizer matters below, and subnormal numbers are slow on some processors.
TINY = 1e-30


def _intrinsic(typed: Callable[..., Any]) -> Any:
    return intrinsic(typed)


def _constant(kind: Any, value: float) -> Any:
    return ir.Constant(kind, [value] * kind.count if isinstance(kind, ir.VectorType) else value)


def _call(builder: Any, name: str, value: Any) -> Any:
    """The LLVM intrinsic ``llvm.<name>`` for the type of ``value``."""
    vector = isinstance(value.type, ir.VectorType)
    suffix = f"v{value.type.count}f32" if vector else "f32"
    function = f"llvm.{name}.{suffix}"
    known = builder.module.globals.get(function)
    if known is None:
        known = ir.Function(builder.module, ir.FunctionType(value.type, [value.type]), function)
    return builder.call(known, [value])


@_intrinsic
def divide(context: Any, left: Any, right: Any) -> Any:
    """``divide(a, b)``: ``a / b``, correctly rounded."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fdiv(*arguments)

    return left(left, left), generate


@_intrinsic
def square_root(context: Any, value: Any) -> Any:
    """``square_root(x)``, correctly rounded."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "sqrt", arguments[0])

    return value(value), generate


@_intrinsic
def magnitude(context: Any, value: Any) -> Any:
    """``magnitude(x)``: ``|x|``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "fabs", arguments[0])

    return value(value), generate


@_intrinsic
def sign(context: Any, value: Any) -> Any:
    """``sign(x)``: -1, 0 or 1; 0 for not-a-number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments
        zero, one, minus = (_constant(x.type, number) for number in (0.0, 1.0, -1.0))
        positive = builder.select(builder.fcmp_ordered(">", x, zero), one, zero)
        return builder.select(builder.fcmp_ordered("<", x, zero), minus, positive)

    return value(value), generate


@_intrinsic
def flush(context: Any, value: Any) -> Any:
    """``flush(x)``: 0 where ``|x| <= TINY``, and ``x`` elsewhere, not-a-number included."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (x,) = arguments
        small = builder.fcmp_ordered("<=", _call(builder, "fabs", x), _constant(x.type, TINY))
        return builder.select(small, _constant(x.type, 0.0), x)

    return value(value), generate


@_intrinsic
def gate(context: Any, slope: Any, value: Any) -> Any:
    """``gate(slope, value)``: ``slope`` where ``value`` is positive, else 0: the gradient of a ReLU."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        zero = _constant(arguments[1].type, 0.0)
        return builder.select(builder.fcmp_ordered(">", arguments[1], zero), arguments[0], zero)

    return slope(slope, value), generate
