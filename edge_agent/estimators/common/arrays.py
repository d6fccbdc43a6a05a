"""Plain loops that copy and clear small arrays: each slice assignment would cost seconds of
compilation.
"""

from __future__ import annotations

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def copy_vector(target: FloatArray, source: FloatArray) -> None:
    """Copy: target (n,) = source (n,)."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@compiled
def put_square(target: FloatArray, source: FloatArray) -> None:
    """Copy: target (n, n) = source (n, n)."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@compiled
def clear_vector(target: FloatArray) -> None:
    """Clear: target (n,) = 0."""
    for i in range(target.shape[0]):
        target[i] = 0.0


@compiled
def clear_rows(target: FloatArray) -> None:
    """Clear: target (m, n) = 0."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = 0.0
