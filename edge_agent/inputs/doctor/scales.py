"""Search for quantities with a wrong unit, sign or clock. The result is the smallest set of faults
that explains all identities. An identity is a pair of expressions that are equal by physics, for
example the measured a_y and the product v·r (speed and yaw rate); see `identities`.

The gain of an identity is the slope of its left side over its right side in the recorded drive
(`Fit.gain`). Without faults, the gain is near the identity's centre. The centre is about 1 and
includes known effects such as body roll. A fault multiplies the recorded value of a quantity by a
factor, for example 57.3 for deg instead of rad. So

    ln |gain| = ln centre + Σ power · ln |factor| + error      over the quantities of the identity
    sign(gain) = Π sign(factor)

where the power is 1 for a quantity on the left side and -1 on the right side.

An explanation is a set of faults. Its cost is the sum of the costs of its faults and of the squared
normalised errors. Each fault costs FAULT_COST, twice its negative log probability, because faulty
columns are rare. Every set of faults is tried, because a table without units often has several
wrong ones. The fault of a quantity is certain if each explanation with another fault of this
quantity costs at least SETTLED more than the best explanation.

Clocks are treated in the same way: the lag of an identity is the difference between the lags of two
devices.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.identities import Fit
from edge_agent.inputs.driving_direction import FASTEST_REVERSE_M_S
from edge_agent.inputs.units import ANGLE, DEG, SPEED
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

FAULT_COST: Final = 12.0  # cost of a fault: it must explain a deviation of 3.5 standard deviations
# Margin from which a late clock is certain. It is small, because a late clock must also exceed
# LATE_S.
CLOCK_SETTLED: Final = 3.0
SETTLED: Final = 9.0  # margin from which a fault is certain: odds of 90 to 1
ALIKE: Final = 0.08  # faults with a smaller difference of ln factor have the same effect
# cost of a wrong sign that no fault explains, times the squared correlation
WRONG_SIGN: Final = 60.0


class Mistake(NamedTuple):
    """A fault of a recorded quantity, such as a wrong unit: the fault's name, and the factor by
    which it multiplies the true value.
    """

    name: str
    factor: float


class Member(NamedTuple):
    """A measured quantity in an identity (two sides that are equal by physics), and its exponent in
    the gain. The gain is the slope of the left side over the right side.

    A fault that multiplies the quantity by a factor f multiplies the gain by f^power. `power` is 1
    for a quantity on the left side and -1 for a quantity on the right side.
    """

    quantity: str
    power: int


class Law(NamedTuple):
    """Properties of an identity (equation between two sides) for cars without faults.

    Attributes:
        centre: expected gain (slope of the left side over the right side).
        spread: standard deviation of ln(gain) between cars.
        members: measured quantities on both sides.
    """

    centre: float
    spread: float
    members: tuple[Member, ...]


# Expected gain of each identity, and the spread of ln gain over cars. Roll of the body makes a_y
# larger (4 to 7 degrees per g), and pitch makes a_x larger. Understeer widens the spread of the
# steering.
LAWS: Final = {
    "lateral": Law(1.03, 0.06, (Member("ay", 1), Member("v", -1), Member("r", -1))),
    "longitudinal": Law(1.02, 0.10, (Member("ax", 1), Member("v", -1))),
    "steering": Law(1.0, 0.18, (Member("delta", 1), Member("v", 1), Member("r", -1))),
    "axle": Law(1.0, 0.08, (Member("v", 1), Member("r", -1), Member("sides", 1))),
    "ground": Law(1.0, 0.015, (Member("v", -1),)),
    "turning": Law(1.0, 0.08, (Member("r", -1), Member("place", 1))),
}
# Identities of sizes without sign.
UNSIGNED: Final = ("ground",)
FLIPPED: Final = Mistake("sign", -1.0)
# Most wheel-speed sensors do not report the direction. In a car that drives backwards, such a speed
# has the wrong sign in all identities, as if several other signals had one.
REVERSING: Final = Mistake("unsigned in reverse", -1.0)
QUANTITIES: Final = ("ax", "ay", "r", "delta", "v", "sides", "place")
# Clocks that an identity compares: identity -> (device on the left, device on the right).
CLOCKS: Final = {
    "longitudinal": ("imu", "wheels"),
    "axle": ("wheels", "imu"),
    "steering": ("steering", "imu"),
    "ground": ("receiver", "wheels"),
    "turning": ("receiver", "imu"),
}
CLOCK_SPREAD_S: Final = {
    "longitudinal": 0.06,
    "axle": 0.04,
    "steering": 0.06,
    "ground": 0.05,
    "turning": 0.12,
}
CLOCK_CENTRE_S: Final = {
    "longitudinal": 0.03,
    "axle": 0.0,
    "steering": -0.05,
    "ground": 0.0,
    "turning": -0.06,
}
LATE_S: Final = 0.15  # [s] a larger delay is a fault; in logs without this fault it is below 0.1 s
# Minimum correlation at which the lag of an identity is used. Slides shift its two sides relative
# to each other.
CLOCK_LIKE: Final = 0.8
# Cost of a late clock. It is below FAULT_COST, because delays have no table of faults from which
# one could fit by chance.
CLOCK_COST: Final = 4.0


def faults_of(vehicle: Vehicle, ground: Fit, fast: float) -> dict[str, list[Mistake]]:
    """Return, for each measured quantity, its possible faults (wrong units and signs) for this
    vehicle. `ground` is the fit of the speed over ground to the wheels' speed, `fast` the drive's
    high speed [m/s].
    """
    g = 1.0 / GRAVITY
    deg = 1.0 / DEG
    ratio = vehicle.steering_ratio or 16.0
    radius = vehicle.wheel_radius
    rims = [Mistake(unit, radius / SPEED[unit]) for unit in SPEED]
    if ground.is_known and 0.4 < ground.gain < 2.5 and abs(ground.gain - 1.0) > 0.03:
        rims.append(Mistake("radius", 1.0 / ground.gain))
    if fast < FASTEST_REVERSE_M_S:
        rims.append(REVERSING)
    angles = [
        Mistake("deg", 1.0 / ANGLE["deg"]),
        Mistake("steering wheel", ratio),
        Mistake("steering wheel, deg", ratio * deg),
    ]
    return {
        "ax": [FLIPPED, Mistake("g", g), Mistake("g, sign", -g)],
        "ay": [FLIPPED, Mistake("g", g), Mistake("g, sign", -g)],
        "r": [FLIPPED, Mistake("deg/s", deg), Mistake("deg/s, sign", -deg)],
        "delta": [
            FLIPPED,
            *angles,
            *(Mistake(f"{name}, sign", -factor) for name, factor in angles),
        ],
        "v": [*rims, Mistake("deg/s", deg), Mistake("rpm", 60.0 / (2.0 * math.pi))],
        "sides": [Mistake("left and right exchanged", -1.0)],
        "place": [Mistake("mirrored", -1.0)],
    }


# Faults of several quantities with one common cause. The cost of a group is 1.25 times that of one
# fault.
JOINT: Final = (
    (("ay", "sign"), ("r", "sign")),
    (("ax", "g"), ("ay", "g")),
    (("ax", "sign"), ("ay", "sign")),
    (("ay", "sign"), ("r", "sign"), ("delta", "sign")),
)


@dataclass(frozen=True)
class Verdict:
    """Result of the search for faults of measured quantities.

    `faults` has the fault of each quantity in the best explanation, None if there is none.
    `margins` has, for each quantity, the additional cost of the best explanation that gives this
    quantity another fault (or none).
    """

    faults: dict[str, Mistake | None]
    margins: dict[str, float]

    def is_settled(self, quantity: str) -> bool:
        """Return True if the result for the quantity (a fault or none) is certain: every other
        explanation of the recording is implausible.
        """
        return self.margins[quantity] >= SETTLED


def explain_fits(found: Mapping[str, Fit], vehicle: Vehicle, fast: float) -> Verdict:
    """Return the most plausible set of faults that explains the fitted identities `found` (pairs of
    expressions that are equal by physics). `fast` is the drive's high speed [m/s].

    This set has the lowest cost. Each fault adds a fixed cost, because faults are rare. Each
    identity adds the squared normalised error that remains in its gain (ratio of its two sides).
    """
    choices: dict[str, list[Mistake | None]] = {
        quantity: [None, *faults]
        for quantity, faults in faults_of(vehicle, found["ground"], fast).items()
    }
    sets = dict(zip(choices, _index_sets(choices), strict=True))
    factors = {
        quantity: np.array([fault.factor if fault else 1.0 for fault in choices[quantity]])[chosen]
        for quantity, chosen in sets.items()
    }
    known = {name: fit for name, fit in found.items() if fit.is_known}
    costs = _prices_of(choices, sets) + sum(
        _misfits_of(name, fit, factors) for name, fit in known.items()
    )
    least = int(np.argmin(costs))
    best = {quantity: choices[quantity][chosen[least]] for quantity, chosen in sets.items()}
    margins = dict.fromkeys(QUANTITIES, 0.0)
    for quantity in {member.quantity for name in known for member in LAWS[name].members}:
        is_rival = [not _are_equivalent(fault, best[quantity]) for fault in choices[quantity]]
        rivals = costs[np.array(is_rival)[sets[quantity]]]
        margins[quantity] = float(rivals.min() - costs[least])
    return Verdict(best, margins)


def _are_equivalent(one: Mistake | None, other: Mistake | None) -> bool:
    """Return True if two faults have the same effect on the signal. For example, a wheel speed in
    km/h instead of rad/s looks like a wheel radius of 0.28 m; no drive can distinguish the two.
    """
    if one is None or other is None:
        return one is other
    return abs(math.log(abs(one.factor / other.factor))) < ALIKE and one.factor * other.factor > 0.0


def _index_sets(choices: Mapping[str, Sequence[Mistake | None]]) -> IntArray:
    """Return every set of faults, as the index of each quantity's fault in its choices: an array
    (quantities, sets). The first set has no fault.
    """
    sizes = [len(faults) for faults in choices.values()]
    return np.indices(sizes).reshape(len(sizes), -1)


def _prices_of(
    choices: Mapping[str, Sequence[Mistake | None]], sets: Mapping[str, IntArray]
) -> FloatArray:
    """Return the summed cost (n,) of the faults in each set; see `JOINT` for groups of faults."""
    # If a unit and a wheel radius explain the drive equally well, prefer the unit.
    prices = sum(
        np.array([0.0 if f is None else FAULT_COST + (f.name == "radius") for f in faults])[
            sets[quantity]
        ]
        for quantity, faults in choices.items()
    )
    saved = np.zeros(np.shape(prices))
    for joint in JOINT:
        together = np.ones(np.shape(prices), bool)
        for quantity, name in joint:
            is_chosen = [fault is not None and fault.name == name for fault in choices[quantity]]
            together &= np.array(is_chosen)[sets[quantity]]
        saved = np.maximum(saved, np.where(together, (len(joint) - 1.25) * FAULT_COST, 0.0))
    return np.asarray(prices - saved)


def _misfits_of(name: str, fit: Fit, factors: Mapping[str, FloatArray]) -> FloatArray:
    """Return the squared normalised error (n,) that remains in the gain of an identity for each of
    n sets of faults, which multiply each quantity by its `factors` (n,).
    """
    law = LAWS[name]
    gains = law.centre * np.prod(
        [factors[quantity] ** float(power) for quantity, power in law.members], axis=0
    )
    if name in UNSIGNED:
        gains = np.abs(gains)
    log_ratio = np.log(abs(fit.gain) / np.abs(gains)) if fit.gain else np.full(len(gains), 10.0)
    costs = log_ratio**2 / (law.spread**2 + fit.error**2)
    costs += np.where(fit.gain * gains < 0.0, WRONG_SIGN * fit.correlation**2, 0.0)
    return np.minimum(costs, 400.0)


def late_clocks(found: Mapping[str, Fit]) -> dict[str, tuple[float, float]]:
    """Return the device with a late clock that best explains the lags of the identities (pairs of
    quantities that are equal by physics), as device → (delay of its clock [s], margin). The margin
    is the difference in cost to the best other explanation (another device, or none).

    The result is empty if the delay is below LATE_S, or if the explanation without a late device
    costs less.
    """
    known = {
        name: fit
        for name, fit in found.items()
        if name in CLOCKS
        and fit.is_known
        and math.isfinite(fit.lag_error_s)
        and abs(fit.correlation) > CLOCK_LIKE
    }
    devices = sorted({device for name in known for device in CLOCKS[name]})

    def lateness_cost(late: Mapping[str, float]) -> float:
        total = 0.0
        for name, fit in known.items():
            left, right = CLOCKS[name]
            deviation = (
                fit.lag_s - CLOCK_CENTRE_S[name] - late.get(left, 0.0) + late.get(right, 0.0)
            )
            total += min(deviation**2 / (CLOCK_SPREAD_S[name] ** 2 + fit.lag_error_s**2), 100.0)
        return total

    base = lateness_cost({})
    options = []
    for device in devices:
        guesses = []
        for name, fit in known.items():
            if device in CLOCKS[name]:
                sign = 1.0 if CLOCKS[name][0] == device else -1.0
                guesses.append(sign * (fit.lag_s - CLOCK_CENTRE_S[name]))
        options += [
            (lateness_cost({device: guess}) + CLOCK_COST, device, guess) for guess in guesses
        ]
    if not options:
        return {}
    best, device, late = min(options)
    if abs(late) < LATE_S or best > base:
        return {}
    rivals = [other for other, name, _ in options if name != device]
    return {device: (late, min([base, *rivals]) - best)}
