"""Prefetch of array elements into the processor's caches, for compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from schemas.runtime.jit import LINE


# Numba provides no types.
def _prefetch(context: Any, array: Any, row: Any, line: Any) -> Any:  # noqa: ANN401, ARG001
    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ANN401
        kind = signature.args[0]
        long = ir.IntType(64)
        whole = ir.IntType(32)
        data = target.make_array(kind)(target, builder, values[0])
        place = [values[1], *[long(0)] * (kind.ndim - 1)]
        pointer = cgutils.get_item_pointer(  # type: ignore[no-untyped-call]
            target, builder, kind, data, place
        )
        begin = builder.ptrtoint(pointer, long)
        address = builder.inttoptr(
            builder.add(begin, builder.mul(values[2], long(LINE))), cgutils.voidptr_t
        )
        hint = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, whole, whole, whole])
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, hint, "llvm.prefetch.p0"
        )
        # Arguments of llvm.prefetch: 0 for reading, 3 for all cache levels, 1 for the data cache.
        builder.call(function, [address, whole(0), whole(3), whole(1)])
        return target.get_dummy_value()

    return types.void(array, types.int64, types.int64), generate


# `prefetch(array, row, line)`, for compiled code: start to load cache line `line` of `array[row]`,
# for an array of one or two dimensions. It is only a hint, so `row` may lie outside the array.
prefetch = cast(Callable[[NDArray[Any], Any, int], None], intrinsic(_prefetch))
