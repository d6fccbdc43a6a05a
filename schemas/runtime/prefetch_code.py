"""Machine code of `prefetch.prefetch`."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types

from schemas.runtime.jit import LINE


# Numba provides no types.
def type_prefetch(context: Any, array: Any, row: Any, line: Any) -> Any:  # noqa: ANN401, ARG001
    """Return the types and the generator of machine code of `prefetch(array, row, line)`."""

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
