"""Construction of the records that an agent publishes, from its estimates: one observation per
visit (passage of a map cell), and the state of the vehicle (position, motion, friction) at a fixed
rate.

Samples arrive in blocks (arrays of consecutive samples of all vehicles). First, `cell_tracker`
marks the samples at which visits end. Then the estimator bank (estimators of all vehicles)
processes the block with these marks. Then `build_records` makes the records. Visits that have not
ended are kept in an `OpenVisits` for the next block. Therefore records and their order do not
depend on how the samples are divided into blocks. The module is pure (no I/O).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_agent.estimators.friction_mixture.report.visit_parts import EXCLUDED_NATS
from edge_agent.observe.cell_tracker import NOWHERE, Located
from edge_agent.observe.visit_likelihood import encode_likelihoods
from schemas import mugrid
from schemas.config import AgentConfig
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import RecordArray, Records, records
from schemas.signals import CONTEXT, FLAGS, C, S
from schemas.thresholds import EXCITED_SHARE, GRAVITY, NS, UNKNOWN, UTILISED_WINDOW_S
from schemas.wire import Columns, Kind, column_types

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates

# [1] share of a visit's samples in which a flag must be known to be reported as not active
KNOWN_SHARE: Final = 0.5
WINDOW_NS: Final = int(UTILISED_WINDOW_S * NS)
# Upper limit of the grip that a wheel may have used, computed from the accelerations over g:
WHEEL_SHARE: Final = 1.3  # [1] factor, because load moves between the wheels
# [1] further factor on driving acceleration, because one axle, with about half the load or more,
# may drive the whole car
DRIVEN_SHARE: Final = 1.5
FELT_STD: Final = 0.03  # [1] error of acceleration over g
# [s] smoothing of the accelerometers, because their largest unsmoothed reading would be noise
FELT_S: Final = 0.06
# [m] The accelerations count for a cell within this distance after a fix in it, once the vehicle
# has driven at least the position error in it. Without these two conditions, a sixth of the visits
# to ice next to dry road reported grip that was used on the dry road.
NEAR_FIX_M: Final = 3.0


class RecordBlock(NamedTuple):
    """Records of one kind, ready for publication: observations (one per visited map cell) or states
    (position, motion and friction at a fixed rate). `columns` are the columns of the message (n,
    …). `vehicle` is the index of each record's vehicle (n,). `urgent` is True for records that must
    be sent immediately (n,).
    """

    kind: Kind
    columns: Columns
    vehicle: IntArray
    urgent: BoolArray


class Visit:
    """One visit that has begun or has ended, as an array record."""

    sample: int  # index in the block of the sample at which the visit ended
    vehicle: int
    enter_time: int  # [ns]
    leave_time: int  # [ns] time of the last sample
    samples: int
    cell: int  # NOWHERE if there is no visit
    sector: int
    health: int  # union of the health flags of all samples
    speed_sum: float  # [m/s] sum over the samples
    # [1] largest grip used in the visit's last part; during its first second the latest value
    mu_utilised: float
    # [1] upper limit of the grip used, from the accelerometers in this cell alone
    measured_grip: float
    ax: float  # [m/s²] smoothed, also over earlier visits
    ay: float
    travelled: float  # [m] driven in the visit
    from_fix: float  # [m] driven since the last fix in the cell; infinite after a fix outside
    part_time: int  # [ns] beginning of the visit's last part
    parts: int  # number of earlier parts
    # Largest log-likelihood of each friction in the earlier parts, because any part may apply
    earlier: Annotated[FloatArray, mugrid.BINS]
    earlier_used: float  # [1] smallest grip used of the earlier parts
    known: Annotated[FloatArray, len(CONTEXT)]  # number of samples with each context signal
    # Sum of each context signal over these samples; for a flag, the number of samples with 1
    context_sum: Annotated[FloatArray, len(CONTEXT)]
    # [m²/s⁴] sums of squared accelerations, forward, backward, to the left and to the right
    driving: float
    braking: float
    left: float
    right: float
    mu: float  # at the last sample, like its bounds
    mu_lower: float
    mu_upper: float
    latitude: float  # [deg] last fix in the cell
    longitude: float
    yaw: float  # [rad]


class Sample:
    """Estimates for one vehicle at one sample, with the measured accelerations, as an array record
    for compiled code.
    """

    health: int
    speed: float  # [m/s]
    mu_utilised: float
    ax: float  # [m/s²] measured; NaN if missing
    ay: float
    mu: float
    mu_lower: float
    mu_upper: float


@dataclass(frozen=True)
class OpenVisits:
    """Open visits of all vehicles as records (N,), and `slot` (N,), the index of the time slot
    (reporting interval) of each vehicle's last sample.
    """

    visits: RecordArray
    slot: IntArray

    @staticmethod
    def before_any(vehicles: int) -> OpenVisits:
        """Return the initial records (N,) for N vehicles that have not begun a visit."""
        visits = records(Visit, vehicles)
        visits["cell"] = NOWHERE
        return OpenVisits(visits, np.full(vehicles, np.iinfo(np.int64).min))


class BlockReadings(NamedTuple):
    """Measurements of a block of samples for the observations; each array may be missing.

    Without `signals` (T, N, channels), observations do not contain the direction in which grip was
    used. Without `context` (T, N, len(CONTEXT)), they contain no controller flags, no air
    temperature and no wiper state.
    """

    signals: FloatArray | None = None
    context: FloatArray | None = None


NO_READINGS: Final = BlockReadings()


def build_records(
    before: OpenVisits,
    time: IntArray,
    located: Located,
    estimates: Estimates,
    config: AgentConfig,
    readings: BlockReadings = NO_READINGS,
) -> tuple[OpenVisits, RecordBlock, RecordBlock]:
    """Build the records of a block of samples with times (T, N) [ns UTC]. `before` has the visits
    that were open before the block.

    Return the visits open after the block, the observations of ended visits, and the vehicles'
    states.
    """
    after = OpenVisits(before.visits.copy(), before.slot.copy())
    ended = records(Visit, int(np.count_nonzero(located.closes)))
    notes = _sample_notes(estimates, readings.context, config.position_std)
    samples = _visit_samples(estimates, readings.signals)
    count = _advance_visits(time, located, samples, notes, after.visits, ended)
    ended = ended[:count]
    return (
        after,
        _build_observations(ended, estimates.evidence, config),
        _build_states(after, time, located, estimates, config),
    )


class SampleNotes(NamedTuple):
    """Additional data per sample for the visits.

    The friction may change k times within visits of the block. Then `likelihoods` (k, 32) has one
    row per change: the log-likelihood of friction from the part of the visit before the change.
    `row` (T, N) links samples to these rows: it is the row's index at the sample of a change, and
    -1 at all other samples.

    `context` (T, N, len(CONTEXT)) contains controller flags, air temperature and wiper; empty if
    unknown. `position_std` is the standard deviation of the position [m].
    """

    row: IntArray
    likelihoods: FloatArray
    context: FloatArray
    position_std: float


def _sample_notes(
    estimates: Estimates, context: FloatArray | None, position_std: float
) -> SampleNotes:
    signals = np.zeros((0, 0, len(CONTEXT))) if context is None else np.ascontiguousarray(context)
    row = np.full(estimates.mu.shape, -1)
    if estimates.jumps is None or estimates.evidence is None:
        return SampleNotes(row, np.zeros((0, mugrid.BINS)), signals, position_std)
    likelihoods = estimates.evidence[estimates.jumps]
    row[estimates.jumps] = np.arange(len(likelihoods))
    return SampleNotes(row, likelihoods, signals, position_std)


def _visit_samples(estimates: Estimates, signals: FloatArray | None) -> RecordArray:
    """Return one record with the estimates and the accelerometer readings for each of T samples of
    N vehicles, (T, N). Visits are computed from these records.
    """
    samples = records(Sample, *estimates.mu.shape)
    samples["speed"] = np.hypot(estimates.vx, estimates.vy)
    for name in ("health", "mu_utilised", "mu", "mu_lower", "mu_upper"):
        samples[name] = getattr(estimates, name)
    for name, channel in (("ax", S.AX), ("ay", S.AY)):
        samples[name] = np.nan if signals is None else signals[..., channel]
    return samples


@compiled
def _advance_visits(
    time: IntArray,
    located: Located,
    samples: Records[Sample],
    notes: SampleNotes,
    visits: Records[Visit],
    ended: Records[Visit],
) -> int:
    """Add each sample to its vehicle's visit. Write a visit to `ended` at the sample that ends it.
    Return the number of ended visits.
    """
    count = 0
    for k in range(time.shape[0]):
        for n in range(time.shape[1]):
            visit = visits[n]
            if located.closes[k, n]:
                if visit.cell != NOWHERE:
                    visit.sample = k
                    visit.vehicle = n
                    ended[count] = visit
                    count += 1
                _begin_visit(visit, time[k, n], located.cell[k, n], located.sector[k, n])
            if visit.cell != NOWHERE:
                if located.inside[k, n]:
                    visit.from_fix = 0.0
                elif located.outside[k, n]:
                    visit.from_fix = np.inf
                _add_sample(visit, time[k, n], samples[k, n], notes.position_std)
                if k < len(notes.context):
                    _add_context(visit, notes.context[k, n])
                if located.inside[k, n]:
                    visit.latitude = located.latitude[k, n]
                    visit.longitude = located.longitude[k, n]
                    visit.yaw = located.yaw[k, n]
                if notes.row[k, n] >= 0:
                    _begin_part(visit, time[k, n], notes.likelihoods[notes.row[k, n]])
    return count


@compiled
def _begin_visit(visit: Visit, time: int, cell: int, sector: int) -> None:
    """Start a new visit in the record `visit`. It has no samples yet."""
    visit.enter_time = time
    visit.cell = cell
    visit.sector = sector
    visit.samples = 0
    visit.health = 0
    visit.driving = 0.0
    visit.braking = 0.0
    visit.left = 0.0
    visit.right = 0.0
    visit.measured_grip = np.inf
    visit.speed_sum = 0.0
    visit.latitude = 0.0
    visit.longitude = 0.0
    visit.yaw = 0.0
    visit.travelled = 0.0
    visit.from_fix = 0.0
    visit.part_time = time
    visit.parts = 0
    visit.earlier_used = np.inf
    for i in range(len(visit.known)):
        visit.known[i] = 0.0
        visit.context_sum[i] = 0.0


@compiled
def _begin_part(visit: Visit, time: int, log_likelihood: FloatArray) -> None:
    """Begin a new part of a visit, because the friction changed within the cell.

    `log_likelihood` is the log-likelihood of friction from the part that ends. The grip used
    in that part cannot exceed the largest friction that `log_likelihood` leaves possible.
    Therefore the stored grip is limited to this friction.
    """
    most = mugrid.UPPER
    for i in range(mugrid.BINS - 1, -1, -1):
        if log_likelihood[i] >= EXCLUDED_NATS:
            most = mugrid.CENTRES[i]
            break
    visit.earlier_used = min(visit.earlier_used, visit.mu_utilised, visit.measured_grip, most)
    for i in range(mugrid.BINS):
        visit.earlier[i] = (
            log_likelihood[i] if visit.parts == 0 else max(visit.earlier[i], log_likelihood[i])
        )
    visit.parts += 1
    visit.part_time = time
    visit.mu_utilised = 0.0
    visit.measured_grip = np.inf


@compiled
def _add_sample(visit: Visit, time: int, sample: Sample, position_std: float) -> None:
    """Add one sample at `time` [ns UTC] to a visit. `position_std` is the standard deviation of the
    vehicle's position [m].
    """
    _update_measured_grip(visit, (time - visit.leave_time) / NS, sample, position_std)
    visit.leave_time = time
    visit.samples += 1
    visit.health |= sample.health
    visit.speed_sum += sample.speed
    if np.isfinite(sample.ax + sample.ay):
        visit.driving += max(sample.ax, 0.0) ** 2
        visit.braking += max(-sample.ax, 0.0) ** 2
        visit.left += max(sample.ay, 0.0) ** 2
        visit.right += max(-sample.ay, 0.0) ** 2
    grown = visit.leave_time - visit.part_time > WINDOW_NS
    visit.mu_utilised = max(visit.mu_utilised, sample.mu_utilised) if grown else sample.mu_utilised
    visit.mu = sample.mu
    visit.mu_lower = sample.mu_lower
    visit.mu_upper = sample.mu_upper


@compiled
def _add_context(visit: Visit, context: FloatArray) -> None:
    """Add one sample of the context signals (controller flags, air temperature, wiper),
    (len(CONTEXT),), to a visit. Signals that are NaN are skipped.
    """
    for i in range(len(context)):
        if np.isfinite(context[i]):
            visit.known[i] += 1.0
            visit.context_sum[i] += context[i]


@compiled
def _update_measured_grip(visit: Visit, dt: float, sample: Sample, position_std: float) -> None:
    """Update `visit.measured_grip`, the upper limit of the grip used in a visit according to the
    accelerometers. `dt` [s] is the time since the previous sample.

    The limit is infinite (no limit) in a new visit until the first accelerometer reading.
    """
    if np.isfinite(sample.ax + sample.ay):
        share = 1.0 - np.exp(-dt / FELT_S)
        visit.ax += share * (sample.ax - visit.ax)
        visit.ay += share * (sample.ay - visit.ay)
        measured_grip = 0.0 if np.isinf(visit.measured_grip) else visit.measured_grip
        if visit.travelled >= position_std and visit.from_fix <= NEAR_FIX_M:
            along = (DRIVEN_SHARE if visit.ax > 0.0 else 1.0) * visit.ax
            measured_grip = max(
                measured_grip, WHEEL_SHARE * np.hypot(along, visit.ay) / GRAVITY + FELT_STD
            )
        visit.measured_grip = measured_grip
    if visit.samples > 0:  # the way to the first sample, perhaps a long gap, lies before the visit
        visit.travelled += sample.speed * dt
        visit.from_fix += sample.speed * dt


def _cast_columns(kind: Kind, columns: dict[str, NDArray[np.generic]]) -> Columns:
    return {
        name: columns[name].astype(dtype, copy=False) for name, dtype in column_types(kind).items()
    }


def _grip_directions(ended: RecordArray) -> dict[str, FloatArray]:
    """Return the grip used in longitudinal and in lateral direction of the vehicle, (n,) each, for
    n ended visits. Both are NaN without acceleration readings.

    The square of the total grip used is divided between the two directions in proportion to their
    summed squared accelerations. A visit may contain both braking and acceleration, or left and
    right turns. The longitudinal grip is positive if the sum of squares is larger for acceleration,
    and negative if it is larger for braking. The lateral grip is positive if the sum of squares is
    larger for left turns, and negative if it is larger for right turns.
    """
    along = ended["driving"] + ended["braking"]
    across = ended["left"] + ended["right"]
    whole = np.where(along + across > 0.0, along + across, np.nan)
    used = _grip_used(ended)
    return {
        "used_longitudinal": used
        * np.sqrt(along / whole)
        * np.where(ended["driving"] >= ended["braking"], 1.0, -1.0),
        "used_lateral": used
        * np.sqrt(across / whole)
        * np.where(ended["left"] >= ended["right"], 1.0, -1.0),
    }


def _grip_used(ended: RecordArray) -> FloatArray:
    """Return the grip used (force over load) in n visits, (n,) [1].

    The grip used is the largest `mu_utilised` (grip used in the last second), limited to the grip
    that the accelerometers show in this cell. The limit is needed because that second may include
    part of the previous cell.

    If the friction changed within a visit, the grip used is computed separately for the parts
    before and after each change. The result is the smallest of these values, so that the friction
    of every part is at least the result.
    """
    last = np.minimum(ended["mu_utilised"], ended["measured_grip"])
    return np.asarray(np.minimum(last, ended["earlier_used"]))


def _build_observations(
    ended: RecordArray, evidence: FloatArray | None, config: AgentConfig
) -> RecordBlock:
    n = len(ended)
    mu = ended["mu"]
    upper = ended["mu_upper"]
    used = _grip_used(ended)
    carried = (
        "enter_time",
        "leave_time",
        "cell",
        "sector",
        "latitude",
        "longitude",
        "yaw",
        "health",
    )
    columns: dict[str, NDArray[np.generic]] = {
        **{name: ended[name] for name in (*carried, "mu", "mu_lower", "mu_upper")},
        "mu_utilised": used,
        "position_std": np.full(n, config.position_std),
        "yaw_std": np.full(n, config.yaw_std),
        "speed": ended["speed_sum"] / np.maximum(ended["samples"], 1),
        "log_likelihood": encode_likelihoods(ended, evidence, used),
        "tyre_season": np.full(n, config.tyre_season),
        **_context_columns(ended),
        **_grip_directions(ended),
    }
    limit = config.slippery_mu
    urgent = (upper < limit) | ((mu < limit) & (used >= EXCITED_SHARE * mu))
    return RecordBlock(
        Kind.OBSERVATION, _cast_columns(Kind.OBSERVATION, columns), ended["vehicle"].copy(), urgent
    )


def _context_columns(ended: RecordArray) -> dict[str, NDArray[np.generic]]:
    """Return the observation columns about controllers and surroundings for n visits, (n,) each.

    A controller flag is 1 if it was on at any sample. It is 0 if it was never on and was known at
    KNOWN_SHARE of the samples. Otherwise it is unknown.
    """
    known = ended["known"]
    context_sum = ended["context_sum"]
    enough = known[:, : len(FLAGS)] >= KNOWN_SHARE * np.maximum(ended["samples"], 1)[:, None]
    flags = np.where(context_sum[:, : len(FLAGS)] > 0.0, 1, np.where(enough, 0, UNKNOWN))
    mean = np.where(known > 0.0, context_sum / np.maximum(known, 1.0), np.nan)
    return {
        **{name: flags[:, index] for index, name in enumerate(FLAGS)},
        "air_temperature": mean[:, C.AIR_TEMPERATURE],
        "wiper": mean[:, C.WIPER],
    }


def _build_states(
    after: OpenVisits, time: IntArray, located: Located, estimates: Estimates, config: AgentConfig
) -> RecordBlock:
    """Return the states to publish: for each vehicle, the first sample of each time slot, if its
    position is known.

    `after` contains the vehicles' data for the next block of samples. On entry, `after.slot` is the
    index of each vehicle's last time slot before this block. The function updates it.
    """
    slot = np.floor_divide(time, round(NS / config.state_rate_hz))
    earlier = np.vstack([after.slot[None], slot[:-1]])
    after.slot[:] = slot[-1] if len(slot) else after.slot
    k, n = np.nonzero((slot > earlier) & np.isfinite(located.latitude))
    columns: dict[str, NDArray[np.generic]] = {
        "time": time[k, n],
        "latitude": located.latitude[k, n],
        "longitude": located.longitude[k, n],
        "position_std": np.full(len(k), config.position_std),
        "yaw": located.yaw[k, n],
        **{
            name: getattr(estimates, name)[k, n]
            for name in (
                "vx",
                "vy",
                "yaw_rate",
                "sideslip",
                "mu",
                "mu_lower",
                "mu_upper",
                "health",
                "p_slippery",
            )
        },
    }
    return RecordBlock(
        Kind.STATE,
        _cast_columns(Kind.STATE, columns),
        n.astype(np.int64),
        np.zeros(len(k), dtype=np.bool_),
    )
