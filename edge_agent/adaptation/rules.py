"""Fuzzy inference with two inputs, the mismatch of the innovations and its rate, by a table of
rules (paper 001).

Legend
    alpha       mismatch of the innovation variance: actual over theoretical, minus 1 [1]
    rate        rate of change of alpha [1/s]
    level       output of a rule: ln of the factor on R [nat]                             (5, 7)

Sets are triangles that end at their neighbours' peaks, so memberships sum to one and the inference
is bilinear.

The module departs from the paper in three points. (1) Equation (18) defines alpha as a difference
of traces of covariance matrices. A trace adds squares of different units, so the ratio is used
here. (2) Table 1 has rows NB NM Z PM PB for the rate, and columns NB NM NS Z PS PM PB for alpha.
For negative alpha the printed table increases R, although the text asks for a decrease. There the
reciprocal of the factor is used. (3) The paper uses two output sets, PSM and PMB, without a
definition. Here PSM lies between PS and PM, and PMB between PM and PB.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LEVELS: Final = {"PVS": 0.5, "PS": 0.7, "PSM": 1.0, "PM": 1.5, "PMB": 2.5, "PB": 4.0, "PVB": 8.0}
PRINTED: Final = (
    "PVB PB PMB PSM PVS PS PMB",
    "PB PMB PM PM PS PSM PB",
    "PMB PM PSM PSM PSM PM PMB",
    "PB PSM PS PM PM PMB PB",
    "PMB PS PSM PMB PMB PB PVB",
)
ALPHA: Final = np.array([-0.8, -0.5, -0.2, 0.0, 0.5, 1.5, 4.0])  # [1] peaks of the sets of alpha
RATE: Final = np.array([-8.0, -2.0, 0.0, 2.0, 8.0])  # [1/s] peaks of the sets of its rate


def rule_table(printed: tuple[str, ...] = PRINTED) -> FloatArray:
    """Convert a printed rule table, whose entries are names of output sets, to an array (5, 7) of
    levels (ln of the factor on the measurement noise R) [nat].

    Raises:
        InputError: a name is unknown, the shape is wrong, or the level at zero mismatch and zero
            rate is not 0.
    """
    try:
        levels = np.array([[math.log(LEVELS[name]) for name in row.split()] for row in printed])
    except KeyError as error:
        raise InputError("rules", f"there is no set {error}", f"use {', '.join(LEVELS)}") from error
    if levels.shape != (len(RATE), len(ALPHA)):
        raise InputError("rules", f"a table of {levels.shape}", f"give {(len(RATE), len(ALPHA))}")
    levels[:, ALPHA < 0.0] *= -1.0
    if levels[RATE == 0.0][:, ALPHA == 0.0].any():
        raise InputError(
            "rules", "the rule for zero mismatch changes R", "set the middle entry to PSM"
        )
    return levels


@compiled
def infer_two(
    alpha: float, rate: float, at: FloatArray, of: FloatArray, levels: FloatArray
) -> float:
    """Return ln of the factor on the measurement noise R [nat] by bilinear interpolation in the
    table `levels` (5, 7) of rule outputs. Beyond the outer peaks the result is constant.

    Args:
        alpha: mismatch of the innovations: actual over theoretical variance, minus 1 [1].
        rate: rate of change of alpha [1/s].
        at: (7,) peaks of the fuzzy sets of alpha, the columns of the table.
        of: (5,) peaks of the fuzzy sets of the rate, the rows of the table.
        levels: (5, 7) ln of the factor on R for each pair of sets [nat].
    """
    i, u = bracket_peaks(alpha, at)
    j, v = bracket_peaks(rate, of)
    lower = (1.0 - u) * levels[j, i] + u * levels[j, i + 1]
    upper = (1.0 - u) * levels[j + 1, i] + u * levels[j + 1, i + 1]
    return float((1.0 - v) * lower + v * upper)


@compiled
def bracket_peaks(value: float, peaks: FloatArray) -> tuple[int, float]:
    """Return the interval between two peaks of fuzzy sets that contains a value, as (k, share):
    value = (1 - share)*peaks[k] + share*peaks[k + 1]. Beyond the outer peaks the share is 0 or 1.
    """
    last = peaks.shape[0] - 2
    k = 0
    while k < last and value >= peaks[k + 1]:
        k += 1
    return k, min(max((value - peaks[k]) / (peaks[k + 1] - peaks[k]), 0.0), 1.0)
