"""Array types and the one way of compiling a kernel, shared by the packages."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeAlias, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Float32Array: TypeAlias = NDArray[np.float32]
IntArray: TypeAlias = NDArray[np.int64]
ByteArray: TypeAlias = NDArray[np.uint8]
BoolArray: TypeAlias = NDArray[np.bool_]

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` with numba: cached on disk, no fast-math, IEEE division (x/0 is inf, not an exception).

    Without fast-math and threads the result of a row does not depend on how many rows there are,
    which is what makes a bank of N = 1 and of N = thousands bit-equal.
    """
    return cast(Callable[P, R], numba.njit(cache=True, error_model="numpy")(function))
