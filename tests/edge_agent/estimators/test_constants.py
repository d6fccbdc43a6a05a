"""Tests that each constant of the default estimator has the expected effect. If a test multiplies
the constant, a figure of a drive (such as the mean interval width) must change by at least the
ratio in the table MOVES.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators.estimates import Estimates
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.state.constants import (
    NODES,
    PLACES,
    STATES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import (
    OMEGA,
    TORQUE,
    drive,
    drive_over_joints,
    join_drives,
    signals_of,
)

SAMPLES = 400  # samples of the short drives
FIRST = 100  # first sample that counts in the figures
CUT = 20  # samples between two readings of the filter's internal states
SHORT: dict[str, float | None] = {
    "j-turn": 0.4,
    "braking": 0.3,
    "acceleration": 0.3,
    "gaining-slalom": 0.9,
    "pulses": 0.6,
    "slalom": 0.3,
    "split-braking": None,
}


class Move(NamedTuple):
    """Expected change of one figure of one drive (mean interval width, for example) when a constant
    of the estimator is multiplied by `times`.
    """

    figure: str
    drive: str
    # Changed value / usual value: at least `ratio` if it is above 1, otherwise at most.
    ratio: float
    times: float = 3.0  # factor by which the constant is multiplied


LESS = 1.0 / 3.0
MOVES = {
    # Group: number and independence of the measurements.
    "block_time": Move("updates", "acceleration", 0.4),
    "correlation_time": Move("vy_std", "constant-radius", 1.3),
    # R adapts faster to the sliding axles.
    "window": Move("adaptation", "j-turn", 1.5, LESS),
    # Group: road.
    "hazard": Move("least probabilities", "j-turn", 1.5),
    # Ice is expected after a longer distance without grip demand.
    "common_mu": Move("upper", "slalom", 0.97, 0.8),
    "patch_length": Move("lower", "slalom", 1.015),
    "diffusion": Move("width", "acceleration", 1.15),
    "split_prior": Move("one friction's probability", "split-braking", 0.85),
    # The split nodes wake later.
    "split_asymmetry": Move("split probability", "split-braking", 0.997),
    # Group: evidence of a block.
    "plausible_loss": Move("least probabilities", "constant-radius", 1.03),
    "largest_loss": Move("least probabilities", "j-turn", 0.3),
    "abrupt_share": Move("upper", "joints", 0.95, LESS),  # more of a bump is read as slip
    "abrupt_time": Move("upper", "joints", 0.992, LESS),  # a bump is read as slip sooner
    "steady_half": Move("least probabilities", "constant-radius", 1.06),
    "steady_share": Move("least probabilities", "constant-radius", 0.95),
    # More nodes of low friction pay the penalty for sliding.
    "sliding_slope": Move("upper", "constant-radius", 1.08),
    # Nodes in which the wheels slide lose.
    "freedom_penalty": Move("width", "braking without torque", 1.1),
    # Group: limits. Tighter limits keep the nodes away from states that cost a penalty.
    "farthest": Move("penalty", "braking", 0.5, LESS),
    # With a smaller limit, R adapts less to large innovations.
    "huber": Move("nis", "stopping", 3.0, LESS),
    "diverged": Move("nodes apart in v_y", "turn and straight", 0.6, LESS),
    # Group: tyre and vehicle. A sharper nominal curve leaves less sharpness to be explained by the
    # state SHAPE.
    "curve_c": Move("sharpness", "braking", 0.8, 1.1),
    "shape_std": Move("std SHAPE", "gaining-slalom", 2.0),
    "stiffness_std": Move("std LN_KX", "gaining-slalom", 2.0),
    # The residual of a stiff tyre is divided by a larger number.
    "stiffness_power_x": Move("nis", "acceleration", 0.63),
    "stiffness_power_y": Move("nis", "turn and straight", 0.94),
    "informing": Move("std LN_KX", "j-turn", 1.03),
    "steer_gain_std": Move("std STEER_GAIN", "stopping", 2.5),
    # The axle of this car does not yield as much as the larger mean expects.
    "compliance_mean": Move("strain", "constant-radius", 1.1),
    "compliance_std": Move("std COMPLIANCE", "stopping", 2.5),
    # Force follows slip later.
    "relaxation_length": Move("nis", "pulses", 1.1),
    # More of the slip acts at once.
    "direct_slip": Move("nis", "pulses", 0.99),
    # Group: sliding wheels.
    # After the start of a slide, other friction values become possible sooner.
    "slip_change": Move("least probabilities", "acceleration", 1.1),
    "slip_hazard": Move("least probabilities", "braking without torque", 1.1),
    # More force is needed before the road counts as changed.
    "carried_share": Move("least probabilities", "braking without torque", 0.8),
    # With a smaller factor on R, the rear axle pulls the states away from the other measurements.
    "rear_unlike": Move("nis", "turn and straight", 1.15, LESS),
    # Group: sensors.
    "leak": Move("mean LEAK_Y", "acceleration", 2.0),
    "return_time": Move("std LEAK_Y", "pulses", 1.04, LESS),
    "offset_std": Move("std SLOPE", "braking", 1.6),
    # The slope is forgotten after a shorter distance.
    "slope_length": Move("std SLOPE", "pulses", 1.08, LESS),
    "steer_std": Move("std STEER", "constant-radius", 1.4),
    "wheel_std": Move("std RADIUS", "standing", 2.0),
    "common_lag": Move("vx_std", "stopping", 1.5),
    "lag_std": Move("std LAG_WHEEL", "standing", 2.5),
    "drift": Move("std VX", "slalom", 1.15),
    # Group: noise. Larger assumed noise makes the normalised innovations (nis) smaller.
    "omega_noise": Move("nis", "slalom", 0.4),
    "spin_share": Move("nis", "braking", 0.9),
    "floor_x": Move("nis", "acceleration", 0.92),
    "floor_y": Move("nis", "j-turn", 0.86),
    "force_share": Move("nis", "split-braking", 0.85),
    "axle_share": Move("nis", "j-turn", 0.91),
    "shape_share": Move("nis", "constant-radius", 0.95),
    "lag": Move("nis", "pulses", 0.9),
    # Group: wheels that show the velocity without a tyre model.
    "agreeing_slip": Move("std of wheels' v_x", "rough acceleration", 1.3),
    "following_most": Move("v_y told by an axle", "slalom", 2.0),
    # Group: contradiction between the car and the vehicle model.
    "strain_prior": Move("strain", "turn and straight", 1.1),  # the strain is learned more slowly
    "strain_usual": Move("vy_std", "turn and straight", 0.997),  # the axles are trusted more
    # Axles of a car with little strain are trusted less.
    "strain_power": Move("vy_std", "braking", 1.08, LESS),
    "strain_least": Move("vy_std", "gaining-slalom", 1.12),
    "strain_most": Move("vy_std", "rough acceleration", 0.92, LESS),
    # The contradiction is accepted later.
    "odd_least": Move("distrust", "side force without turning", 0.98),
    # The model is tried again sooner.
    "patience": Move("distrust", "side force in one bend", 0.8, 0.02),
    "distrust_noise": Move("nis", "side force without turning", 0.97, LESS),
    "distrust_drift": Move("vy_std", "side force without turning", 1.5),
    # Learned states are kept for longer.
    "distrust_forget": Move("std RADIUS", "side force without turning", 0.9),
}


@cache
def make_drive(name: str) -> tuple[FloatArray, FloatArray, Vehicle]:
    """Return times t (T,) [s], signals (T, 18) and vehicle data of the drive with this name."""
    if name in SHORT:
        t, signals, vehicle = drive(name, SHORT[name])
        t = t[:SAMPLES]
        signals = signals[:SAMPLES].copy()
        if name == "pulses":
            signals[FIRST:, TORQUE] = np.nan
        if name == "slalom":
            signals[150:250, [S.AX, S.AY]] = np.nan
        return t, signals, vehicle
    if name == "braking without torque":
        t, signals, vehicle = drive("braking", 0.8)
        signals = signals.copy()
        signals[:, TORQUE] = np.nan
        return t[:SAMPLES], signals[:SAMPLES], vehicle
    if name == "joints":
        return drive_over_joints()
    if name == "constant-radius":
        return drive(name, 0.5)
    if name == "turn and straight":
        turn = drive("j-turn", 0.5)
        return *join_drives(turn, drive("straight", 0.5, seconds=40.0)), turn[2]
    if name == "rough acceleration":
        log, vehicle = simulate_manoeuvre(
            "acceleration",
            mu=0.8,
            seed=1,
            duration_s=12.0,
            setup=DriveSetup(sensors="rough", road="hilly"),
        )
        return log["t"].to_numpy(), signals_of(log), vehicle
    return made_up(name)


def made_up(name: str) -> tuple[FloatArray, FloatArray, Vehicle]:
    """Return times, signals and vehicle data of a drive with signals that the simulator cannot
    produce: a stop with slipping wheels, a standing car, or side force without yaw.
    """
    t = np.arange(0.0, 4.0 if name == "stopping" else 20.0, 0.01)
    signals = np.zeros((len(t), len(CHANNELS)))
    if name == "stopping":
        signals[:, S.AX] = np.where((t > 0.5) & (t < 2.4), -11.0, 0.3)
        signals[:, OMEGA] = np.clip(70.0 - 36.0 * np.clip(t - 0.5, 0.0, 3.0), 0.0, None)[:, None]
    elif name == "standing":
        signals[:, S.AX] = 0.5
        signals[:, OMEGA] = np.clip(20.0 - 10.0 * t, 0.0, None)[:, None]
    else:
        lasts = 10.0 if name == "side force without turning" else 4.0
        signals[:, OMEGA] = 60.0
        signals[:, S.AY] = np.where(t < lasts, 3.0 * np.sin(2.0 * t), 0.0)
    return t, signals, drive("j-turn", SHORT["j-turn"])[2]


@cache
def figures(place: str, name: str | None, times: float) -> dict[str, float]:
    """Run the default estimator on the drive named `place`, with its constant `name` multiplied by
    `times` (unchanged if `name` is None). Return means of its outputs and of its internal states,
    by name.
    """
    t, signals, vehicle = make_drive(place)
    constants = Constants()
    if name is not None:
        constants = constants.replace_values(**{name: times * constants.by_name()[name]})
    bank = mixture_bank(
        parameter_table([vehicle]), design_of(Memberships(), adaptive=True, constants=constants)
    )
    parts = []
    looks = []
    for k in range(0, len(t), CUT):
        parts.append(bank.advance(t[k : k + CUT, None], signals[k : k + CUT, None]).values)
        looks.append(bank._filters.copy())
    found = Estimates(np.concatenate(parts)[FIRST:, 0])
    return summarize_reports(found) | inside(np.concatenate(looks)[FIRST // CUT :])


def summarize_reports(estimates: Estimates) -> dict[str, float]:
    """Return the means of the estimator's outputs over one drive, by name. They include the ends of
    the friction interval, standard deviations, and statistics of the innovations (measurement minus
    prediction).
    """
    mean = {
        "width": estimates.mu_upper - estimates.mu_lower,
        "lower": estimates.mu_lower,
        "upper": estimates.mu_upper,
        "vx_std": estimates.vx_std,
        "vy_std": estimates.vy_std,
        "nis": estimates.innovation_nis,
        "adaptation": estimates.adaptation,
        "updates": estimates.innovation_log_likelihood != 0.0,
    }
    return {name: float(np.mean(values)) for name, values in mean.items()}


def inside(filters: np.ndarray) -> dict[str, float]:
    """Return summary numbers of the filter's internal states over one drive, by name. Most are
    means over the drive; some are maxima, root mean squares or values at the end.

    They describe the nodes (filters of one friction hypothesis each): their probabilities, and the
    amounts [nat] charged to them for deviations of vehicle and sensor states from the prior. They
    also describe the states of the whole filter and its strain (misfit of the vehicle model).
    """
    weight = filters["weight"]
    split = filters["split"]
    chain = weight[:, :NODES]
    halves = weight[split][:, NODES:].sum(axis=1)
    best = chain.argmax(axis=1)
    velocity = filters["mean"].swapaxes(2, 3).reshape(len(best), PLACES, STATES)[..., :2]
    apart = np.abs(velocity[:, :NODES] - velocity[np.arange(len(best)), best][:, None])
    overall = filters["overall_mean"]
    std = np.sqrt(np.diag(filters["overall_covariance"][-1]))
    mean = overall[-1]
    rolling = filters["rolling"]
    trust = filters["trust"]
    return {
        "least probabilities": geometric(chain),
        "penalty": float(np.abs(filters["penalty"][:, :NODES]).mean()),
        "split nodes awake": float(split.mean()),
        "split probability": geometric(halves),
        "one friction's probability": geometric(1.0 - halves),
        "nodes apart in v_x": float(apart[..., 0].max()),
        "nodes apart in v_y": float(apart[..., 1].max()),
        "sharpness": float(np.exp(mean[NodeState.SHAPE])),
        **{f"std {state.name}": float(std[state]) for state in NodeState},
        **{f"mean {state.name}": float(mean[state]) for state in NodeState},
        **{state.name: float(np.sqrt(np.mean(overall[:, state] ** 2))) for state in NodeState},
        "stands": float(rolling["stands"].mean()),
        "v_x told by wheels": float(np.isfinite(rolling["ahead"]).mean()),
        "v_y told by an axle": float(np.isfinite(rolling["left"]).mean()),
        "std of wheels' v_x": mean_of_known(rolling["ahead_std"], rolling["ahead"]),
        "std of the axle's v_y": mean_of_known(rolling["left_std"], rolling["left"]),
        "strain": float(trust["strain"].mean()),
        "distrust": float(trust["distrust"].mean()),
    }


def mean_of_known(values: FloatArray, where: FloatArray) -> float:
    """Return the mean of those elements of `values` for which `where` is finite, or 0 if there are
    none.
    """
    is_known = np.isfinite(where)
    return float(values[is_known].mean()) if is_known.any() else 0.0


def geometric(values: FloatArray) -> float:
    """Return the geometric mean of probabilities, or 0 if there are none."""
    return float(np.exp(np.log(np.maximum(values, 1e-12)).mean())) if values.size else 0.0


def test_every_constant_has_its_move() -> None:
    assert set(MOVES) == set(Constants().by_name())


@pytest.mark.parametrize("name", MOVES)
def test_each_constant_has_the_expected_effect(name: str) -> None:
    move = MOVES[name]
    usual, changed = (
        figures(move.drive, *one)[move.figure] for one in ((None, 1.0), (name, move.times))
    )
    assert usual > 0.0
    ratio = changed / usual
    assert ratio >= move.ratio if move.ratio > 1.0 else ratio <= move.ratio, (
        f"{move.figure} times {ratio:.3f}"
    )
