"""Grouping of rows by stream (vehicle, start, kind, region) in one pass. It must be fast, because a
restart processes tens of millions of rows. Compiled, pure (no I/O).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import IntArray
from schemas.runtime.jit import refcount_free_locked

Int32Array = NDArray[np.int32]


def group_rows(a: IntArray, b: IntArray, c: IntArray) -> tuple[Int32Array, IntArray]:
    """Group n rows by three numbers a, b, c (n,) each. Return the number of the group of each row,
    (n,), and the index of the first row of each group, (k,). A group is the set of rows with the
    same (a, b, c); groups are numbered in order of first appearance.
    """
    table = np.full(2 * len(a) + 1, -1, np.int32)
    group = np.empty(len(a), np.int32)
    first = np.empty(len(a), np.int64)
    groups = _group_rows(a, b, c, table, group, first)
    return group, first[:groups].copy()


@refcount_free_locked
def _group_rows(
    a: IntArray, b: IntArray, c: IntArray, table: Int32Array, group: Int32Array, first: IntArray
) -> int:
    """Write the group of each row to `group` (n,), and the first row of each group to `first`.
    `table` is an empty hash table of group numbers. Return the number of groups.
    """
    places = len(table)
    k = 0
    for i in range(len(a)):
        mixed = (np.uint64(a[i]) * np.uint64(0x9E3779B97F4A7C15)) ^ (
            np.uint64(b[i]) * np.uint64(0xBF58476D1CE4E5B9)
        )
        mixed = (mixed ^ (mixed >> np.uint64(29)) ^ np.uint64(c[i])) * np.uint64(0x94D049BB133111EB)
        place = np.int64((mixed >> np.uint64(11)) % np.uint64(places))
        while table[place] >= 0:
            at = first[table[place]]
            if a[at] == a[i] and b[at] == b[i] and c[at] == c[i]:
                break
            place = (place + 1) % places
        if table[place] < 0:
            table[place] = k
            first[k] = i
            k += 1
        group[i] = table[place]
    return k


def largest_of(values: IntArray, group: Int32Array, groups: int) -> IntArray:
    """Return the largest of the `values` (n,) in each group of rows, (groups,); every group must
    have a value.
    """
    out = np.full(groups, np.iinfo(np.int64).min, np.int64)
    _raise_to_largest(values, group, out)
    return out


@refcount_free_locked
def _raise_to_largest(values: IntArray, group: Int32Array, out: IntArray) -> None:
    for i in range(len(values)):
        if values[i] > out[group[i]]:
            out[group[i]] = values[i]
