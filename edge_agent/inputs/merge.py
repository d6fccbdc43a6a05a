"""Merging of recordings, each with its own clock, into one signal log by a profile (assignment of
signals to channels).

Rows: if all signals come from one table, its rows are used. Otherwise rows have a fixed rate, with
linear interpolation between readings that are near enough in time. A position is written only into
the row nearest to its fix. `clock_alignment` describes how clocks are aligned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.channel_readings import make_channel, select_signals
from edge_agent.inputs.clock_alignment import align_clocks
from edge_agent.inputs.context import held_readings
from edge_agent.inputs.log_columns import GROUND
from edge_agent.inputs.parts import join_parts
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.recording import Recording, Series
from edge_agent.inputs.units import QUANTITY, unit_of_channel
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CONTEXT, FLAGS
from schemas.thresholds import NS

# Channels of a position receiver, which have a reading only at some rows.
SPARSE: Final = ("latitude", "longitude", "yaw", GROUND)
COURSE_SPEED: Final = 3.0  # [m/s] below this speed, the course of a receiver is noise
RATES: Final = (10.0, 20.0, 25.0, 50.0, 100.0)  # [Hz] possible rates of the rows
# Readings are not interpolated if they are further apart than the larger of these two limits.
GAP_PERIODS: Final = 3.0  # [periods of the signal]
GAP_S: Final = 0.1  # [s]


@dataclass
class Merged:
    """A signal log that was merged from recordings.

    `t` (T,) [s] starts at 0, and `columns` are the channels by name. `start_ns` is the time [ns
    UTC] of t = 0 if a source had a date, else None. `notes` describe the processing steps, and
    `origins` the source of each channel.
    """

    t: FloatArray
    columns: dict[str, FloatArray]
    start_ns: int | None
    notes: list[str] = field(default_factory=list)
    # Properties per channel: source, rate, missing readings, jitter.
    origins: dict[str, dict[str, object]] = field(default_factory=dict)


def merge_recordings(
    recordings: Sequence[Recording],
    profile: Profile,
    *,
    wheel_radius: float | None = None,
    steering_ratio: float | None = None,
    shifts: Mapping[str, float] | None = None,
) -> Merged:
    """Merge all recordings into one signal log by a profile.

    Args:
        recordings: recordings of the sources; parts of one drive are joined.
        profile: profile to apply.
        wheel_radius: radius of the vehicle file [m]; takes precedence over that of the profile.
        steering_ratio: ratio of the vehicle file; takes precedence over that of the profile.
        shifts: source name -> seconds to add to its clock.

    Raises:
        InputError: no recording has a signal of the profile, dates do not overlap, or a radius or
            ratio is missing.
    """
    recordings = join_parts(recordings, profile, shifts or {})
    selected = select_signals(recordings, profile)
    if not selected:
        names = ", ".join(sorted(profile.needed_signals())[:6])
        raise InputError(
            "profile", f"no recording has any of its signals ({names}, …)", "choose another profile"
        )
    alignment = align_clocks(recordings, _reference_of(selected), shifts or {})
    notes = [note for recording in recordings for note in recording.notes] + alignment.notes
    used = {place for place, _ in selected.values()}
    notes += [
        f"{recording.name}: no channel is taken from it"
        for place, recording in enumerate(recordings)
        if place not in used
    ]
    radius = wheel_radius or profile.wheel_radius
    ratio = steering_ratio or profile.steering_ratio
    series: dict[str, Series] = {}
    origins: dict[str, dict[str, object]] = {}
    for name, (place, channel) in selected.items():
        recording = recordings[place]
        one, jitter = make_channel(name, channel, recording, radius, ratio)
        series[name] = Series(one.t + alignment.offsets[place] - channel.delay_s, one.values)
        notes += _unit_notes(name, channel, recording)
        origins[name] = _describe_origin(recording, channel, one, jitter)
    _drop_slow_courses(series)
    context = {name: series.pop(name) for name in CONTEXT if name in series}
    if not series:
        raise InputError(
            "profile",
            "no recording has any of the channels",
            "a drive needs more than context signals",
        )
    rows = _build_rows(series, profile, recordings, selected)
    columns = rows.columns | _context_columns(context, profile, rows.t)
    shift = rows.t[0]
    start_ns = None if alignment.start_ns is None else alignment.start_ns + round(shift * NS)
    return Merged(rows.t - shift, columns, start_ns, notes, origins)


def _reference_of(selected: Mapping[str, tuple[int, Channel]]) -> int:
    """Return the index of the recording whose clock is used for the log: the one with the wheel
    speeds, else the one with the first channel.
    """
    wheels = [place for name, (place, _) in selected.items() if name.startswith("omega")]
    every = [place for place, _ in selected.values()]
    return (wheels or every)[0]


def _unit_notes(name: str, channel: Channel, recording: Recording) -> list[str]:
    """Return a note if the recording states an unknown unit for a channel, and the profile none."""
    stated = recording.signals[channel.signals[0]].unit
    if channel.unit is not None or not stated or name in (GROUND, *FLAGS):
        return []
    if unit_of_channel(name, stated) is not None:
        return []
    return [f"{name}: its unit {stated!r} is unknown; taken as {next(iter(QUANTITY[name]))}"]


def _context_columns(
    context: Mapping[str, Series], profile: Profile, t: FloatArray
) -> dict[str, FloatArray]:
    """Return the columns of the context signals at the times `t` (n,) [s] of the log's rows."""
    columns = {}
    for name, series in context.items():
        if len(series.t) == len(t) and np.array_equal(series.t, t):
            columns[name] = series.values  # from the same table: keep its rows unchanged
        else:
            lasting = profile.channels[name].lasting
            columns[name] = held_readings(name, series, t, lasting=lasting)
    return columns


def _describe_origin(
    recording: Recording, channel: Channel, series: Series, jitter_s: float
) -> dict[str, object]:
    """Return the properties of a channel for `Merged.origins`. `series` has its readings."""
    steps = np.diff(series.t)
    period_s = float(np.median(steps)) if len(steps) else 0.0
    missing = float(np.mean(~np.isfinite(series.values)))
    return {
        "source": recording.name,
        "signals": channel.signals,
        "readings": len(series.t),
        "period_s": round(period_s, 6),
        "missing": round(missing, 4),
        "jitter_s": jitter_s,
    }


def _drop_slow_courses(series: dict[str, Series]) -> None:
    """Set the course over ground of a position receiver to NaN (unknown) at walking speed, in
    place. `series` has the signals of the receiver by name.
    """
    if "yaw" in series and GROUND in series and len(series["yaw"].t) == len(series[GROUND].t):
        yaw = series["yaw"]
        speed = series[GROUND].values
        series["yaw"] = Series(yaw.t, np.where(speed > COURSE_SPEED, yaw.values, np.nan))


class _Rows(NamedTuple):
    """Rows of a merged log: their times t (n,) [s], and the channels by name, (n,) each."""

    t: FloatArray
    columns: dict[str, FloatArray]


def _build_rows(
    series: dict[str, Series],
    profile: Profile,
    recordings: Sequence[Recording],
    selected: Mapping[str, tuple[int, Channel]],
) -> _Rows:
    """Return the rows of the log: those of the table from which all channels come, if there is one,
    else rows at a fixed rate over the time that all dense channels have in common.
    """
    sources = {place for name, (place, _) in selected.items() if name in series}
    delays = {profile.channels[name].delay_s for name in series if name in profile.channels}
    is_one_table = len(sources) == 1 and recordings[min(sources)].rows and len(delays) == 1
    if is_one_table and profile.rate_hz is None:
        t = next(iter(series.values())).t
        return _Rows(t, {name: one.values for name, one in series.items()})
    if series.keys() <= set(SPARSE):
        raise InputError("source", "has only positions", "add a recording of the car's signals")
    dense = {name: one for name, one in series.items() if name not in SPARSE and len(one.t) > 1}
    if not dense:
        raise InputError(
            "source", "no channel has two readings", "record longer, or choose another profile"
        )
    first = max(one.t[0] for one in dense.values())
    last = min(one.t[-1] for one in dense.values())
    rate = profile.rate_hz or _row_rate(dense)
    if not last - first > 1.0 / rate:
        raise InputError(
            "source", "its channels have no common time", "record them together, or give --clock"
        )
    t = first + np.arange(int((last - first) * rate + 1e-6) + 1) / rate
    return _Rows(
        t, {name: sample_at_rows(one, t, sparse=name in SPARSE) for name, one in series.items()}
    )


def _row_rate(dense: Mapping[str, Series]) -> float:
    """Return the number of rows (samples) per second [Hz] for the merged log: the rate of the
    fastest channel in `dense`, rounded up to a value in RATES.

    `dense` contains all channels except those with few readings, such as positions (SPARSE).
    """
    fastest = max(1.0 / max(float(np.median(np.diff(one.t))), 1e-3) for one in dense.values())
    return next((rate for rate in RATES if rate >= 0.95 * fastest), RATES[-1])


def sample_at_rows(series: Series, t: FloatArray, *, sparse: bool) -> FloatArray:
    """Return a series sampled at the times `t` (n,) of the log's rows.

    A dense series is interpolated; the result is NaN in rows without readings near enough in time.
    A `sparse` series, for example positions, is not interpolated: each reading is written only into
    the row nearest to its time.
    """
    good = np.isfinite(series.values)
    known = series.t[good]
    values = series.values[good]
    out = np.full(len(t), np.nan)
    if not len(known):
        return out
    if sparse:
        row = np.searchsorted(t, known - 0.5 * (t[1] - t[0]))
        inside = (row < len(t)) & (known >= t[0] - 0.5 * (t[1] - t[0]))
        out[row[inside]] = values[inside]
        return out
    place = np.searchsorted(known, t)
    before = known[np.clip(place - 1, 0, None)]
    after = known[np.clip(place, None, len(known) - 1)]
    period = float(np.median(np.diff(series.t))) if len(series.t) > 1 else 0.0
    near = (after - before <= max(GAP_PERIODS * period, GAP_S)) & (known[0] <= t) & (t <= known[-1])
    out[near] = np.interp(t[near], known, values)
    return out
