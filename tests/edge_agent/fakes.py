"""Synthetic positions, estimates and logs for tests of input and output, which run no filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.observe.cell_tracker import Located, locate_vehicles, new_tracks
from edge_agent.observe.observation_builder import OpenVisits, RecordBlock, build_records
from schemas import mugrid
from schemas.config import AgentConfig
from schemas.numeric import FloatArray
from schemas.runtime.records import RecordArray
from schemas.signals import CHANNELS, S
from schemas.thresholds import SLIPPERY_MU

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates

LATITUDE = 57.70
LONGITUDE = 11.97
Lengths: TypeAlias = NDArray[np.floating[Any]]
METRE = 1.0 / 111_320.0  # [deg] latitude per metre
START_NS = 1_767_225_600_000_000_000  # 2026-01-01


@dataclass(frozen=True)
class MadeUp:
    """Made-up output of an estimator bank (filters of N vehicles). A test sets its values; they are
    not computed from signals.
    """

    vx: FloatArray
    vy: FloatArray
    yaw_rate: FloatArray
    sideslip: FloatArray
    mu: FloatArray
    mu_lower: FloatArray
    mu_upper: FloatArray
    p_slippery: FloatArray
    mu_utilised: FloatArray
    health: NDArray[np.int32]
    evidence: FloatArray | None
    jumps: NDArray[np.bool_] | None = None

    def part(self, rows: slice) -> MadeUp:
        """Return a copy of this output with only the samples of the slice `rows`."""
        cut = {f.name: v[rows] for f in fields(self) if (v := getattr(self, f.name)) is not None}
        return replace(self, **cut)


def estimates(
    samples: int, vehicles: int, seed: int = 0, mu: float | None = None, used: float = 0.1
) -> MadeUp:
    """Return made-up estimates of N = `vehicles` vehicles. The friction of each sample is `mu`, or
    random if `mu` is None. The friction interval is this value ± 0.05.

    Every sample has a random log-likelihood of friction. `used` is the friction that the tyres use.
    """
    rng = np.random.default_rng(seed)
    shape = (samples, vehicles)
    middle = rng.uniform(0.1, 1.0, shape) if mu is None else np.full(shape, mu)
    health = rng.integers(0, 4, shape).astype(np.int32)
    evidence = -rng.exponential(2.0, (*shape, mugrid.BINS))
    vx, vy, yaw_rate, sideslip = (rng.normal(10.0, 1.0, shape) for _ in range(4))
    lower = middle - 0.05
    upper = middle + 0.05
    slippery = (middle < SLIPPERY_MU).astype(float)
    gripped = np.full(shape, used)
    return MadeUp(
        vx, vy, yaw_rate, sideslip, middle, lower, upper, slippery, gripped, health, evidence
    )


def ground(
    east: Lengths, north: Lengths, yaw: Lengths, *, rate_hz: float = 10.0, fix_every: int = 1
) -> Block:
    """Return a block (signals of some samples) of vehicles at positions (east, north) [m] with
    headings `yaw` [rad], all of shape (T, N). Every `fix_every`-th sample has a position.
    """
    shape = east.shape
    t = np.repeat(np.arange(shape[0])[:, None] / rate_hz, shape[1], axis=1)
    signals = np.full((*shape, len(CHANNELS)), np.nan)
    signals[..., S.LATITUDE] = LATITUDE + north * METRE
    signals[..., S.LONGITUDE] = LONGITUDE + east * METRE / np.cos(np.radians(LATITUDE))
    signals[..., S.YAW] = yaw
    hidden = np.arange(shape[0]) % fix_every != 0
    signals[hidden, :, S.LATITUDE :] = np.nan
    return Block(t, to_utc_ns(t, START_NS), signals)


def wanderers(samples: int, vehicles: int, seed: int = 0) -> Block:
    """Return a block (signals of some samples) of vehicles that turn at random. Now and then a
    vehicle receives no position; every third vehicle has no yaw signal.
    """
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.0, 0.1, (samples, vehicles)), axis=0)
    step = rng.uniform(0.0, 3.0, (samples, vehicles))
    block = ground(
        np.cumsum(step * np.cos(yaw), axis=0), np.cumsum(step * np.sin(yaw), axis=0), yaw
    )
    lost = rng.random((samples, vehicles)) < 0.3
    lost[samples // 2 : samples // 2 + 15, 0] = True
    block.signals[lost, S.LATITUDE : S.LONGITUDE + 1] = np.nan
    block.signals[:, ::3, S.YAW] = np.nan
    return block


@dataclass
class Watch:
    """State of several simulated vehicles, kept from one block of samples to the next.

    Attributes:
        tracks: state of the cell tracking: the cell of each vehicle.
        open: for each vehicle its present visit. A visit is the passage of a map cell; it ends when
            the vehicle leaves the cell.
        config: settings of the agent.
    """

    tracks: RecordArray
    open: OpenVisits
    config: AgentConfig

    @staticmethod
    def of(vehicles: int, config: AgentConfig | None = None) -> Watch:
        """Return the state of vehicles before the first sample: no cell is known, and no visit has
        begun.
        """
        return Watch(new_tracks(vehicles), OpenVisits.before_any(vehicles), config or AgentConfig())

    def step(self, block: Block, output: MadeUp) -> tuple[Located, RecordBlock, RecordBlock]:
        """Process one block of samples. Return the located vehicles, and the observations and
        states that they report.
        """
        self.tracks, located = locate_vehicles(self.tracks, block.t, block.signals)
        reported = cast("Estimates", output)  # `build_records` reads only the fields of MadeUp
        self.open, observations, states = build_records(
            self.open, block.time, located, reported, self.config
        )
        return located, observations, states


def part(block: Block, rows: slice) -> Block:
    """Return a block (signals of some samples) with only those samples that the slice `rows`
    selects.
    """
    return Block(block.t[rows], block.time[rows], block.signals[rows])


def a_log(samples: int) -> dict[str, Any]:
    """Return random columns of a signal log at 100 Hz with every channel. The signals are similar
    to those of a car that coasts straight ahead.
    """
    rng = np.random.default_rng(4)
    columns: dict[str, Any] = {name: rng.normal(0.0, 0.1, samples) for name in CHANNELS}
    columns |= {
        name: rng.normal(30.0, 0.1, samples) for name in CHANNELS if name.startswith("omega")
    }
    columns |= {"latitude": np.full(samples, LATITUDE), "longitude": np.full(samples, LONGITUDE)}
    return {"t": np.arange(samples) / 100.0} | columns


def make_log_writer(**changes: object) -> Callable[[Path], object]:
    """Return a function that writes a signal log of five samples. `changes` replaces columns of the
    log; a column whose new value is None is left out.
    """

    def write(path: Path) -> None:
        columns = {
            name: column for name, column in (a_log(5) | changes).items() if column is not None
        }
        pq.write_table(pa.table(columns), path)

    return write


_LOST = np.full(5, np.nan)
# Fault of a log: a function that writes such a log, and the expected error message.
BAD_LOGS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no such file": (lambda path: None, "^log: .* does not exist; give"),
    "empty file": (
        lambda path: path.write_bytes(b""),
        "^log: .* is not a Parquet file .*; (copy|convert) it",
    ),
    "not Parquet": (lambda path: path.write_text("t,ax\n0,1\n"), "^log: .* is not a Parquet file"),
    "no rows": (lambda path: pq.write_table(pa.table(a_log(0)), path), "^log: .* has no rows; "),
    "no time": (
        make_log_writer(t=None),
        r"^t: the log has neither t nor timestamp \(.*log.*\); add",
    ),
    "no ax": (make_log_writer(ax=None), r"^ax: the log has no such column \(.*log.*\); add"),
    "no omega_rr": (
        make_log_writer(omega_rr=None),
        r"^omega_rr: the log has no such column \(.*log.*\); add",
    ),
    "no steering": (
        make_log_writer(delta_fl=None, delta_fr=None),
        r"^delta_fl: .* no such column \(.*log.*\); add it or delta_fr",
    ),
    "yaw_rate all NaN": (
        make_log_writer(yaw_rate=_LOST),
        r"^yaw_rate: has no reading in any row \(.*log.*\); record",
    ),
    "omega_fl all null": (
        make_log_writer(omega_fl=pa.nulls(5, pa.float64())),
        r"^omega_fl: has no reading in any row \(.*log.*\); record",
    ),
    "steering all NaN": (
        make_log_writer(delta_fl=_LOST, delta_fr=_LOST),
        r"^delta_fl: has no reading in any row \(.*log.*\); record",
    ),
    "nanoseconds as float": (
        make_log_writer(t=None, timestamp=1.7e18 + 1e7 * np.arange(5)),
        r"^timestamp: is beyond the year 2262 \(.*log.*\); write ns as int64",
    ),
    "time goes back": (
        make_log_writer(t=np.array([0.0, 0.01, 0.02, 0.015, 0.03])),
        r"^t: goes back at row 3 \(.*log.*\); sort the log",
    ),
    "time missing": (
        make_log_writer(t=np.array([0.0, np.nan, 0.02, 0.03, 0.04])),
        r"^t: row 1 has no time \(.*log.*\); give",
    ),
    "text for a number": (
        make_log_writer(ay=["a"] * 5),
        r"^ay: is string, not a number \(.*log.*\); write",
    ),
    "text for a time": (
        make_log_writer(t=None, timestamp=["a"] * 5),
        r"^timestamp: is string, not a time \(.*log.*\); write",
    ),
}
