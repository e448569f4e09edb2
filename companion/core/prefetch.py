"""Memory asked for before it is needed: what a scan meets lies all over the map, and no machine guesses where."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_WRITE, _KEEP, _DATA = 1, 3, 1  # to be written, to be kept in all caches, data
_NUMBER = ir.IntType(32)
_BYTE = ir.IntType(8).as_pointer()


def _prefetch(typing: Any, array: Any, index: Any) -> Any:
    """prefetch(array, index): the cache line of the number `index` of a contiguous array, counted flat."""
    return types.void(array, index), _emit


prefetch: Any = intrinsic(_prefetch)


def _emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    kind = ir.FunctionType(ir.VoidType(), [_BYTE, _NUMBER, _NUMBER, _NUMBER])
    ask = builder.module.declare_intrinsic("llvm.prefetch", [_BYTE], kind)
    place = builder.bitcast(builder.gep(data, [args[1]]), _BYTE)
    builder.call(ask, [place, _NUMBER(_WRITE), _NUMBER(_KEEP), _NUMBER(_DATA)])
    return context.get_dummy_value()
