"""Loops that copy and clear vectors in compiled code.

They replace slice assignments, because each slice assignment adds seconds of compile time.
"""

from __future__ import annotations

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def copy_vector(target: FloatArray, source: FloatArray) -> None:
    """Copy the vector `source` (n,) to `target` (n,)."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@compiled
def clear_vector(target: FloatArray) -> None:
    """Set all elements of the vector `target` (n,) to zero."""
    for i in range(target.shape[0]):
        target[i] = 0.0
