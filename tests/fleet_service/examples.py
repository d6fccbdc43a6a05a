"""Observations and batches for tests, and functions that read the resulting belief of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import zenoh
from numpy.typing import NDArray

from fleet_service.fusion import Fusion, Observations
from fleet_service.fusion.likelihoods import make_evidence
from schemas import grid, keys, mugrid, wire
from schemas.numeric import FloatArray
from schemas.wire import Batch, Kind

LATITUDE = 57.7
LONGITUDE = 11.97
CELL = int(grid.cell_of(LATITUDE, LONGITUDE))
REGION = int(grid.region_of(CELL))
TILE = int(grid.tile_of(CELL))
START = 1_700_000_000 * 10**9  # [ns] time of the first observation
SECOND = 10**9
STD = 0.06  # standard deviation of a good measurement of mu
Numbers: TypeAlias = Sequence[float] | NDArray[np.floating[Any]] | NDArray[np.integer[Any]]


def value(mu: Numbers, std: float = STD) -> FloatArray:
    """Return log-likelihoods (n, 32) of visits (passages of a cell). Each visit measured a friction
    of `mu` (n,) with the standard deviation `std`.
    """
    return np.asarray(-0.5 * np.square((mugrid.CENTRES - np.asarray(mu, float)[:, None]) / std))


def at_least(used: Numbers) -> FloatArray:
    """Return log-likelihoods (n, 32) of visits (passages of a cell). Each visit used a grip of
    `used`, which proves only that the friction is at least as large.
    """
    return np.where(np.asarray(used, float)[:, None] > mugrid.CENTRES, -8.0, 0.0)


def observations(
    seconds: Numbers,
    vehicles: Numbers,
    log_likelihood: FloatArray,
    cell: int | Numbers = CELL,
    second: int = -1,
) -> Observations:
    """Return observations of visits (n,) to `cell`, at the times START + `seconds`. The sequence
    numbers rise in the given order.
    """
    n = len(seconds)
    whole = np.zeros(n, np.int64)
    time = START + (np.asarray(seconds, float) * SECOND).astype(np.int64)
    vehicle = np.asarray(vehicles, np.int64)
    return Observations(
        time=time,
        cell=whole + np.asarray(cell, np.int64),
        sector=np.zeros(n, np.int8),
        second=np.full(n, second, np.int8),
        vehicle=vehicle,
        boot=vehicle * 7 + 1,
        region=whole + REGION,
        sequence=np.arange(n),
        evidence=mugrid.encode_log_likelihood(log_likelihood),
        reported=np.full((n, 3), np.nan, np.float32),
        used=np.full(n, 0.9, np.float32),
        manoeuvre=np.full(n, -1, np.int8),
        limited=np.zeros(n, np.int8),
        share=np.ones(n, np.float32),
    )


def posterior_evidence(mu: float, lower: float, upper: float, used: float) -> FloatArray:
    """Return the log-likelihood (32,) of friction that the service computes for a report that
    contains a friction interval but no likelihood.
    """
    names = ("mu", "mu_lower", "mu_upper", "mu_utilised")
    columns: dict[str, NDArray[Any]] = dict(
        zip(names, (np.array([v]) for v in (mu, lower, upper, used)), strict=True)
    )
    columns["log_likelihood"] = np.zeros((1, mugrid.BINS), np.uint8)
    return np.asarray(
        mugrid.decode_log_likelihood(make_evidence(columns, np.array([False])).steps)[0]
    )


def belief(fusion: Fusion, cell: int = CELL, sector: int = 0, now: int | None = None) -> FloatArray:
    """Return the belief of a `Fusion` about one cell (32 probabilities of μ), at the time of its
    last observation, or at the time `now`.
    """
    slot = fusion.slots_of(np.array([cell]), np.array([sector]))
    assert slot[0] >= 0, "nobody was there"
    return np.asarray(
        fusion.beliefs(slot, int(fusion.live.time[slot[0]]) if now is None else now)[0]
    )


def interval(p: FloatArray) -> tuple[float, float]:
    """Return the 5 % and 95 % quantiles of a belief `p` (32,)."""
    return float(mugrid.quantiles(p, 0.05)), float(mugrid.quantiles(p, 0.95))


def slippery(p: FloatArray) -> float:
    """Return P(μ < 0.4) of a belief `p` (32,) about friction."""
    return float(p @ mugrid.SLIPPERY_SHARE)


def batch(
    vehicle: str,
    seq: int,
    now: int,
    mu: Sequence[float],
    /,
    *,
    with_likelihood: bool = True,
    used: float | None = None,
    **changed: object,
) -> Batch:
    """Return a batch of observations of one cell, with the friction values `mu`. The observations
    are one second apart and end at `now` [ns]; `changed` replaces columns.

    Without `used` the vehicle used all of the grip, so that the observations are measurements. If
    `with_likelihood` is False, the batch contains no log-likelihoods.
    """
    n = len(mu)
    leave = now - np.arange(n)[::-1] * SECOND
    columns: dict[str, NDArray[Any]] = {
        "enter_time": leave - SECOND,
        "leave_time": leave,
        "latitude": np.full(n, LATITUDE),
        "longitude": np.full(n, LONGITUDE),
        "cell": np.full(n, CELL),
        "sector": np.zeros(n, np.int8),
        "yaw": np.zeros(n, np.float32),
        "position_std": np.ones(n, np.float32),
        "speed": np.full(n, 15.0, np.float32),
        "mu": np.array(mu, np.float32),
        "mu_lower": np.array(mu, np.float32) - 0.1,
        "mu_upper": np.array(mu, np.float32) + 0.1,
        "mu_utilised": np.array(mu) if used is None else np.full(n, used),
    }
    if with_likelihood:
        columns["log_likelihood"] = mugrid.encode_log_likelihood(value(mu))
    columns.update({name: np.asarray(column) for name, column in changed.items()})
    columns = {
        name: column.astype(wire.column_types(Kind.OBSERVATION)[name])
        for name, column in columns.items()
    }
    boot = 1 + sum(vehicle.encode())
    return Batch(Kind.OBSERVATION, vehicle, boot, REGION, seq, 1, columns, "ckf")


def key(vehicle: str) -> str:
    """Return the Zenoh key for observations of a vehicle in the region of the examples."""
    return keys.observation_key(REGION, vehicle)


def send(session: zenoh.Session, sent: Batch, place: str | None = None) -> None:
    """Publish a batch on the key of its vehicle, or on the key `place`. The call waits for a busy
    link, because by default Zenoh would drop the message after a millisecond.
    """
    session.put(
        place or key(sent.vehicle),
        wire.encode(sent),
        encoding=wire.ENCODING[sent.kind],
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
