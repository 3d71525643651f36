"""Tiles of a matrix product in the processor's matrix unit (Intel AMX), in place of vector registers.

A tile register holds 16 rows of 64 bytes, and one instruction multiplies two of them: 16 rows of 16 pairs of bfloat16
with 16 pairs of 16 columns, summed in float32 like `gemm_tile`'s pairs, in the order of the pairs.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils

from gridreg.ops.cpu.jit.table import intrinsic

EDGE = 16
"""Rows of a tile register, and its words of 32 bits in a row."""

_BYTE, _WORD, _INDEX = ir.IntType(8), ir.IntType(32), ir.IntType(64)
_POINTER = _BYTE.as_pointer()
# Sums stand in the first registers. Behind them: left and right, then the same for a last step of half the pairs.
_LEFT, _RIGHT, _LEFT_HALF, _RIGHT_HALF = 4, 5, 6, 7
_FULL_ROW, _HALF_ROW = 64, 32


@functools.cache
def allowed() -> bool:
    """Whether the system lets this process use the tile registers, which Linux wants to be asked for once."""
    if not sys.platform.startswith("linux") or sys.maxsize < 2**32:
        return False
    request, permit, tile_data = 158, 0x1023, 18  # arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return bool(ctypes.CDLL(None).syscall(request, permit, tile_data) == 0)


def _call(builder: Any, name: str, *arguments: Any) -> None:
    kind = ir.FunctionType(ir.VoidType(), [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.{name}")  # type: ignore[no-untyped-call]
    builder.call(function, arguments)


def loop(
    builder: Any, before: Sequence[Any], count: Any, step: Callable[[Any, Sequence[Any]], Sequence[Any]]
) -> list[Any]:
    """A loop over sums; the builder stands behind it then.

    Args:
        builder: where it begins.
        before: the sums at first.
        count: of turns, int64.
        step: the number of a turn and the sums before it to the sums after it.
    """
    entry = builder.block
    head, body, end = (builder.append_basic_block(name) for name in ("turns", "turn", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    number = builder.phi(_INDEX)
    number.add_incoming(_INDEX(0), entry)
    sums = []
    for value in before:
        sums.append(builder.phi(value.type))
        sums[-1].add_incoming(value, entry)
    builder.cbranch(builder.icmp_signed("<", number, count), body, end)
    builder.position_at_end(body)
    after = step(number, sums)
    number.add_incoming(builder.add(number, _INDEX(1)), body)
    for total, value in zip(sums, after, strict=True):
        total.add_incoming(value, body)
    builder.branch(head)
    builder.position_at_end(end)
    return sums


@intrinsic
def configure_tiles(context: Any) -> Any:
    """``configure_tiles()``: shapes of this thread's tile registers, before any product."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        widths = [_FULL_ROW] * 6 + [_HALF_ROW, _FULL_ROW]
        rows = [EDGE] * 7 + [EDGE // 2]
        wide = b"".join(width.to_bytes(2, "little") for width in widths)
        palette = b"\1" + bytes(15) + wide + bytes(16) + bytes(rows) + bytes(8)
        data = cgutils.global_constant(builder, "tiles", cgutils.make_bytearray(palette))  # type: ignore[no-untyped-call]
        _call(builder, "ldtilecfg", builder.bitcast(data, _POINTER))
        return context.get_dummy_value()

    return types.void(), generate


def sum_tiles(builder: Any, at: Any, left: Any, right: Any, vectors: int, out: Any) -> Iterator[Any]:
    """Write instructions that sum up 16 rows of 16 columns for each of up to four ``vectors``.

    Args:
        at: `gridreg.ops.cpu.mlp.gemm_tile.TileArguments`; steps are a multiple of 8. Sixteen steps of a row lie side
            by side, the next sixteen ``16 left_step`` words further on.
        left, right: pointers to words.
        out: pointer to float32 that sums are added to, or None.

    Yields:
        The sums, row by row; nothing if they were added to ``out``.
    """
    start, down, tiles = at.out_start, builder.mul(at.out_row, _INDEX(4)), out
    if out is None:
        with builder.goto_entry_block():
            tiles = builder.alloca(ir.ArrayType(ir.FloatType(), EDGE * EDGE * vectors))
        tiles, start = builder.bitcast(tiles, ir.FloatType().as_pointer()), _INDEX(0)
        down = _INDEX(4 * EDGE * vectors)

    def bytes_at(pointer: Any, *terms: Any) -> Any:
        return builder.bitcast(builder.gep(pointer, [functools.reduce(builder.add, terms)]), _POINTER)

    places = [bytes_at(tiles, start, _INDEX(EDGE * v)) for v in range(vectors)]
    for v, place in enumerate(places):
        if out is None:
            _call(builder, "tilezero", _BYTE(v))
        else:
            _call(builder, "tileloadd64", _BYTE(v), place, down)

    def step(first: Any, of_left: int, of_right: int) -> list[Any]:
        """Add the products of the steps from ``first`` on."""
        place = bytes_at(left, at.left_start, builder.mul(first, at.left_step))
        _call(builder, "tileloadd64", _BYTE(of_left), place, builder.mul(at.left_row, _INDEX(4)))
        for v in range(vectors):
            panel = builder.mul(at.right_panel, _INDEX(v))
            place = bytes_at(right, at.right_start, builder.mul(first, at.right_step), panel)
            _call(builder, "tileloadd64", _BYTE(of_right), place, builder.mul(at.right_step, _INDEX(4)))
            _call(builder, "tdpbf16ps", _BYTE(v), _BYTE(of_left), _BYTE(of_right))
        return []

    whole = builder.ashr(at.steps, _INDEX(4))
    loop(builder, [], whole, lambda turn, _: step(builder.mul(turn, _INDEX(EDGE)), _LEFT, _RIGHT))
    first, half = builder.mul(whole, _INDEX(EDGE)), builder.and_(builder.ashr(at.steps, _INDEX(3)), _INDEX(1))
    loop(builder, [], half, lambda _, __: step(first, _LEFT_HALF, _RIGHT_HALF))
    for v, place in enumerate(places):
        _call(builder, "tilestored64", _BYTE(v), place, down)
    if out is None:
        for i in range(EDGE * vectors):
            place = builder.gep(tiles, [_INDEX(EDGE * i)])
            yield builder.load(
                builder.bitcast(place, ir.VectorType(ir.FloatType(), EDGE).as_pointer()), align=4
            )


@intrinsic
def transpose_words(context: Any, array: Any, index: Any) -> Any:
    """``transpose_words(x, i)``: transpose, in place, the 16 x 16 words from ``i`` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        vector, mask = ir.VectorType(_WORD, EDGE), ir.VectorType(_WORD, EDGE)
        places = [
            builder.bitcast(
                builder.gep(data, [builder.add(arguments[1], _INDEX(EDGE * r))]), vector.as_pointer()
            )
            for r in range(EDGE)
        ]
        rows = [builder.load(place, align=4) for place in places]
        for apart in (1, 2, 4, 8):
            for i in (i for i in range(EDGE) if not i & apart):
                pair = rows[i], rows[i + apart]
                # Of blocks ``apart`` wide, what lies off the diagonal changes places.
                for k, to in enumerate((i, i + apart)):
                    lanes = [
                        EDGE * bool(c & apart) + (c if bool(c & apart) == k else c ^ apart)
                        for c in range(EDGE)
                    ]
                    rows[to] = builder.shuffle_vector(*pair, ir.Constant(mask, lanes))
        for row, place in zip(rows, places, strict=True):
            builder.store(row, place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
