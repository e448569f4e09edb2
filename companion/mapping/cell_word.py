"""One update of 64 cells at once, where the bits of a word choose the cells.

Numba has no words for vectors of cells whose mask is an integer; LLVM has, and makes the best of
them on every machine (with AVX-512 a dozen instructions). So this one function is written in LLVM's terms.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from companion.mapping.sensor_model import UNKNOWN

CELLS_PER_WORD = 64
_unpack: Any = cgutils.unpack_tuple
_insert_function: Any = cgutils.get_or_insert_function
_CELLS = ir.VectorType(ir.IntType(8), CELLS_PER_WORD)
_FLAGS = ir.VectorType(ir.IntType(1), CELLS_PER_WORD)
_WORD = ir.IntType(64)


def _update_word(typing: Any, cells: Any, first: Any, bits: Any, amounts: Any) -> Any:
    """update_word(cells, first, (missed, hit), (hit step, miss step, lowest, highest)) -> (changed, settled).

    `cells` int8 (contiguous); cell `first + i` belongs to bit i of the uint64 words. A cell with a hit
    bit gets a hit, with a missed bit alone a miss, clamped; unknown counts as 0. Bits of the results:
    cells that changed between unknown, free and occupied; cells at `lowest`. Steps are int8.
    """
    returned = types.UniTuple(types.uint64, 2)  # type: ignore[no-untyped-call]
    return returned(cells, first, bits, amounts), _emit


update_word: Any = intrinsic(_update_word)


def _emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    cells, first, bits, amounts = args
    data = context.make_array(signature.args[0])(context, builder, cells).data
    place = builder.bitcast(builder.gep(data, [first]), _CELLS.as_pointer())
    hit_step, miss_step, lowest, highest = (_splat(builder, a) for a in _unpack(builder, amounts, 4))
    missed, hit = (builder.bitcast(b, _FLAGS) for b in _unpack(builder, bits, 2))
    unknown, zero = _splat(builder, ir.IntType(8)(UNKNOWN)), ir.Constant(_CELLS, None)
    old = builder.load(place, align=1)
    was_unknown = builder.icmp_signed("==", old, unknown)
    level = _add(builder, builder.select(was_unknown, zero, old), builder.select(hit, hit_step, miss_step))
    level = builder.select(builder.icmp_signed("<", level, lowest), lowest, level)
    level = builder.select(builder.icmp_signed(">", level, highest), highest, level)
    new = builder.select(builder.or_(missed, hit), level, old)
    builder.store(new, place, align=1)
    crossed = builder.icmp_signed("<", builder.xor(old, new), zero)  # its sign: occupied <-> free or unknown
    found = builder.and_(was_unknown, builder.icmp_signed("!=", new, unknown))
    results = (builder.or_(crossed, found), builder.icmp_signed("==", new, lowest))
    return context.make_tuple(builder, signature.return_type, [builder.bitcast(r, _WORD) for r in results])


def _add(builder: Any, a: Any, b: Any) -> Any:
    """Stops at the ends of int8: the clamps lie inside, so the clamped sum is exact."""
    kind = ir.FunctionType(_CELLS, (_CELLS, _CELLS))
    add = _insert_function(builder.module, kind, f"llvm.sadd.sat.v{CELLS_PER_WORD}i8")
    return builder.call(add, (a, b))


def _splat(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_CELLS, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), CELLS_PER_WORD), None))
