"""Drives through random towns for the detection evaluation: true values, estimates, visits
(passages of a map cell) with their likelihoods, and the slip flag (ordinary ABS logic).

The cars are those of `SimulatedFleet`; the agent's own pipeline (`observe`) computes visits and
likelihoods. The drives are computed in chunks of time, so that memory suffices for sixteen cars
that drive fifteen minutes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.estimators import Estimates, EstimatorBank
from edge_agent.lab.evaluation.slip_flag import friction_flagged
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.observe.cell_tracker import locate_vehicles, new_tracks
from edge_agent.observe.observation_builder import BlockReadings, OpenVisits, build_records
from schemas import mugrid
from schemas.config import AgentConfig
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import NS, SLIPPERY_MU, SURFACES
from schemas.vehicle import Vehicle

RATE_HZ: Final = 100.0
CHUNK_S: Final = 20.0
BELIEF_SAMPLES: Final = 5  # samples between two readings of the posterior
STANDING_M_S: Final = 1.0
APPEARED: Final = 0.1  # minimum decrease of the mean friction when a patch appears

BankMaker: TypeAlias = Callable[[list[Vehicle]], EstimatorBank]
Samples: TypeAlias = NDArray[np.float32]


@dataclass(frozen=True)
class DetectionVisits:
    """V published visits: index of the vehicle (V,), index of the first and last sample (V,),
    log-likelihood ln L on the friction grid (V, 32).
    """

    vehicle: IntArray
    first: IntArray
    last: IntArray
    likelihood: FloatArray


@dataclass(frozen=True)
class DetectionDrive:
    """True values and estimates of the N cars of one town at T samples. Arrays have the shape (T,
    N), or (T, N, 4) per wheel.

    Attributes:
        speed, ax, ay: true motion [m/s, m/s^2].
        mu: true mean friction of the four wheels.
        mu_wheel, theta, used: true friction, normalised slip and used share of the grip, per wheel.
        lower, median, upper, slippery, health: estimates: the 5, 50 and 95 % quantiles of friction,
        P(mu < SLIPPERY_MU), and the health flags.
        favoured: ln of the largest belief below SLIPPERY_MU over the largest above; NaN where the
            estimator has no belief.
        flagged: friction that the slip flag (ordinary ABS logic) reports; infinite while the flag
            is not set.
        controlled: True while ABS, traction control or ESC acts; always False for cars without
            winter equipment.
        stood: True where ice or snow appeared under the standing car, until the car leaves it.
        visits: the published visits.
    """

    speed: Samples
    ax: Samples
    ay: Samples
    mu: Samples
    mu_wheel: Samples
    theta: Samples
    used: Samples
    lower: Samples
    median: Samples
    upper: Samples
    slippery: Samples
    health: NDArray[np.int32]
    favoured: Samples
    flagged: Samples
    controlled: BoolArray
    stood: BoolArray
    visits: DetectionVisits


def drive_fleet(fleet: SimulatedFleet, bank: EstimatorBank, seconds: float) -> DetectionDrive:
    """Simulate a fleet for `seconds` [s], estimate motion and friction from the cars' signals with
    the estimator bank (one filter per car), and compute the cars' visits.
    """
    vehicles = fleet.vehicles
    config = AgentConfig()
    tracks = new_tracks(len(vehicles))
    open_visits = OpenVisits.before_any(len(vehicles))
    parts: list[dict[str, FloatArray]] = []
    visits: list[DetectionVisits] = []
    signals_of: list[FloatArray] = []
    left = round(seconds * RATE_HZ)
    while left > 0:
        steps = min(left, round(CHUNK_S * RATE_HZ))
        left -= steps
        t, signals = fleet.step(steps)
        tracks, located = locate_vehicles(tracks, t, signals)
        estimates, favoured = _estimate_chunk(bank, t, signals, located.closes)
        time = np.rint(t * NS).astype(np.int64)
        open_visits, observations, _ = build_records(
            open_visits, time, located, estimates, config, BlockReadings(signals)
        )
        columns = observations.columns
        visits.append(
            DetectionVisits(
                observations.vehicle,
                np.rint(columns["enter_time"] / NS * RATE_HZ).astype(np.int64),
                np.rint(columns["leave_time"] / NS * RATE_HZ).astype(np.int64),
                mugrid.decode_log_likelihood(_bytes_of(columns["log_likelihood"])),
            )
        )
        parts.append(_samples_of(fleet, estimates, favoured))
        signals_of.append(signals.astype(np.float32))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    signals = np.concatenate(signals_of)
    t = np.repeat(np.arange(len(signals))[:, None] / RATE_HZ, len(vehicles), axis=1)
    flagged = friction_flagged(t, signals.astype(np.float64), vehicles).astype(np.float32)
    health = joined.pop("health").astype(np.int32)
    starts = [patch.start for patch in fleet.scenario.events]
    controlled = joined.pop("controlled").astype(np.bool_)
    values = {name: value.astype(np.float32) for name, value in joined.items()}
    stood = stood_where_it_appeared(values["mu"], values["speed"], starts)
    return DetectionDrive(
        **values,
        health=health,
        flagged=flagged,
        controlled=controlled,
        stood=stood,
        visits=_join_visits(visits),
    )


def stood_where_it_appeared(
    mu: NDArray[np.floating], speed: NDArray[np.floating], starts: Sequence[float]
) -> BoolArray:
    """Return an array (T, N) that is True where a car is still on ice or snow that appeared under
    it while it stood.

    Args:
        mu: true mean friction of the wheels (T, N).
        speed: speed of the cars (T, N) [m/s].
        starts: times [s] at which patches appear.
    """
    out = np.zeros(mu.shape, np.bool_)
    for start in starts:
        now = math.ceil(round(start * RATE_HZ, 6))
        if not 0 < now < len(mu):
            continue
        appears = (mu[now - 1] - mu[now] > APPEARED) & (speed[now] < STANDING_M_S)
        for n in np.flatnonzero(appears & (mu[now] <= SURFACES["snow"][1])):
            grip_returns = np.flatnonzero(mu[now:, n] > SURFACES["snow"][1])
            out[now : now + grip_returns[0] if len(grip_returns) else None, n] = True
    return out


def _estimate_chunk(
    bank: EstimatorBank, t: FloatArray, signals: FloatArray, closes: BoolArray
) -> tuple[Estimates, FloatArray]:
    """Run the estimators on one chunk of the drives: times `t` (T, N) [s], and signals. `closes`
    (T, N) is True where a visit of a map cell ends. Return the estimates, and an array (T, N) that
    states how much the friction belief favours a slippery road [nat]. The array is NaN if the
    estimator has no belief.
    """
    if bank.beliefs() is None:
        return bank.advance(t, signals, closes), np.full(t.shape, np.nan)
    parts = []
    favoured = np.empty(t.shape)
    for first in range(0, len(t), BELIEF_SAMPLES):
        now = slice(first, min(first + BELIEF_SAMPLES, len(t)))
        parts.append(bank.advance(t[now], signals[now], closes[now]))
        beliefs = bank.beliefs()
        favoured[now] = np.nan if beliefs is None else slippery_favoured(beliefs[0])
    values = np.concatenate([part.values for part in parts])
    evidence = [part.evidence for part in parts if part.evidence is not None]
    jumps = [part.jumps for part in parts if part.jumps is not None]
    if not evidence or not jumps:
        return Estimates(values), favoured
    return Estimates(values, np.concatenate(evidence), np.concatenate(jumps)), favoured


def slippery_favoured(log_likelihood: FloatArray) -> FloatArray:
    """Return the evidence for a slippery road [nat]: the largest log-likelihood below SLIPPERY_MU
    minus the largest above it, for log-likelihoods (…, 32) on the friction grid.
    """
    low = mugrid.CENTRES < SLIPPERY_MU
    return np.asarray(
        log_likelihood[..., low].max(axis=-1) - log_likelihood[..., ~low].max(axis=-1)
    )


def _samples_of(
    fleet: SimulatedFleet, estimates: Estimates, favoured: FloatArray
) -> dict[str, FloatArray]:
    true = fleet.truth
    return {
        "speed": true.vx,
        "ax": true.ax,
        "ay": true.ay,
        "mu": true.mu_wheel.mean(axis=-1),
        "mu_wheel": true.mu_wheel,
        "theta": true.theta,
        "used": true.utilisation,
        "lower": estimates.mu_lower,
        "median": estimates.mu,
        "upper": estimates.mu_upper,
        "slippery": estimates.p_slippery,
        "health": estimates.health,
        "favoured": favoured,
        "controlled": true.abs | true.tcs | true.esc,
    }


def _bytes_of(column: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return the encoded likelihoods of V visits, (V, 32) bytes, from the table column of the
    visits' likelihoods. If the estimator computes no likelihood of friction, all bytes are zero,
    which encodes a flat likelihood.
    """
    found = np.asarray(column, dtype=np.uint8)
    return found if found.shape[1] else np.zeros((len(found), mugrid.BINS), np.uint8)


def _join_visits(parts: list[DetectionVisits]) -> DetectionVisits:
    return DetectionVisits(
        np.concatenate([part.vehicle for part in parts]),
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.last for part in parts]),
        np.concatenate([part.likelihood for part in parts]),
    )
