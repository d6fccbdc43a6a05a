"""Open-addressing hash tables of int64 keys: arrays that compiled code and numpy both read."""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import IntArray, compiled

EMPTY: Final = np.int64(-1)
LEAST: Final = 1024  # places of a new table; a power of two, so that a mask finds the place


@compiled
def locate(keys: IntArray, key: int) -> int:
    """Place of `key`, or the empty place where it belongs. At least one place must be empty."""
    h = np.uint64(key)
    # mixing steps of the splitmix64 generator: every bit of the key moves the place
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mask = len(keys) - 1
    place = np.int64((h ^ (h >> np.uint64(31))) & np.uint64(mask))
    while keys[place] != EMPTY and keys[place] != key:
        place = (place + 1) & mask
    return int(place)


@compiled
def places_of(keys: IntArray, wanted: IntArray) -> IntArray:
    """`locate` of many keys, (n,)."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        out[i] = locate(keys, wanted[i])
    return out


@compiled
def slots_of(keys: IntArray, slots: IntArray, wanted: IntArray, used: int) -> IntArray:
    """Slot of each key, (n,); an unknown key gets the next one from `used` on. Room for all of them must be there."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        place = locate(keys, wanted[i])
        if keys[place] == EMPTY:
            keys[place] = wanted[i]
            slots[place] = used
            used += 1
        out[i] = slots[place]
    return out


def grown(keys: IntArray, places: int) -> tuple[IntArray, IntArray, IntArray]:
    """A table of `places`: its keys, and where each old place (second) went to (third)."""
    larger = np.full(places, EMPTY)
    old = np.flatnonzero(keys != EMPTY)
    new = _move(keys, old, larger)
    return larger, old, new


@compiled
def _move(keys: IntArray, old: IntArray, larger: IntArray) -> IntArray:
    new = np.empty(len(old), np.int64)
    for i in range(len(old)):
        new[i] = locate(larger, keys[old[i]])
        larger[new[i]] = keys[old[i]]
    return new


def room(entries: int) -> int:
    """Places for so many entries at half load: one or two probes."""
    return max(LEAST, 1 << (2 * entries - 1).bit_length())
