"""Constants of the default's table move what they are for, in the direction and by the size that their reason says.

Those that the rough world changed are seen to matter in `test_constants_change`, until their sizes are stated anew.
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
from edge_agent.estimators.friction_mixture.constants import NODES, Constants, NodeState
from edge_agent.estimators.friction_mixture.design import design_of
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import drive, joined

SAMPLES = 400  # of the short drives
FIRST = 100  # sample from which figures are taken
CUT = 20  # samples between two looks into the filters
LOOKED_AT = ("weight", "split", "mean", "penalty", "overall_mean", "overall_covariance")


class Move(NamedTuple):
    """What changing a constant does to a figure of a drive."""

    figure: str
    drive: str
    ratio: float  # changed over usual: at least this where it is above 1, at most where it is below
    times: float = 3.0  # the constant


MOVES = {
    # fewer and more independent measurements
    "window": Move("adaptation", "acceleration", 0.8),  # R follows the spin later
    # the road
    "diffusion": Move("width", "acceleration", 1.15),
    "split_prior": Move("split probability", "turn and straight", 2.0),
    "split_hazard": Move("one friction's probability", "split-braking", 1.5),
    "split_asymmetry": Move("split nodes awake", "turn and straight", 0.5),
    # how much a block counts
    "demand_power": Move("penalty", "acceleration", 0.5),  # above the threshold all is evidence, nothing is charged
    "plausible_loss": Move("least probabilities", "constant-radius", 1.2),
    "largest_loss": Move("least probabilities", "j-turn", 0.3),
    "steady_time": Move("width", "constant-radius", 0.9),  # the force is new for longer
    "steady_half": Move("width", "constant-radius", 1.12),
    "steady_share": Move("width", "constant-radius", 0.9),
    "sliding_slope": Move("upper", "constant-radius", 1.2),  # more nodes pay for sliding: those of little friction
    "axle_penalty": Move("upper", "slalom", 0.88),  # saturated nodes, of little friction, gain
    # limits
    # the tyre and the vehicle: what a sharper curve explains is not explained by a sharper tyre
    "curve_c": Move("sharpness", "braking", 0.8, 1.1),
    "curve_e": Move("sharpness", "j-turn", 0.95),
    "shape_std": Move("std SHAPE", "gaining-slalom", 2.0),
    "stiffness_time": Move("std STEER", "turn and straight", 0.88),
    "stiffness_power_x": Move("nis", "acceleration", 0.6),  # the residual of a stiff tyre is divided by more
    "informing_y": Move("std LN_KY", "pulses", 1.2),
    "gain_std": Move("width", "acceleration", 1.1),
    # sensors
    "leak_y_mean": Move("mean LEAK_Y", "acceleration", 2.0),
    "leak_y_std": Move("std LEAK_Y", "acceleration", 2.0),
    "steer_std": Move("std STEER", "constant-radius", 1.5),
    "drift_y": Move("vy_std", "gaining-slalom", 1.6),
    # noise: what is expected to be larger is found to be smaller than expected
    "omega_noise": Move("nis", "gaining-slalom", 0.6),
    "gyro_std": Move("vy_std", "gaining-slalom", 1.15),
    "floor_x": Move("nis", "split-braking", 0.85),
    "force_share": Move("nis", "acceleration", 0.7),
    "shape_share": Move("nis", "split-braking", 0.88),
}


@cache
def drives() -> tuple[dict[str, int], FloatArray, FloatArray, list[Vehicle]]:
    """Samples of each drive, t (T, N), signals (T, N, 18), vehicles; NaN after a drive's end.

    Turning, locking, spinning, creeping, split sides; without torque, without accelerations for a while; a steady
    circle, and a long straight after a turn.
    """
    chosen = {
        name: drive(name, mu)
        for name, mu in (
            ("j-turn", 0.4), ("braking", 0.3), ("acceleration", 0.3), ("gaining-slalom", 0.9), ("pulses", 0.6),
            ("slalom", 0.3), ("split-braking", None),
        )
    }  # fmt: skip
    chosen = {name: (t[:SAMPLES], signals[:SAMPLES].copy(), one) for name, (t, signals, one) in chosen.items()}
    chosen["pulses"][1][100:, S.TORQUE : S.TORQUE + 4] = np.nan
    chosen["slalom"][1][150:250, [S.AX, S.AY]] = np.nan
    chosen["constant-radius"] = drive("constant-radius", 0.5)
    turn = drive("j-turn", 0.5)
    chosen["turn and straight"] = (*joined(turn, drive("straight", 0.5, seconds=40.0)), turn[2])
    lengths = {name: len(one[0]) for name, one in chosen.items()}
    t = np.full((max(lengths.values()), len(chosen)), np.nan)
    signals = np.full((*t.shape, chosen["j-turn"][1].shape[1]), np.nan)
    for n, one in enumerate(chosen.values()):
        t[: len(one[0]), n], signals[: len(one[0]), n] = one[0], one[1]
    return lengths, t, signals, [one[2] for one in chosen.values()]


@cache
def figures(name: str | None, times: float) -> dict[tuple[str, str], float]:
    """Figures of every drive, with constant `name` that many times as large."""
    lengths, t, signals, vehicles = drives()
    constants = Constants()
    if name is not None:
        constants = constants._replace(**{name: times * getattr(constants, name)})
    bank = mixture_bank(parameter_table(vehicles), design_of(Memberships(), adaptive=True, constants=constants))
    parts, looks = [], []
    for k in range(0, len(t), CUT):
        parts.append(bank.advance(t[k : k + CUT], signals[k : k + CUT]).values)
        looks.append({field: bank._filters[field].copy() for field in LOOKED_AT})
    found = Estimates(np.concatenate(parts))
    seen = {field: np.stack([look[field] for look in looks]) for field in LOOKED_AT}
    return {
        (figure, place): value
        for n, (place, length) in enumerate(lengths.items())
        for figure, value in (
            *reported(Estimates(found.values[FIRST:length, n])).items(),
            *inside({field: values[FIRST // CUT : length // CUT, n] for field, values in seen.items()}).items(),
        )
    }


def reported(estimates: Estimates) -> dict[str, float]:
    """Figures of what is reported of one drive."""
    mean = {
        "width": estimates.mu_upper - estimates.mu_lower,
        "upper": estimates.mu_upper,
        "vx_std": estimates.vx_std,
        "vy_std": estimates.vy_std,
        "nis": estimates.innovation_nis,
        "adaptation": estimates.adaptation,
        "updates": estimates.innovation_log_likelihood != 0.0,
    }
    return {name: float(np.mean(values)) for name, values in mean.items()}


def inside(filters: dict[str, np.ndarray]) -> dict[str, float]:
    """Figures of the filter of one drive, looked into again and again."""
    weight, split = filters["weight"], filters["split"]
    chain, halves = weight[:, :NODES], weight[split][:, NODES:].sum(axis=1)
    best = chain.argmax(axis=1)
    apart = np.abs(filters["mean"][:, :NODES, :2] - filters["mean"][np.arange(len(best)), best][:, None, :2])
    std, mean = np.sqrt(np.diag(filters["overall_covariance"][-1])), filters["overall_mean"][-1]
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
    }


def geometric(values: FloatArray) -> float:
    """Geometric mean of probabilities, 0 of none."""
    return float(np.exp(np.log(np.maximum(values, 1e-12)).mean())) if values.size else 0.0


@pytest.mark.parametrize("name", MOVES)
def test_a_constant_moves_what_it_is_for_in_its_direction_and_by_its_size(name: str) -> None:
    move = MOVES[name]
    usual, changed = (figures(one, move.times if one else 1.0)[move.figure, move.drive] for one in (None, name))
    assert usual > 0.0
    ratio = changed / usual
    assert ratio >= move.ratio if move.ratio > 1.0 else ratio <= move.ratio, f"{move.figure} times {ratio:.3f}"
