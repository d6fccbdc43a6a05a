"""Stateless random numbers: each number is a hash of (key, counter).

With a stateful generator, a vehicle's noise would depend on the number of vehicles and on the
division of a drive into blocks (samples of a short time). With a counter-based generator (Salmon et
al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) the noise depends on neither: sample k
of channel c of a vehicle is the same number in any order of requests. The hash is the finaliser of
SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).

Counters must be non-negative.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from schemas.errors import InputError
from schemas.runtime.jit import compiled

STEP: Final = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio, odd
MULTIPLY_1: Final = np.uint64(0xBF58476D1CE4E5B9)
MULTIPLY_2: Final = np.uint64(0x94D049BB133111EB)
SHIFTS: Final = (np.uint64(30), np.uint64(27), np.uint64(31))
DROP: Final = np.uint64(11)  # 64 - 53: a float64 has a significand of 53 bits
UNIT: Final = 2.0**-53
TWO: Final = np.uint64(2)
ONE: Final = np.uint64(1)


def checked_seed(seed: int) -> int:
    """Return the seed unchanged if it is valid.

    Raises:
        InputError: the seed is negative.
    """
    if seed < 0:
        raise InputError("seed", f"{seed} is negative", "give a whole number of at least 0")
    return seed


def key_of(*seeds: int) -> np.uint64:
    """Return a key computed from non-negative integers, e.g. (seed, vehicle number). Different
    integers give unrelated streams.
    """
    return np.uint64(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0])


@compiled
def mix_bits(key: np.uint64, counter: np.uint64) -> np.uint64:
    """Return 64 random bits, a hash of `counter` in the random stream `key`."""
    z = key + (counter + ONE) * STEP
    z = (z ^ (z >> SHIFTS[0])) * MULTIPLY_1
    z = (z ^ (z >> SHIFTS[1])) * MULTIPLY_2
    return z ^ (z >> SHIFTS[2])


@compiled
def uniform(key: np.uint64, counter: int) -> float:
    """Return a uniform random number strictly between 0 and 1, for `counter` in the
    stream `key`.
    """
    return (float(mix_bits(key, np.uint64(counter)) >> DROP) + 0.5) * UNIT


@compiled
def normal(key: np.uint64, counter: int) -> float:
    """Return a standard normal random number for `counter` in the stream `key` (Box and Muller,
    1958).

    The number is computed from the two hashes with the counters 2·counter and 2·counter + 1.
    """
    first = TWO * np.uint64(counter)
    u = (float(mix_bits(key, first) >> DROP) + 0.5) * UNIT
    angle = 2.0 * math.pi * float(mix_bits(key, first + ONE) >> DROP) * UNIT
    return math.sqrt(-2.0 * math.log(u)) * math.cos(angle)
