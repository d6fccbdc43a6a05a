"""Tests of novelty, the degree (0 to 1) to which a force or slip in a block (some samples) differs
from its usual value.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import Parameter, parameter_table
from edge_agent.estimators.friction_mixture.mixture.weighing import saturation, update_novelty
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, design_of
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, MixtureContext
from schemas.runtime.records import put_record, records
from tests.edge_agent.estimators.drives import drive

SPEED_M_S = 10.0
BLOCK_S = 0.05
BEND = 0.15  # side force over load in the bend
ICE = 0.18


class Bend:
    """Car in a left bend with constant speed and curvature. The test sets how much the
    axles slip.
    """

    def __init__(self) -> None:
        """Create a car that has driven on a road with grip for so long that the filter regards its
        slip as usual.
        """
        context = records(MixtureContext, 1)
        put_record(context["design"][0], design_of(Memberships(), adaptive=True))
        self.mu = context["design"]["mu"][0]
        self.design = cast(MixtureDesign, context["design"][0])
        self.memory = records(MixtureMemory, 1)
        self.features = records(BlockFeatures, 1)
        self.memory["row"][0] = parameter_table([drive("straight", 0.85)[2]])[0]
        self.features["duration"] = BLOCK_S
        self.features["steer_cos"] = 1.0
        self.believe_in(0.8)
        self.drive_block(BEND, seconds=20.0)

    def believe_in(self, mu: float) -> None:
        """Set the filter's belief: all probability is on the node (friction hypothesis) nearest to
        `mu`.
        """
        self.memory["weight"][0] = 0.0
        self.memory["weight"][0, np.argmin(np.abs(self.mu - mu))] = 1.0
        self.memory["friction"]["median"] = mu

    def drive_block(
        self,
        slip: float,
        *,
        force: float = BEND,
        braking_slip: float = 0.0,
        seconds: float = BLOCK_S,
    ) -> float:
        """Drive through the bend. Return the degree (0 to 1) to which the last block of samples
        counts as new, that is, differs from the usual.

        Args:
            slip: lateral slip, expressed as the side force over load of a linear tyre with this
                slip.
            force: measured side force over load.
            braking_slip: longitudinal slip of the front wheels, expressed in the same way.
            seconds: duration.
        """
        slope = self.memory["row"][0, Parameter.SLOPE_Y]
        across = -slip / slope * SPEED_M_S
        slope = self.memory["row"][0, Parameter.SLOPE_X]
        self.features["rolling"] = SPEED_M_S
        self.features["rolling"][0, :2] *= 1.0 - braking_slip / slope
        self.features["side"] = force
        self.features["demand"] = abs(force)
        for _ in range(round(seconds / BLOCK_S)):
            update_novelty(
                cast(MixtureMemory, self.memory[0]),
                self.design,
                cast(BlockFeatures, self.features[0]),
                SPEED_M_S,
                across,
            )
        return float(self.features["new"][0])

    @property
    def ice_ended(self) -> float:
        """Return the degree (0 to 1), after the last block of samples, to which the filter believes
        that the ice has ended.
        """
        return float(self.memory["slip"]["axle_ended"][0])


def test_novelty_is_zero_in_a_steady_bend() -> None:
    assert Bend().drive_block(BEND) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("slip", "force"), [(BEND, 0.25), (0.3, BEND), (0.05, BEND)])
def test_force_or_slip_alone_is_new(slip: float, force: float) -> None:
    assert Bend().drive_block(slip, force=force) > 0.9


def test_braking_slip_alone_is_new_for_about_a_second() -> None:
    bend = Bend()
    assert bend.drive_block(BEND, braking_slip=0.15) > 0.9
    assert bend.drive_block(BEND, braking_slip=0.15, seconds=5.0) < 0.1


def test_braking_slip_of_a_bump_is_not_new() -> None:
    bend = Bend()
    share = Constants().physical.abrupt_share
    bend.features["abrupt_noise"][0, :2] = (share * 0.15) ** 2
    assert bend.drive_block(BEND, braking_slip=0.15) < 0.01


def test_braking_slip_that_an_unknown_slope_explains_is_not_new() -> None:
    bend = Bend()
    stiffness = bend.memory["row"][0, Parameter.SLOPE_X]
    offset = 0.15 * SPEED_M_S / (stiffness * Constants().chosen.window)
    bend.memory["overall_covariance"][0, NodeState.SLOPE, NodeState.SLOPE] = offset**2
    assert bend.drive_block(BEND, braking_slip=0.15) < 0.01


def test_a_missing_wheel_speed_is_not_new() -> None:
    assert Bend().drive_block(BEND, braking_slip=np.nan) == pytest.approx(0.0, abs=1e-6)


def test_a_missing_side_force_is_not_new() -> None:
    assert Bend().drive_block(0.3, force=np.nan) == pytest.approx(0.0, abs=1e-6)


def test_ice_ends_where_the_slip_falls_and_the_force_stays() -> None:
    bend = Bend()
    bend.believe_in(ICE)
    bend.drive_block(0.3, seconds=3.0)
    assert bend.ice_ended == 0.0
    bend.drive_block(BEND)
    assert bend.ice_ended > 0.8


def test_ice_does_not_end_where_the_driver_stops_turning() -> None:
    bend = Bend()
    bend.believe_in(ICE)
    bend.drive_block(0.3, seconds=3.0)
    bend.drive_block(0.0, force=0.0)
    assert bend.ice_ended == 0.0


def test_a_slide_on_a_road_with_grip_ends_no_ice() -> None:
    bend = Bend()
    bend.drive_block(1.5, seconds=3.0)
    bend.drive_block(BEND)
    assert bend.ice_ended == 0.0


def test_an_axle_slides_between_its_friction_and_half_as_much_again() -> None:
    assert [saturation(s, ICE) for s in (0.1, ICE, 1.25 * ICE, 2.0 * ICE, np.nan)] == pytest.approx(
        [0.0, 0.0, 0.5, 1.0, 0.0]
    )
