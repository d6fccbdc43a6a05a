"""Merging of recordings, each with its own clock, into one signal log by a profile (assignment of
signals to channels).

Clocks: the log's time is that of the source with the wheel speeds. A source with a date is aligned
by its date; a source without a date begins when the first source does. Some loggers write local
time without stating it. Therefore, if dates do not overlap, other time zones are tried, in steps of
a quarter of an hour.

Rows: if all signals come from one table, its rows are used. Otherwise rows have a fixed rate, with
linear interpolation between readings that are near enough in time. A position is written only into
the row nearest to its fix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from edge_agent.inputs.context import context_values, held_readings
from edge_agent.inputs.log_columns import GROUND
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.recording import Recording, Series
from edge_agent.inputs.units import (
    QUANTITY,
    SPEED,
    ZEROS,
    standard_spelling,
    to_si,
    unit_of_channel,
)
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, CONTEXT, FLAGS
from schemas.thresholds import NS

# Channels that the recording of a position receiver fills without a profile.
GNSS: Final = {
    "latitude": Channel(signal="latitude"),
    "longitude": Channel(signal="longitude"),
    "yaw": Channel(signal="course", unit="deg", course=True),
    GROUND: Channel(signal="speed"),
}
# signals in the recording of a position receiver
RECEIVED: Final = {"latitude", "longitude", "speed", "course"}
SPARSE: Final = ("latitude", "longitude", "yaw", GROUND)
COURSE_SPEED: Final = 3.0  # [m/s] below this speed, the course of a receiver is noise
RATES: Final = (10.0, 20.0, 25.0, 50.0, 100.0)
FEWEST: Final = 20  # minimum number of readings for the estimate of a period
# Readings are not interpolated if they are further apart than the larger of these two limits.
GAP_PERIODS = 3.0  # [periods of the signal]
GAP_S = 0.1  # [s]
ZONE_S: Final = 900.0
LARGEST_ZONE: Final = 56  # largest difference of time zones [quarters of an hour]
# Readings before and after each reading over which the times of arrival in bursts are smoothed.
SMOOTH: Final = 50


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
        recordings: recordings of the sources.
        profile: profile to apply.
        wheel_radius: radius of the vehicle file [m]; takes precedence over that of the profile.
        steering_ratio: ratio of the vehicle file; takes precedence over that of the profile.
        shifts: source name -> seconds to add to its clock.

    Raises:
        InputError: no recording has a signal of the profile, dates do not overlap, or a radius or
            ratio is missing.
    """
    radius = wheel_radius or profile.wheel_radius
    ratio = steering_ratio or profile.steering_ratio
    notes = [note for recording in recordings for note in recording.notes]
    found = found_in(recordings, profile)
    if not found:
        names = ", ".join(sorted(profile.needed_signals())[:6])
        raise InputError(
            "profile", f"no recording has any of its signals ({names}, …)", "choose another profile"
        )
    reference = next(
        (place for name, (place, _) in found.items() if name.startswith("omega")),
        next(iter(found.values()))[0],
    )
    offsets, start_ns = _align_clocks(recordings, reference, shifts or {}, notes)
    series: dict[str, Series] = {}
    origins: dict[str, dict[str, object]] = {}
    for name, (place, channel) in found.items():
        one, jitter = make_channel(name, channel, recordings[place], radius, ratio)
        series[name] = Series(one.t + offsets[place] - channel.delay_s, one.values)
        source = recordings[place].name
        stated = recordings[place].signals[channel.signals[0]].unit
        guessed = channel.unit is None and stated and name not in (GROUND, *FLAGS)
        if guessed and unit_of_channel(name, stated) is None:
            taken = next(iter(QUANTITY[name]))
            notes.append(f"{name}: its unit {stated!r} is unknown; taken as {taken}")
        origins[name] = {
            "source": source,
            "signals": channel.signals,
            **_describe_rates(one),
            "jitter_s": jitter,
        }
    _still_courses(series)
    context = {name: series.pop(name) for name in CONTEXT if name in series}
    if not series:
        raise InputError(
            "profile",
            "no recording has any of the channels",
            "a drive needs more than context signals",
        )
    merged = _build_rows(series, profile, recordings, found)
    for name, one in context.items():
        if len(one.t) == len(merged.t) and np.array_equal(one.t, merged.t):
            merged.columns[name] = one.values  # from the same table: keep its rows unchanged
        else:
            merged.columns[name] = held_readings(
                name, one, merged.t, lasting=profile.channels[name].lasting
            )
    shift = merged.t[0]
    merged.t = merged.t - shift
    merged.start_ns = None if start_ns is None else start_ns + round(shift * NS)
    merged.notes = notes
    merged.origins = origins
    return merged


def found_in(recordings: Sequence[Recording], profile: Profile) -> dict[str, tuple[int, Channel]]:
    """Return, for each channel of the signal log that was recorded, a pair (index, rule). The index
    is that of the recording that contains the channel's signals. The rule, from the profile,
    converts these signals to the channel.

    A recording of a position receiver provides those position channels for which the profile names
    no signal.
    """
    found: dict[str, tuple[int, Channel]] = {}
    for name in (*CHANNELS, GROUND, *CONTEXT):
        asked = profile.channels.get(name)
        for place, recording in enumerate(recordings):
            if (
                asked
                and asked.source in (None, recording.name)
                and set(asked.signals) <= recording.signals.keys()
            ):
                found[name] = place, asked
                break
        else:
            for place, recording in enumerate(recordings):
                if name in GNSS and recording.signals.keys() >= RECEIVED:
                    found[name] = place, GNSS[name]
                    break
    return found


def _align_clocks(
    recordings: Sequence[Recording], reference: int, shifts: Mapping[str, float], notes: list[str]
) -> tuple[list[float], int | None]:
    """Return the seconds that must be added to the times of each recording, and the time [ns UTC]
    of t = 0 of the log (None without a date). `reference` is the index of the recording whose clock
    is used for the log. `shifts` are further corrections [s] by source, and `notes` receive
    messages.
    """
    spans = [_time_span(recording) for recording in recordings]
    base = recordings[reference].start_ns
    dated = next(
        (r.start_ns for r in recordings if {"latitude", "course"} <= r.signals.keys()), None
    )
    offsets = []
    start_ns = base
    for place, recording in enumerate(recordings):
        shift = shifts.get(recording.name, 0.0)
        if place == reference or base is None or recording.start_ns is None:
            if place != reference:
                later = spans[reference][0] - spans[place][0]
                if base is None and recording.start_ns is not None:
                    start_ns = recording.start_ns - round(later * NS)
                shift += later
                notes.append(
                    f"{recording.name}: no common date; assumed to begin when "
                    f"{recordings[reference].name} does"
                )
            offsets.append(shift)
            continue
        lead = (recording.start_ns - base) / NS
        zones = sorted(range(-LARGEST_ZONE, LARGEST_ZONE + 1), key=abs)
        meets = [
            zone
            for zone in zones
            if _spans_overlap(spans[place], lead + shift + zone * ZONE_S, spans[reference])
        ]
        if not meets:
            raise InputError(
                recording.name,
                f"its clock is {lead:.0f} s from that of {recordings[reference].name}",
                f"give --clock {recording.name}=SECONDS, what to add to it",
            )
        if meets[0]:
            hours = meets[0] * ZONE_S / 3600.0
            notes.append(
                f"{recording.name}: its date is {-hours:g} h from the others', probably because of "
                "another time zone"
            )
            if dated is not None and recording.start_ns == dated:
                # The date of a position receiver is correct, so the other date is shifted.
                start_ns = base - round(meets[0] * ZONE_S * NS)
        offsets.append(lead + shift + meets[0] * ZONE_S)
    return offsets, start_ns


def _time_span(recording: Recording) -> tuple[float, float]:
    ends = [(series.t[0], series.t[-1]) for series in recording.signals.values() if len(series.t)]
    return (min(first for first, _ in ends), max(last for _, last in ends)) if ends else (0.0, 0.0)


def _spans_overlap(span: tuple[float, float], shift: float, other: tuple[float, float]) -> bool:
    common = min(span[1] + shift, other[1]) - max(span[0] + shift, other[0])
    return common > 0.5 * min(span[1] - span[0], other[1] - other[0])


def make_channel(
    name: str, channel: Channel, recording: Recording, radius: float | None, ratio: float | None
) -> tuple[Series, float]:
    """Return the readings of a channel in SI units at their own times, and the jitter of their time
    stamps [s].

    Args:
        name: name of the channel.
        channel: its rule in the profile: which signals it uses and their conversion.
        recording: recording that contains the signals.
        radius: wheel radius [m], if known.
        ratio: steering ratio, if known.

    Raises:
        InputError: the unit requires the wheel radius or the steering ratio, and it is not known.
    """
    where = f"{name} ({', '.join(channel.signals)})"
    parts = [recording.signals[signal] for signal in channel.signals]
    first = parts[0]
    values = first.values.copy()
    for part in parts[1:]:
        values = values + np.interp(first.t, part.t, part.values)
    if channel.wrap is not None:
        values = np.mod(values, channel.wrap)
    if name == GROUND:
        factor = SPEED.get(standard_spelling(first.unit), 1.0)
    else:
        unit = channel.unit or unit_of_channel(name, first.unit) or next(iter(QUANTITY[name]))
        known = to_si(name, unit, radius)
        if known is None:
            raise InputError(
                where,
                f"is a speed in {unit}",
                "give the wheel's radius: --vehicle, or wheel_radius in the profile",
            )
        factor = known
        values = values - ZEROS.get(unit, 0.0)
    if channel.at == "steering wheel":
        if ratio is None:
            raise InputError(
                where,
                "is the steering wheel's angle",
                "give steering_ratio in the profile or the vehicle file",
            )
        factor /= ratio
    values = values * (factor * channel.scale)
    if channel.sign is not None:
        flag = recording.signals.get(channel.full_name(channel.sign.signal))
        if flag is None:
            raise InputError(
                where,
                f"the signal of its sign, {channel.sign.signal}, is missing",
                "name the signal of the sign",
            )
        signs = _hold_last(flag, first.t)
        values = np.where(signs == channel.sign.negative, -values, values)
        values = np.where(np.isfinite(signs), values, np.nan)
    values = values + channel.offset
    for gate, good in channel.gates.items():
        if gate in recording.signals:
            values = np.where(
                np.isin(_hold_last(recording.signals[gate], first.t), good), values, np.nan
            )
    if channel.course:
        values = np.mod(np.pi / 2.0 - values + np.pi, 2.0 * np.pi) - np.pi
    if name in CONTEXT:
        return Series(first.t, context_values(name, values, channel.active)), 0.0
    t, jitter = (first.t, 0.0) if recording.rows else straighten_times(first.t)
    return Series(t, values), jitter


def _hold_last(series: Series, t: FloatArray) -> FloatArray:
    """Return, for each time in `t` (n,) [s], the last reading of a series (recorded signal) at or
    before this time. For a time before the first reading, return the first reading.
    """
    return series.values[
        np.clip(np.searchsorted(series.t, t, side="right") - 1, 0, len(series.t) - 1)
    ]


def _describe_rates(series: Series) -> dict[str, object]:
    steps = np.diff(series.t)
    period = float(np.median(steps)) if len(steps) else 0.0
    missing = float(np.mean(~np.isfinite(series.values)))
    return {"readings": len(series.t), "period_s": round(period, 6), "missing": round(missing, 4)}


def straighten_times(t: FloatArray) -> tuple[FloatArray, float]:
    """Return smoothed times (n,) [s] of a periodic signal whose time stamps come in bursts, and the
    standard deviation of the stamps' error [s].

    As a function of the reading's index, the time stamps scatter around a straight line. A running
    mean over SMOOTH readings to either side follows slow variations. Times that are not periodic
    (off by more than a period), or that are already even, are returned unchanged.
    """
    if len(t) < FEWEST:
        return t, 0.0
    count = np.arange(len(t))
    period = (t[-1] - t[0]) / (len(t) - 1)
    away = t - t[0] - period * count
    total = np.concatenate([[0.0], np.cumsum(away)])
    half = np.minimum(np.minimum(count, count[::-1]), SMOOTH)
    smooth = (total[count + half + 1] - total[count - half]) / (2 * half + 1)
    jitter = float(np.std(away - smooth))
    uneven = 0.05 * period < jitter < period and float(np.max(np.diff(t))) < 10.0 * period
    return (np.asarray(t[0] + period * count + smooth), jitter) if uneven else (t, jitter)


def _still_courses(series: dict[str, Series]) -> None:
    """Set the course over ground of a position receiver to NaN (unknown) at walking speed, in
    place. `series` has the signals of the receiver by name.
    """
    if "yaw" in series and GROUND in series and len(series["yaw"].t) == len(series[GROUND].t):
        yaw = series["yaw"]
        speed = series[GROUND].values
        series["yaw"] = Series(yaw.t, np.where(speed > COURSE_SPEED, yaw.values, np.nan))


def _build_rows(
    series: dict[str, Series],
    profile: Profile,
    recordings: Sequence[Recording],
    found: Mapping[str, tuple[int, Channel]],
) -> Merged:
    sources = {place for name, (place, _) in found.items() if name in series}
    late = {profile.channels[name].delay_s for name in series if name in profile.channels}
    if (
        len(sources) == 1
        and recordings[min(sources)].rows
        and len(late) == 1
        and profile.rate_hz is None
    ):
        t = next(iter(series.values())).t
        return Merged(t, {name: one.values for name, one in series.items()}, None)
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
    return Merged(
        t,
        {name: sample_at_rows(one, t, sparse=name in SPARSE) for name, one in series.items()},
        None,
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
