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
_unpack: Any = cgutils.unpack_tuple
_I32 = ir.IntType(32)
_LANES = ir.VectorType(_I32, LANES)


def _write_indices(typing: Any, row: Any, first: Any, now: Any, u: Any, v: Any, w: Any) -> Any:
    """write_indices(row, first, now, u, v, w) -> bits of the lanes that may be wrong, which is rare.

    `now` are the places along three axes, each axis is (step, stride, block stride), uint32; u and v are
    fixed point cut off below, w is whole. row[first + j] becomes the sum over the axes of
    x * stride + (x >> 3) * block stride, with x = now + j * step. Cutting off puts lane j at most j + 1
    units too low: it may be wrong if LANES units more give another voxel.
    """
    return types.uint64(row, first, now, u, v, w), _emit


write_indices: Any = intrinsic(_write_indices)


def _emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    row, first, now, *axes = args
    data = context.make_array(signature.args[0])(context, builder, row).data
    total, doubt = ir.Constant(_LANES, None), None
    starts = _unpack(builder, now, 3)
    for start, axis, fixed in zip(starts, axes, (True, True, False), strict=True):
        step, stride, block_stride = (_splat(builder, a) for a in _unpack(builder, axis, 3))
        lane = ir.Constant(_LANES, list(range(LANES)))
        x = builder.add(_splat(builder, start), builder.mul(lane, step))
        if fixed:
            x, more = (builder.lshr(at, _all(FRACTION)) for at in (x, builder.add(x, _all(LANES))))
            differs = builder.icmp_unsigned("!=", x, more)
            doubt = differs if doubt is None else builder.or_(doubt, differs)
        blocks = builder.mul(builder.lshr(x, _all(3)), block_stride)
        total = builder.add(total, builder.add(builder.mul(x, stride), blocks))
    builder.store(total, builder.bitcast(builder.gep(data, [first]), _LANES.as_pointer()), align=4)
    return builder.zext(builder.bitcast(doubt, ir.IntType(LANES)), ir.IntType(64))


def _all(value: int) -> Any:
    return ir.Constant(_LANES, [value] * LANES)


def _splat(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), value, _I32(0))
    return builder.shuffle_vector(one, one, ir.Constant(_LANES, None))
