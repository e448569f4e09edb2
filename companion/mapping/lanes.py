"""Sixteen steps of a straight line through a grid at once, in 32 bits.

Written in LLVM's terms, because Numba's compiler finds no vectors of 32-bit fixed point in a
loop of sixteen. LLVM makes the best of them on every machine (one register with AVX-512).
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
FRACTION = 20  # bits after the point, so 12 before it: grids of up to 4096 voxels
_DOUBT = (1 << FRACTION) - LANES  # these bits all set: LANES units more carry over into the whole part
_INSIDE = 3  # bits of a voxel's place in its block; what stands above them is the block's
_CELLS = 9  # bits of an index inside a block
_NARROW = 0x7FFF  # LLVM multiplies what it knows to fit 16 bits in one step instead of two
_unpack: Any = cgutils.unpack_tuple
_I32 = ir.IntType(32)
_LANES = ir.VectorType(_I32, LANES)


def _write_indices(typing: Any, row: Any, first: Any, now: Any, u: Any, v: Any, along: Any, place: Any) -> Any:
    """write_indices(row, first, now, u, v, along, place) -> bits of the lanes that may be wrong, which is rare.

    row[first + j] becomes the index of the voxel j planes on: along[place + j], which is the share of the axis
    whose planes are counted, plus those of u and v. `now` are the places along these, fixed point cut off
    below, and each is (step, bit of a voxel inside a block, blocks from one to the next along it), uint32; v's
    blocks fit 15 bits. Cutting off puts lane j at most j + 1 units too low: it may be wrong if LANES units
    more give another voxel.
    """
    return types.uint64(row, first, now, u, v, along, place), _emit


write_indices: Any = intrinsic(_write_indices)


def _emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    row, first, now, u, v, along, place = args
    table = context.make_array(signature.args[5])(context, builder, along).data
    inside = builder.load(_at(builder, table, place), align=4)
    blocks, doubt = None, None
    for start, axis in zip(_unpack(builder, now, 2), (u, v), strict=True):
        step, bit, apart = (_splat(builder, a) for a in _unpack(builder, axis, 3))
        lane = ir.Constant(_LANES, list(range(LANES)))
        x = builder.add(_splat(builder, start), builder.mul(lane, step))
        unsure = builder.icmp_unsigned("==", builder.and_(x, _all(_DOUBT)), _all(_DOUBT))
        cell = builder.lshr(x, builder.and_(builder.sub(_all(FRACTION), bit), _all(31)))
        inside = builder.add(inside, builder.and_(cell, builder.shl(_all((1 << _INSIDE) - 1), bit)))
        apart = builder.and_(apart, _all(_NARROW)) if axis is v else apart
        away = builder.mul(builder.lshr(x, _all(FRACTION + _INSIDE)), apart)
        blocks, doubt = (away, unsure) if blocks is None else (builder.add(blocks, away), builder.or_(doubt, unsure))
    total = builder.add(inside, builder.shl(blocks, _all(_CELLS)))
    data = context.make_array(signature.args[0])(context, builder, row).data
    builder.store(total, _at(builder, data, first), align=4)
    return builder.zext(builder.bitcast(doubt, ir.IntType(LANES)), ir.IntType(64))


def _at(builder: Any, data: Any, place: Any) -> Any:
    return builder.bitcast(builder.gep(data, [place]), _LANES.as_pointer())


def _all(value: int) -> Any:
    return ir.Constant(_LANES, [value] * LANES)


def _splat(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), value, _I32(0))
    return builder.shuffle_vector(one, one, ir.Constant(_LANES, None))
