"""Vectors of numbers in one processor register ("lanes") for compiled functions.

A filter bank runs the same arithmetic for many hypotheses. With a vector of LANES numbers, one per
hypothesis, one machine instruction serves all of them. In compiled code such a vector comes from
`lanes_at` and behaves like a float. Operators, `abs`, `min`, `max` and `math.sqrt` work on each
lane separately, and a float is copied into all lanes. Therefore the same source code works for
single numbers and for vectors. A comparison gives a mask; `select` replaces a branch.

Multiplication and addition of vectors are fused where the processor can do so. No other part of
fast-math is allowed: NaN and infinity keep their meaning, and sums keep their order
(`deploy/docs/decisions/0011-no-fast-math.md`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, TypeAlias, cast

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined, load_intrinsic

Function: TypeAlias = Callable[[float], float]


def intrinsic_of(name: str) -> object:
    """Return the Numba intrinsic (function whose LLVM code this project generates itself) that
    `lane_types` defines under `name`.
    """
    return load_intrinsic("schemas.runtime.lane_types", name)


# lanes_at(array, place): load a vector from `array` (..., LANES). `place` has one index for each
# axis before the lanes. For a flat array it is the number of the vector.
lanes_at = cast(Callable[[FloatArray, Any], float], intrinsic_of("type_load"))
# put_lanes(array, place, value): store a vector; a single number is stored in every lane.
put_lanes = cast(Callable[[FloatArray, Any, float], None], intrinsic_of("type_store"))
# select(where, first, other): `first` where the mask is true, else `other`. Both are computed.
select = cast(Callable[[bool, float, float], float], intrinsic_of("type_select"))
any_lane = cast(Callable[[bool], bool], intrinsic_of("type_any"))
sum_lanes = cast(Function, intrinsic_of("type_sum"))
largest_lane = cast(Function, intrinsic_of("type_largest"))
# gather_pair(table, cell): the elements of a table at integer indices, and the elements after them.
# All must lie inside the table.
gather_pair = cast(
    Callable[[FloatArray, float], tuple[float, float]], intrinsic_of("type_gather_pair")
)
floor = cast(Function, intrinsic_of("type_floor"))
# power_of_two(k): 2^k for an integer k. exponent_of(x): the integer k with 2^k <= x < 2^(k+1), for
# x > 0.
power_of_two = cast(Function, intrinsic_of("type_power_of_two"))
exponent_of = cast(Function, intrinsic_of("type_exponent"))
# Approximations of 1/x and 1/sqrt(x) for positive x. Their errors are below 13 % and 3.5 %.
guess_inverse = cast(Function, intrinsic_of("type_guess"))
guess_inverse_root = cast(Function, intrinsic_of("type_root_guess"))

LOG2_E: Final = 1.4426950408889634
# ln 2 as the sum of two numbers. The first has trailing zero bits, so that its products with
# integers are exact.
LN_2_HIGH: Final = 6.93147180369123816490e-01
LN_2_LOW: Final = 1.90821492927058770002e-10
MOST_EXPONENT: Final = 700.0  # largest |x| of exp(x): beyond it 2^k overflows or underflows
ROOT_2: Final = math.sqrt(2.0)
EXP_TERMS: Final = tuple(1.0 / math.factorial(k) for k in range(13, -1, -1))
LOG_TERMS: Final = tuple(2.0 / k for k in range(21, 0, -2))


@inlined
def inverse_of(x: float) -> float:
    """Return 1/x of a positive normal x with a relative error below 3e-16.

    A division occupies the processor as long as thirty multiply-adds. The third-order Newton method
    used here, y <- y*(1 + e + e^2) with e = 1 - x*y, needs nine multiply-adds in its three steps.
    Each step raises the relative error to the third power.
    """
    y = guess_inverse(x)
    for _ in range(3):
        e = 1.0 - x * y
        y += y * (e + e * e)
    return y


@inlined
def inverse_root_of(x: float) -> float:
    """Return 1/sqrt(x) of a positive normal x with a relative error below 4e-16; for 0 a large
    number, so that x times the result is 0.

    A first guess y is improved in steps of fourth order. Each step multiplies y by the first terms
    of the series of (1 - e)^(-1/2), with e = 1 - x*y^2.
    """
    y = guess_inverse_root(x)
    for _ in range(2):
        e = 1.0 - x * y * y
        y += y * e * (0.5 + e * (0.375 + e * 0.3125))
    return y


@inlined
def exp_lanes(x: float) -> float:
    """Return e^x for -700 <= x <= 700, with a relative error below 3e-16; a larger or smaller x
    counts as the nearest limit.

    e^x is computed as 2^k*e^r with a whole number k and |r| <= ln(2)/2, where e^r is its Taylor
    polynomial.
    """
    x = min(max(x, -MOST_EXPONENT), MOST_EXPONENT)
    k = floor(x * LOG2_E + 0.5)
    r = (x - k * LN_2_HIGH) - k * LN_2_LOW
    return evaluate_polynomial(EXP_TERMS, r) * power_of_two(k)


@inlined
def log_lanes(x: float) -> float:
    """Return ln(x) of a positive x that is not subnormal; the error is below 3e-16 times the larger
    of 1 and the result.

    x is split into 2^k*m with m around 1. ln(m) is 2*artanh(s) with s = (m - 1)/(m + 1), computed
    as a series in s^2.
    """
    k = exponent_of(x)
    m = x * power_of_two(-k)
    large = m > ROOT_2
    m = select(large, 0.5 * m, m)
    k = select(large, k + 1.0, k)
    s = (m - 1.0) / (m + 1.0)
    return k * LN_2_HIGH + (k * LN_2_LOW + s * evaluate_polynomial(LOG_TERMS, s * s))


@inlined
def evaluate_polynomial(terms: tuple[float, ...], x: float) -> float:
    """Return the value at x of a polynomial by Horner's rule. `terms` are its coefficients, that of
    the highest power first.
    """
    total = x * 0.0 + terms[0]
    for term in terms[1:]:
        total = total * x + term
    return total
