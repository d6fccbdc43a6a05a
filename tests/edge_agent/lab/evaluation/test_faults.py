"""Tests of simulated sensor faults. The estimates must stay finite, and health flags must report
the fault. The friction interval of the default estimator must still contain the true friction as
often as stated.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.estimators import ESTIMATORS
from edge_agent.lab.evaluation import faults
from edge_agent.lab.evaluation.batch import DriveSet, simulate_realistic
from edge_agent.lab.evaluation.campaign import DEFAULT
from edge_agent.lab.evaluation.faults import BEGINS, CASES, DRIVES, ENDS, apply_fault
from schemas.signals import Health, S

# Required fault: name of the campaign's row that shows it.
ASKED = {
    "dropout": "inertial-dropout",
    "stuck": "wheel-speed-stuck",
    "spike": "spikes-beyond-belief",
    "bias step": "bias-step",
    "wrong steering zero": "wrong-steering-zero",
    "one wheel speed lost": "one-wheel-speed-lost",
    "no torque at all": "no-torque-at-all",
    "GNSS gone": "position-gone",
    "time gap": "time-gap",
    "out-of-order sample": "sample-out-of-order",
}
HONEST = 0.75  # share of the samples of six drives; a drive that is wrong until its end is a sixth


@pytest.fixture(scope="module")
def slalom() -> DriveSet:
    return simulate_realistic(DRIVES["slalom"], range(1))


def test_every_fault_that_was_asked_for_has_a_row_with_an_expectation() -> None:
    assert set(ASKED.values()) <= set(CASES)
    assert all(case.expected for case in CASES.values())


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_no_fault_loses_an_estimate_and_health_reports_detectable_ones(
    estimator: str,
) -> None:
    found = faults.run_fault_campaign(range(1), [estimator], ("slalom", "braking"))
    for (case, _), measured in found.items():
        assert (measured["finite"] == 1.0).all(), case
        assert (measured["told"] == float(CASES[case].flag != Health.OK)).all(), case


def test_under_a_fault_the_interval_of_the_default_stays_honest() -> None:
    found = faults.run_fault_campaign(range(2), [DEFAULT])
    for (case, _), measured in found.items():
        assert measured["coverage90"].mean() >= HONEST, case


@pytest.mark.parametrize("name", [name for name in CASES if name != "none"])
def test_every_fault_case_changes_only_its_stated_signals(name: str, slalom: DriveSet) -> None:
    broken = apply_fault(slalom, CASES[name])
    same = (broken.signals == slalom.signals) | (
        np.isnan(broken.signals) & np.isnan(slalom.signals)
    )
    assert not same.all() or not np.array_equal(broken.t, slalom.t)
    channels = {i for fault in CASES[name].faults for i in fault.indices}
    assert {int(i) for i in np.flatnonzero(~same.all(axis=(0, 1)))} <= channels


def test_a_gap_and_late_samples_are_on_the_clock_alone(slalom: DriveSet) -> None:
    steps = np.diff(apply_fault(slalom, CASES["time-gap"]).t[:, 0])
    assert steps.max() == pytest.approx(3.01)
    late = np.diff(apply_fault(slalom, CASES["sample-out-of-order"]).t[:, 0])
    assert (late < 0.0).sum() == pytest.approx((ENDS - BEGINS) * 10, abs=1)


def test_a_fault_of_the_yaw_is_not_one_of_the_yaw_rate() -> None:
    gone = {i for fault in CASES["position-gone"].faults for i in fault.indices}
    assert gone == {S.LATITUDE, S.LONGITUDE, S.YAW}
