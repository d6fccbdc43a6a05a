"""Evaluation with sensor faults: a table of faults with the expected effect of each, and measures
of how every estimator responds.

The faults are added to the signals of ordinary simulated drives from the time BEGINS on. The
measure `told` is the share of drives in which the estimator's health flags include the expected
one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates
from edge_agent.lab.evaluation.batch import DriveSet, DriveSpec, run_estimator, simulate_realistic
from edge_agent.lab.evaluation.measures import is_covered, motion_errors
from edge_agent.lab.evaluation.scenarios import SEDAN
from edge_agent.lab.simulation import Fault
from edge_agent.lab.simulation.faults import apply_faults
from edge_agent.lab.simulation.manoeuvres import jump, kmh
from schemas.numeric import FloatArray
from schemas.signals import Health

# Start and end of a fault [s].
BEGINS = 2.0
ENDS = 5.0
DRIVES: Final = {
    "slalom": DriveSpec("slalom", SEDAN, 0.30, kmh(30), duration_s=8.0),
    "lane change": DriveSpec("double-lane-change", SEDAN, 0.85, kmh(80), duration_s=8.0),
    "braking": DriveSpec(
        "moderate-braking", SEDAN, jump(0.85, 0.50, 60.0), kmh(80), duration_s=6.0
    ),
}


def in_order(t: FloatArray) -> FloatArray:
    """Return the time stamps t (T, N) unchanged, for faults that do not affect the time stamps."""
    return t


def kept_samples(t: FloatArray) -> FloatArray:
    """Return the time stamps t (T, N) with three seconds added from time BEGINS on, as if no
    samples had arrived for three seconds.
    """
    return np.where(t < BEGINS, t, t + 3.0)


def late_samples(t: FloatArray) -> FloatArray:
    """Return the time stamps t (T, N) with an error between the times BEGINS and ENDS: every tenth
    time stamp is 50 ms too early.
    """
    number = np.arange(len(t))[:, None]
    return np.where((t >= BEGINS) & (t < ENDS) & (number % 10 == 0), t - 0.05, t)


@dataclass(frozen=True)
class Case:
    """One row of the table of sensor faults: the faults, the expected effect in words, and a
    function that changes the time stamps. `flag` is the health flag (reason for less reliable
    estimates) that estimators must report, or OK if no estimator can detect the fault.
    """

    faults: tuple[Fault, ...]
    flag: Health
    expected: str
    clock: Callable[[FloatArray], FloatArray] = in_order


def fault_on(kind: str, *channels: str, size: float = 0.0) -> tuple[Fault, ...]:
    """Return a sensor fault of the given kind for each of the channels, from time BEGINS to
    ENDS.
    """
    return tuple(Fault(kind, channel, BEGINS, ENDS, size) for channel in channels)


CASES: Final = {
    "none": Case((), Health.OK, "the same drives without a fault, for comparison"),
    "inertial-dropout": Case(
        fault_on("dropout", "ax", "ay", "yaw_rate"),
        Health.NO_INERTIAL,
        "motion is estimated from the wheels, with a larger variance; friction is not updated",
    ),
    "steering-dropout": Case(
        fault_on("dropout", "delta"),
        Health.NO_STEERING,
        "the last angle is kept; the axles give no evidence of friction",
    ),
    "wheel-speed-stuck": Case(
        fault_on("stuck", "omega_fl"),
        Health.OK,
        "reported by the default estimator, which leaves the wheel out; others do not notice",
    ),
    "spikes-beyond-belief": Case(
        fault_on("spike", "omega_fl", size=900.0) + fault_on("spike", "ay", size=60.0),
        Health.OUTLIER,
        "each reading is refused",
    ),
    "believable-spikes": Case(
        fault_on("spike", "omega_fl", size=8.0) + fault_on("spike", "ax", size=5.0),
        Health.OK,
        "not reported by all estimators; a jump of an acceleration is refused once, a wheel that "
        "jumps is trusted less",
    ),
    "bias-step": Case(
        (Fault("bias", "ay", BEGINS, size=0.3),),
        Health.OK,
        "not reported; the offset is a state of the filter and is learned in seconds",
    ),
    "wrong-steering-zero": Case(
        (Fault("bias", "delta_fl", size=0.003), Fault("bias", "delta_fr", size=0.003)),
        Health.OK,
        "3 degrees at the steering wheel: not reported; the steering offset is a state of the "
        "filter",
    ),
    "one-wheel-speed-lost": Case(
        (Fault("dropout", "omega_rl", BEGINS),),
        Health.NO_WHEEL_SPEED,
        "the other wheels suffice; the interval is a little wider",
    ),
    "no-torque-at-all": Case(
        (Fault("missing", "torque"),),
        Health.NO_TORQUE,
        "total force from the accelerometer, divided between the wheels by assumption",
    ),
    "position-gone": Case(
        tuple(Fault("dropout", channel, BEGINS) for channel in ("latitude", "longitude", "yaw")),
        Health.NO_POSITION,
        "estimates do not change; without a position there are no visits and no observations",
    ),
    "time-gap": Case(
        (),
        Health.TIME_GAP,
        "the motion filter restarts; the belief of friction widens with the distance driven in "
        "the gap",
        kept_samples,
    ),
    "sample-out-of-order": Case(
        (),
        Health.TIME_GAP,
        "the sample is skipped and the previous estimate is repeated",
        late_samples,
    ),
}


def apply_fault(batch: DriveSet, case: Case) -> DriveSet:
    """Return a copy of the drives `batch` whose signals and time stamps have the fault of the given
    case.
    """
    each = [
        apply_faults(batch.t[:, n], batch.signals[:, n], case.faults)
        for n in range(batch.t.shape[1])
    ]
    return replace(batch, t=case.clock(batch.t), signals=np.stack(each, axis=1))


def case_measures(batch: DriveSet, reported: Estimates, case: Case) -> dict[str, FloatArray]:
    """Return the measures of a fault case, one value per drive. `finite` (1 or 0): all estimates
    are finite, and the friction estimate lies in its interval. `told` (1 or 0): health reports the
    expected flag. The others cover the time from BEGINS on: coverage and width of the friction
    interval, and RMSE of v_x and v_y.
    """
    after = batch.t[:, 0] >= BEGINS
    whole = np.isfinite(reported.values).all(axis=-1)
    ordered = (reported.mu_lower <= reported.mu) & (reported.mu <= reported.mu_upper)
    found = {
        "finite": (whole & ordered).all(axis=0).astype(float),
        "told": ((reported.health & int(case.flag)) != 0).any(axis=0).astype(float),
        "coverage90": is_covered(batch, reported)[after].mean(axis=0),
        "width": (reported.mu_upper - reported.mu_lower)[after].mean(axis=0),
    }
    for name in ("vx", "vy"):
        found[f"rmse_{name}"] = np.sqrt(
            (motion_errors(batch, reported)[name][after] ** 2).mean(axis=0)
        )
    return found


def run_fault_campaign(
    seeds: Sequence[int], estimators: Sequence[str], drives: Sequence[str] = tuple(DRIVES)
) -> dict[tuple[str, str], dict[str, FloatArray]]:
    """Run every sensor fault of the table with every estimator on all drives with all seeds. Return
    the measures by (fault case, estimator), one value per drive.
    """
    batches = [simulate_realistic(DRIVES[name], seeds) for name in drives]
    found = {}
    for name, case in CASES.items():
        for estimator in estimators:
            parts = []
            for batch in batches:
                broken = apply_fault(batch, case)
                parts.append(
                    case_measures(
                        broken, run_estimator(bank_of(estimator, broken.vehicles), broken), case
                    )
                )
            found[name, estimator] = {
                key: np.concatenate([part[key] for part in parts]) for key in parts[0]
            }
    return found
