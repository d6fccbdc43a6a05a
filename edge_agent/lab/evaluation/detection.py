"""Detection evaluation: does the estimator find slippery road, how soon, and does it report ice
where there is no ice?

Cars drive in towns with random friction and hills, drawn by seed. There are two kinds of cars:
"rough" cars have large sensor errors, as real cars have (ROUGH_FLEET); "plain" cars have small
sensor errors. "short" drives last 120 s, and "long" drives 900 s, because some faults that stop a
car's reports appear only after a long time. Each result for one kind of cars is computed from the
samples of all towns with such cars.

A visit is the passage of one car through one map cell. The agent computes the likelihood L of each
friction from the measurements of a visit. The grip of a wheel is its largest possible tyre force.

Legend
    slide       a stretch in which the normalised slip θ of some wheel exceeds SLIDING for at least
                SLIDE_S
    on ice      a sample with friction of at most .2, or a visit whose mean friction is at most .2
                and changes by less than MOVES
    excited     a visit during which some wheel uses more than EXCITED_SHARE of its grip
    value       a visit has value if it makes a high friction improbable: ln L at the largest
                friction is at least VALUE_NATS below its maximum
    favoured    a visit favours a slippery road if max ln L(μ < .4) - max ln L(μ >= .4) >=
                FAVOURED_NATS
    pass        a stretch of PASS_S or longer of one car on ice, or on snow. A pass is found if the
                estimator reports P(mu < .4) > CALLED_SHARE at some time during the pass
    settled     a sample on wet or dry road, at least SETTLED_S after the car left snow or ice
    false event a settled stretch with P(mu < .4) > CALLED_SHARE. Stretches with a gap of at most
                EVENT_GAP_S between them are one event. The road is judged by the mean friction of
                the wheels, so one axle may be on ice. `.off_ice` counts only samples without a
                wheel on snow or ice
    false grip  the lower end of the friction interval is more than FALSE_GRIP above the true
                friction
    stood       ice or snow appeared under the car while it stood. Such cases are counted in
                separate figures and in no other figure
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.lab.evaluation.detection_drives import RATE_HZ, DetectionDrive, slippery_favoured
from edge_agent.lab.evaluation.real_world import (
    FALSE_GRIP,
    SETTLED_S,
    interval_score,
    recent_maximum,
)
from edge_agent.lab.evaluation.slide_oracle import visit_evidence
from edge_agent.lab.evaluation.slip_flag import FLAGGED_MU
from schemas.numeric import FloatArray
from schemas.signals import Health
from schemas.thresholds import CALLED_SHARE, EXCITED_SHARE, SLIPPERY_MU, SURFACES

SLIDING: Final = 2.6
SLIDE_S: Final = 0.1
BRIDGED_S: Final = 0.1  # [s] shorter gaps, which anti-lock control causes, do not end a slide
# A slide of at least TOLD_SLIDE_S on friction below TOLD_MU must be reported as slippery, at most
# TOLD_AFTER_S after its end.
TOLD_SLIDE_S: Final = 0.2
TOLD_MU: Final = 0.36
TOLD_AFTER_S: Final = 0.1
AFTER_SLIDE_S: Final = 0.5  # [s] a contradiction this soon after a slide belongs to the slide
VALUE_NATS: Final = 1.0
FAVOURED_NATS: Final = 3.0
MOVES: Final = 0.1
PASS_S: Final = 0.5
EVENT_GAP_S: Final = 1.0
ICE_MU: Final = SURFACES["ice"][1]
SNOW_MU: Final = SURFACES["snow"][1]
ROC_NATS: Final = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0)
ROC_FLAG_MU: Final = (0.25, FLAGGED_MU, 0.45)
ACTIVITIES: Final = ("braking", "driving", "cornering")
KINDS: Final = ("rough", "plain")
LENGTHS: Final = ("short", "long")

Stretches: TypeAlias = list[tuple[int, int]]


@dataclass
class DetectionTally:
    """Sums of the detection evaluation over one or several towns. For each measure, by name, the
    tally holds the sum and count of its values, from which the mean is computed, or a list of
    detection times [s].
    """

    total: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    def add(self, name: str, values: NDArray[np.generic]) -> None:
        """Add an array of values to the measure `name`, whose mean is computed from sum and
        count.
        """
        self.total[name] = self.total.get(name, 0.0) + float(np.sum(values, dtype=np.float64))
        self.count[name] = self.count.get(name, 0) + int(np.size(values))

    def add_case(self, name: str, *, holds: bool) -> None:
        """Count one case for the measure `name`, which is the share of cases with `holds` True."""
        self.add(name, np.array([holds]))

    def merge(self, other: DetectionTally) -> None:
        """Add the sums and detection times of another tally (`other`) to this tally."""
        for name, value in other.total.items():
            self.total[name] = self.total.get(name, 0.0) + value
            self.count[name] = self.count.get(name, 0) + other.count[name]
        for name, times in other.seconds.items():
            self.seconds.setdefault(name, []).extend(times)

    def mean(self, name: str) -> float:
        """Return the mean of all values added under the name `name`; NaN if there are none."""
        return self.total[name] / self.count[name] if self.count.get(name) else float("nan")

    def rate(self, numerator: str, denominator: str) -> float:
        """Return the sum of the measure named `numerator` divided by the sum of the measure named
        `denominator`; NaN if the divisor is zero or missing.
        """
        return (
            self.total.get(numerator, 0.0) / self.total[denominator]
            if self.total.get(denominator)
            else float("nan")
        )

    def quantile(self, name: str, share: float) -> float:
        """Return the quantile `share` (0 to 1) of the detection times [s] stored under the name
        `name`; NaN if there are no times.
        """
        return (
            float(np.quantile(self.seconds[name], share))
            if self.seconds.get(name)
            else float("nan")
        )


def runs_of(on: NDArray[np.bool_]) -> Stretches:
    """Return (first index, last index + 1) of each stretch of samples where the mask `on` (T,) is
    True.
    """
    edge = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edge[::2], edge[1::2], strict=True)]


def bridge_gaps(on: NDArray[np.bool_], seconds: float) -> NDArray[np.bool_]:
    """Return a copy of the mask `on` (T,) in which every gap (stretch of False between True
    samples) of at most `seconds` [s] is filled with True.
    """
    out = on.copy()
    most = round(seconds * RATE_HZ)
    for first, end in runs_of(~on):
        if first > 0 and end < len(on) and end - first <= most:
            out[first:end] = True
    return out


def slides_of(theta: NDArray[np.floating], seconds: float = SLIDE_S) -> Stretches:
    """Return the slides of a car, as pairs (first index, last index + 1): stretches where the
    normalised slip θ (T, 4) of some wheel exceeds SLIDING for at least `seconds` [s].
    """
    some = bridge_gaps(np.asarray((theta > SLIDING).any(axis=1)), BRIDGED_S)
    least = round(seconds * RATE_HZ)
    return [(first, end) for first, end in runs_of(some) if end - first >= least]


def activity_of(drive: DetectionDrive, n: int, first: int, end: int) -> str:
    """Return the cause of a slide of car n, from the car's mean accelerations in the samples from
    `first` to before `end`. The cause is "cornering" if the lateral acceleration is larger than the
    longitudinal one. Otherwise the sign of the longitudinal acceleration decides between "braking"
    and "driving".
    """
    along = float(drive.ax[first:end, n].mean())
    across = float(drive.ay[first:end, n].mean())
    if abs(across) > abs(along):
        return "cornering"
    return "braking" if along < 0.0 else "driving"


def judge_drive(drive: DetectionDrive, *, oracle: bool = False) -> DetectionTally:
    """Evaluate the drives of one town, and return their tally (sums and counts of the evaluation).
    With `oracle`, also evaluate an oracle (an ideal observer that knows motion and tyre forces). It
    gets those visits (passages of a map cell) on ice during which a wheel uses much of its grip.
    """
    tally = DetectionTally()
    _judge_samples(tally, drive)
    for n in range(drive.mu.shape[1]):
        slides = slides_of(drive.theta[:, n])
        _judge_passes(tally, drive, n, slides)
        _judge_slides(tally, drive, n)
        _judge_contradictions(tally, drive, n, slides)
        _judge_false_events(tally, drive, n)
        _judge_visits(tally, drive, n, slides, oracle=oracle)
    return tally


def _judge_samples(tally: DetectionTally, drive: DetectionDrive) -> None:
    """Evaluate all samples of the town, and add the results to the tally: coverage and interval
    score of the friction interval, false ice (a road with grip reported as slippery), and false
    grip (lower end of the interval too far above the true friction).
    """
    mu = drive.mu
    is_moving = ~drive.stood
    inside = (drive.lower <= mu) & (mu <= drive.upper)
    for name, (above, most) in SURFACES.items():
        among = (mu > above) & (mu <= most)
        tally.add(f"coverage90.{name}", inside[among & is_moving])
        tally.add(f"coverage90.{name}.stood", inside[among & ~is_moving])
        score = interval_score(
            drive.lower.astype(np.float64), drive.upper.astype(np.float64), mu.astype(np.float64)
        )
        tally.add(f"score.{name}", score[among & is_moving])
    ice = (mu <= ICE_MU) & is_moving
    called = drive.slippery > CALLED_SHARE
    grips = mu > SNOW_MU
    tally.add("false_grip", (drive.lower > mu + FALSE_GRIP)[ice])
    tally.add("false_grip.sure", (drive.lower > SLIPPERY_MU)[ice])
    excited = recent_maximum(drive.used.max(axis=-1)) >= EXCITED_SHARE
    tally.add("warned", called[ice & excited])
    tally.add("false_ice", called[grips])
    settled = grips & ~recent_maximum(~grips, SETTLED_S).astype(bool)
    tally.add("false_ice.settled", called[settled])
    off_ice = drive.mu_wheel.min(axis=-1) > SNOW_MU
    tally.add("false_ice.off_ice", called[off_ice])
    tally.add("km", np.array([float(drive.speed[settled].sum(dtype=np.float64)) / RATE_HZ / 1e3]))
    contradicted = (drive.health & int(Health.CONTRADICTION)) > 0
    tally.add("contradiction_share.ice.excited", contradicted[ice & excited])
    tally.add("contradiction_share", contradicted)


def passes_of(drive: DetectionDrive, n: int, kind: str) -> Stretches:
    """Return the passes of car n over slippery road, as pairs (first index, last index + 1). A pass
    is a stretch of at least PASS_S seconds on ice, or on snow with friction up to SLIPPERY_MU;
    `kind` is "ice" or "snow".
    """
    mu = drive.mu[:, n]
    on = mu <= ICE_MU if kind == "ice" else (mu > ICE_MU) & (mu <= SLIPPERY_MU)
    return [(first, end) for first, end in runs_of(on) if end - first >= round(PASS_S * RATE_HZ)]


def _judge_passes(tally: DetectionTally, drive: DetectionDrive, n: int, slides: Stretches) -> None:
    for kind in ("ice", "snow"):
        for first, end in passes_of(drive, n, kind):
            called = drive.slippery[first:end, n] > CALLED_SHARE
            flag = drive.flagged[first:end, n] < FLAGGED_MU
            if drive.stood[first:end, n].any():
                tally.add_case(f"passes.{kind}.stood", holds=bool(called.any()))
                continue
            tally.add_case(f"passes.{kind}", holds=bool(called.any()))
            tally.add_case(f"flag.passes.{kind}", holds=bool(flag.any()))
            tally.add_case(
                f"controller.passes.{kind}", holds=bool(drive.controlled[first:end, n].any())
            )
            tally.add_case(f"either.passes.{kind}", holds=bool(flag.any() or called.any()))
            for nats in ROC_NATS:
                tally.add_case(
                    f"roc.{nats:g}.{kind}", holds=bool((drive.favoured[first:end, n] > nats).any())
                )
            for mu in ROC_FLAG_MU:
                tally.add_case(
                    f"flag.{mu:g}.{kind}", holds=bool((drive.flagged[first:end, n] < mu).any())
                )
            slid = next(((max(a, first), b) for a, b in slides if b > first and a < end), None)
            if slid is None:
                continue
            activity = activity_of(drive, n, slid[0], min(slid[1], end))
            for name, found in (("", called), ("flag.", flag)):
                for among in ("slide", activity):
                    tally.add_case(f"{name}passes.{kind}.{among}", holds=bool(found.any()))
                if found.any():
                    wait = max(0.0, (first + int(np.argmax(found)) - slid[0]) / RATE_HZ)
                    _add_seconds(tally, f"{name}seconds.{kind}", activity, wait)


def _add_seconds(tally: DetectionTally, key: str, activity: str, wait: float) -> None:
    """Add the time until detection of a slide, `wait` [s], to two lists of the tally: the list
    `key` for all slides, and the list for slides with the same cause `activity` (such as
    "braking").
    """
    tally.seconds.setdefault(key, []).append(wait)
    tally.seconds.setdefault(f"{key}.{activity}", []).append(wait)


def _judge_slides(tally: DetectionTally, drive: DetectionDrive, n: int) -> None:
    """Count the slides of car n on slippery road, and among them the found slides. A slide is found
    if the estimator reports a slippery road during the slide or at most TOLD_AFTER_S [s] after it.
    Add both counts to the tally.
    """
    beyond = drive.theta[:, n] > SLIDING
    for first, end in slides_of(drive.theta[:, n], TOLD_SLIDE_S):
        if float(drive.mu_wheel[first:end, n].mean()) >= TOLD_MU or drive.stood[first:end, n].any():
            continue
        late = end + round(TOLD_AFTER_S * RATE_HZ)
        is_found = bool((drive.slippery[first:late, n] > CALLED_SHARE).any())
        four = bridge_gaps(np.asarray(beyond[first:end].all(axis=1)), BRIDGED_S)
        whole = any(b - a >= round(TOLD_SLIDE_S * RATE_HZ) for a, b in runs_of(four))
        tally.add_case(
            "slide.told.all_wheels" if whole else "slide.told.some_wheels", holds=is_found
        )


def _judge_contradictions(
    tally: DetectionTally, drive: DetectionDrive, n: int, slides: Stretches
) -> None:
    """Count how often the health flag CONTRADICTION (no friction explains the measurements) is set
    during slides on slippery road. Separately, count how often it is set without a slide.

    For each count, also sum the time [s] in which the flag could have been set. Time with the flag
    already set is left out. Add all sums to the tally.
    """
    sliding = np.zeros(len(drive.mu), np.bool_)
    extended = np.zeros(len(drive.mu), np.bool_)
    for first, end in slides:
        sliding[first:end] = True
        extended[first : end + round(AFTER_SLIDE_S * RATE_HZ)] = True
    low = drive.mu[:, n] <= SNOW_MU
    flagged = (drive.health[:, n] & int(Health.CONTRADICTION)) > 0
    onset = np.flatnonzero(flagged[1:] & ~flagged[:-1]) + 1
    # A slide may end on dry road. It counts as one on slippery road if the friction was low within
    # the last AFTER_SLIDE_S.
    was_low = recent_maximum(low[:, None], AFTER_SLIDE_S)[:, 0].astype(bool)
    in_slide = extended[onset]
    tally.add("contradictions.slide", np.array([float((in_slide & was_low[onset]).sum())]))
    tally.add("contradictions.elsewhere", np.array([float((~in_slide).sum())]))
    tally.add("s.slide", np.array([float((sliding & low & ~flagged).sum()) / RATE_HZ]))
    tally.add("s.elsewhere", np.array([float((~sliding & ~flagged).sum()) / RATE_HZ]))


def _judge_false_events(tally: DetectionTally, drive: DetectionDrive, n: int) -> None:
    """Count false reports of slippery road by car n, at least SETTLED_S [s] after snow and ice, and
    add the counts to the tally.

    The reports of the estimator and of the slip flag (ordinary ABS logic) are counted separately.
    For the ROC curve, they are counted again with other limits. For the estimator, these are limits
    of its evidence for a slippery road (ROC_NATS). For the flag, they are limits of the reported
    friction (ROC_FLAG_MU).
    """
    grips = drive.mu[:, n] > SNOW_MU
    settled = grips & ~recent_maximum(~grips[:, None], SETTLED_S)[:, 0].astype(bool)
    ways = {
        "false_events": drive.slippery[:, n] > CALLED_SHARE,
        "flag.false_events": drive.flagged[:, n] < FLAGGED_MU,
    }
    ways |= {f"roc.{nats:g}.false_events": drive.favoured[:, n] > nats for nats in ROC_NATS}
    ways |= {f"flag.{mu:g}.false_events": drive.flagged[:, n] < mu for mu in ROC_FLAG_MU}
    for name, called in ways.items():
        events = runs_of(bridge_gaps(called & settled, EVENT_GAP_S))
        tally.add(name, np.array([float(len(events))]))
    low = drive.mu_wheel[:, n].min(axis=-1) <= SNOW_MU
    off_ice = ~recent_maximum(low[:, None], SETTLED_S)[:, 0].astype(bool)
    events = runs_of(bridge_gaps(ways["false_events"] & off_ice, EVENT_GAP_S))
    tally.add("false_events.off_ice", np.array([float(len(events))]))


def _judge_visits(
    tally: DetectionTally, drive: DetectionDrive, n: int, slides: Stretches, *, oracle: bool
) -> None:
    visits = drive.visits
    for v in np.flatnonzero(visits.vehicle == n):
        now = slice(int(visits.first[v]), int(visits.last[v]) + 1)
        mu = drive.mu[now, n]
        if not len(mu):
            continue
        likelihood = visits.likelihood[v]
        if float(mu.min()) > SNOW_MU:
            tally.add_case(
                "false_visits", holds=bool(slippery_favoured(likelihood) >= FAVOURED_NATS)
            )
        if float(np.ptp(mu)) >= MOVES or float(mu.mean()) > SNOW_MU:
            continue
        kind = "ice" if float(mu.mean()) <= ICE_MU else "snow"
        slid = any(
            min(b, now.stop) - max(a, now.start) >= round(SLIDE_S * RATE_HZ) for a, b in slides
        )
        if not slid and float(drive.used[now, n].max()) <= EXCITED_SHARE:
            continue
        suffix = ".stood" if drive.stood[now, n].any() else ""
        _note_visit(tally, f"{kind}.", likelihood, (slid, suffix))
        if oracle and kind == "ice":
            grip = drive.mu_wheel[now, n].astype(np.float64)
            force = drive.used[now, n] * grip
            slip = drive.theta[now, n] * grip
            rng = np.random.default_rng([n, now.start])
            found = visit_evidence(force, slip, drive.speed[now, n].astype(np.float64), rng)
            _note_visit(tally, f"oracle.{kind}.", found, (slid, suffix))


def _note_visit(
    tally: DetectionTally, kind: str, likelihood: FloatArray, slid: tuple[bool, str]
) -> None:
    value = bool(likelihood.max() - likelihood[-1] >= VALUE_NATS)
    favoured = bool(slippery_favoured(likelihood) >= FAVOURED_NATS)
    for among in ("", ".slide") if slid[0] else ("", ".calm"):
        tally.add_case(f"{kind}yield{among}{slid[1]}", holds=value)
        tally.add_case(f"{kind}favoured{among}{slid[1]}", holds=favoured)


class TownTally(NamedTuple):
    """Sums and counts of the detection evaluation (`DetectionTally`) for one town, and a flag that
    is True for a winter town.
    """

    winter: bool
    tally: DetectionTally


@dataclass
class DetectionResults:
    """Results of the detection evaluation for each simulated town (`DetectionTally`), by the length
    of its drives ("short" or "long") and the kind of its cars. "rough" cars have large sensor
    errors, as real cars have; "plain" cars have small sensor errors.
    """

    towns: dict[tuple[str, str], list[TownTally]] = field(default_factory=dict)

    def add(self, length: str, kind: str, town: TownTally) -> None:
        """Add the results of a town, under the length of its drives and the kind of its cars."""
        self.towns.setdefault((length, kind), []).append(town)

    def pool_towns(
        self, lengths: Sequence[str], kind: str, *, winter: bool | None = None
    ) -> DetectionTally:
        """Return the sum of the tallies of all towns with this kind of cars and these lengths of
        drives. If `winter` is True or False, only winter towns or only other towns are included.
        """
        found = DetectionTally()
        for length in lengths:
            for town in self.towns.get((length, kind), []):
                if winter is None or town.winter == winter:
                    found.merge(town.tally)
        return found
