"""Unevenness of a road surface, such as cobbles: swing of the wheel loads and rolling radii.

Legend
    z       height [m] of the surface, sum over waves of A cos(k·p + φ)
    A, k, φ amplitude [m], wave vector (east, north) [rad/m] and phase [rad] of a wave
    p       position of a wheel on the ground (east, north) [m]
    n, G    spatial frequency [1/m] and power spectral density of the height [m^3]
    ω       angular frequency [rad/s] at which a moving wheel meets a wave
    H       tyre deflection over height, complex

ISO 8608 classifies roads by their roughness, G at n = 0.1/m, and lets G decrease with n^-2. The
waves have random directions, so that a road is equally uneven in each direction.

Each wheel carries a sprung mass on a spring with damper, and has an unsprung mass on the tyre
(quarter-car model). The deflection of the tyre changes load and rolling radius of the wheel:

    S = (k_s + iωc)·(1 − (k_s + iωc)/(k_s + iωc − ω²))
    H = (S − m_u ω²)/(k_t − m_u ω² + S)

    k_s, c  stiffness [1/s^2] and damping [1/s] of the suspension, over the sprung mass
    k_t     stiffness of the tyre over the sprung mass [1/s^2]
    m_u     unsprung over sprung mass [1]

The response is that at constant speed. The car's body does not move, because its acceleration by
unevenness averages out within the time that the planar model represents.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final, NamedTuple

from edge_agent.lab.simulation.counter_rng import key_of, uniform
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

UNEVENNESS_STREAM: Final = 21
COBBLES: Final = 1e-3  # [m^3] roughness of cobbles, class D of ISO 8608
REFERENCE: Final = 0.1  # [1/m] spatial frequency at which the roughness is stated
# [1/m] spatial frequencies of the longest and shortest wave; a tyre smooths shorter waves
FREQUENCIES: Final = (0.1, 4.0)
WAVES: Final = 16

SPRING: Final = (2.0 * math.pi * 1.2) ** 2  # k_s: the body of a car oscillates at 1.2 Hz
DAMPING: Final = 2.0 * 0.3 * math.sqrt(SPRING)  # c: a damping ratio of .3
TYRE_DEFLECTION: Final = 0.018  # [m] deflection of a tyre under the static load
TYRE: Final = GRAVITY / TYRE_DEFLECTION  # k_t
UNSPRUNG: Final = 0.12  # m_u; wheels then oscillate at 11 Hz
# Share of the tyre's deflection by which the rolling radius decreases.
ROLLING_SHARE: Final = 0.25
LEAST_LOAD: Final = 0.02  # smallest load over the static load; a wheel that lifts off has none


class SurfaceColumn(IntEnum):
    """Index of a column in the table of a surface, which has one row per wave."""

    AMPLITUDE = 0  # [m]
    EAST = 1  # wave vector [rad/m]
    NORTH = 2
    PHASE = 3  # [rad]


class HeightWave(NamedTuple):
    """One wave of a road surface: `amplitude` [m], wave vector (`east`, `north`) [rad/m], and
    `phase` [rad] at the origin.
    """

    amplitude: float
    east: float
    north: float
    phase: float


def uneven_surface(roughness: float, seed: int) -> tuple[HeightWave, ...]:
    """Return the waves of a random road surface with this `roughness` [m^3] (ISO 8608)."""
    key = key_of(seed, UNEVENNESS_STREAM)
    ratio = (FREQUENCIES[1] / FREQUENCIES[0]) ** (1.0 / WAVES)
    waves = []
    for k in range(WAVES):
        low = FREQUENCIES[0] * ratio**k
        middle = low * math.sqrt(ratio)
        density = roughness * (middle / REFERENCE) ** -2.0
        towards = 2.0 * math.pi * uniform(key, 2 * k)
        number = 2.0 * math.pi * middle
        waves.append(
            HeightWave(
                math.sqrt(2.0 * density * low * (ratio - 1.0)),
                number * math.cos(towards),
                number * math.sin(towards),
                2.0 * math.pi * uniform(key, 2 * k + 1),
            )
        )
    return tuple(waves)


@compiled
def load_swing(
    surface: FloatArray, place: tuple[float, float], velocity: tuple[float, float]
) -> float:
    """Return the change of a wheel's load by the unevenness of the road, over its static load [1].

    Args:
        surface: table of the road surface, one row per wave (waves, 4); no row: an even road.
        place: position of the wheel on the ground (east, north) [m].
        velocity: velocity of the wheel (east, north) [m/s].
    """
    swing = 0.0
    for k in range(surface.shape[0]):
        wave = surface[k]
        east = wave[SurfaceColumn.EAST]
        north = wave[SurfaceColumn.NORTH]
        omega = east * velocity[0] + north * velocity[1]
        spring = complex(SPRING, omega * DAMPING)
        body = spring * (1.0 - spring / (spring - omega * omega))
        wheel = body - UNSPRUNG * omega * omega
        deflection = wheel / (TYRE + wheel)
        turn = east * place[0] + north * place[1] + wave[SurfaceColumn.PHASE]
        met = deflection.real * math.cos(turn) - deflection.imag * math.sin(turn)
        swing += wave[SurfaceColumn.AMPLITUDE] * met
    return max(swing / TYRE_DEFLECTION, LEAST_LOAD - 1.0)


@compiled
def radius_change(swing: float) -> float:
    """Return the change of a wheel's rolling radius [m] by the change `swing` of its load over the
    static load [1].
    """
    return -ROLLING_SHARE * TYRE_DEFLECTION * swing
