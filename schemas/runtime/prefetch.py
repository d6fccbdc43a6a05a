"""Prefetch of array elements into the processor's caches, for compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numpy.typing import NDArray

from schemas.runtime.jit import load_intrinsic

# `prefetch(array, row, line)`, for compiled code: start to load cache line `line` of `array[row]`,
# for an array of one or two dimensions. It is only a hint, so `row` may lie outside the array.
prefetch = cast(
    Callable[[NDArray[Any], Any, int], None],
    load_intrinsic("schemas.runtime.prefetch_code", "type_prefetch"),
)
