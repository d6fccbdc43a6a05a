"""Tests of the belief on friction during a slide and at its end. Only a wheel that grips again
under load may show that the ice has ended. While a wheel slides with the same force, the road stays
the same.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.friction_mixture.mixture.mixing import apply_road_change, carried_degree
from edge_agent.estimators.friction_mixture.state.constants import NODES, Constants
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, design_of
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import MixtureContext, Scratch
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.runtime.records import put_record, records
from tests.edge_agent.estimators.drives import drive, signals_of

SNOW = 0.3
ICE = 0.25
ALONE = 7  # an improbable node among probable ones
# An upper end of the interval below this is a report of a slippery road.
SLIPPERY = 0.5


@pytest.mark.parametrize(
    ("demand", "degree"), [(0.0, 0.0), (0.4, 0.0), (0.6, 0.5), (0.8, 1.0), (1.5, 1.0)]
)
def test_carried_degree_rises_with_force_over_friction(demand: float, degree: float) -> None:
    memory = records(MixtureMemory, 1)
    memory["friction_left"]["median"] = 0.8
    memory["friction_right"]["median"] = 0.2  # the slippery side counts
    found = carried_degree(
        cast(MixtureMemory, memory[0]), Constants().replace_values(carried_share=0.4), 0.2 * demand
    )
    assert found == pytest.approx(degree)


def test_snow_stays_reported_between_pulses_of_the_brake() -> None:
    t, signals, vehicle = drive("pulses", SNOW)
    upper = bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None]).mu_upper[:, 0]
    slippery = upper < SLIPPERY
    assert slippery[slippery.argmax() :].mean() > 0.99  # .973 if each end of a slide is the snow's


@pytest.mark.parametrize(
    ("slides", "new", "moved"), [(1.0, 0.0, False), (1.0, 1.0, True), (0.0, 0.0, True)]
)
def test_road_stays_the_same_while_a_wheel_slides_with_the_same_force(
    slides: float, new: float, *, moved: bool
) -> None:
    context = records(MixtureContext, 1)
    put_record(context["design"][0], design_of(Memberships(), adaptive=True))
    memory = records(MixtureMemory, 1)
    memory["weight"][0, 6] = 1.0
    memory["visit_weight"][0, 6] = 1.0
    memory["friction_left"]["median"] = 0.25
    memory["friction_right"]["median"] = 0.25
    memory["slip"]["held"] = slides
    context["scratch"]["features"]["new"] = new
    apply_road_change(
        cast(MixtureMemory, memory[0]),
        cast(MixtureDesign, context["design"][0]),
        cast(Scratch, context["scratch"][0]),
        10.0,
    )
    assert (memory["weight"][0, 6] < 0.99) == moved
    assert memory["weight"][0, :NODES].sum() == pytest.approx(1.0)


def test_a_node_that_only_its_neighbours_keep_alive_has_no_penalty() -> None:
    context = records(MixtureContext, 1)
    design = design_of(Memberships(), adaptive=True)
    put_record(context["design"][0], design)
    memory = records(MixtureMemory, 1)
    memory["weight"][0, :NODES] = design.prior
    memory["visit_weight"][0, :NODES] = design.prior
    memory["weight"][0, ALONE] = 1e-9
    memory["penalty"] = 50.0
    apply_road_change(
        cast(MixtureMemory, memory[0]),
        cast(MixtureDesign, context["design"][0]),
        cast(Scratch, context["scratch"][0]),
        1.0,
    )
    penalty = memory["penalty"][0]
    assert penalty[ALONE] < 0.1
    others = np.delete(np.arange(NODES), ALONE)
    assert penalty[others].min() > 49.0


def test_five_stops_with_sliding_wheels_keep_speed_and_friction() -> None:
    errors = []
    medians = []
    for seed in range(1, 6):
        log, vehicle = simulate_manoeuvre(
            "braking", mu=ICE, seed=seed, setup=DriveSetup(sensors="mems")
        )
        t = log["t"].to_numpy()
        bank = bank_of("aco-fckf", [vehicle])
        estimates = bank.advance(t[:, None], signals_of(log)[:, None])
        end = np.searchsorted(t, 7.5)
        errors.append(estimates.vx[end, 0] - log["true_vx"].to_numpy()[end])
        medians.append(estimates.mu[end, 0])
    # Without the rules for slides in `apply_road_change` and `spread_points`: .85 m/s and .32.
    assert np.mean(errors) < 0.65
    assert np.mean(medians) < ICE + 0.03
