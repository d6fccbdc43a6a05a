"""Readings of the channels of a signal log: selection of the recorded signals by a profile
(assignment of signals to channels), and their conversion to SI units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from edge_agent.inputs.context import context_values
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
from schemas.signals import CHANNELS, CONTEXT

# Channels that the recording of a position receiver fills without a profile.
GNSS: Final = {
    "latitude": Channel(signal="latitude"),
    "longitude": Channel(signal="longitude"),
    "yaw": Channel(signal="course", unit="deg", course=True),
    GROUND: Channel(signal="speed"),
}
# signals in the recording of a position receiver
RECEIVED: Final = {"latitude", "longitude", "speed", "course"}
FEWEST: Final = 20  # minimum number of readings for the estimate of a period
# Readings before and after each reading over which the times of arrival in bursts are smoothed.
SMOOTH: Final = 50


def select_signals(
    recordings: Sequence[Recording], profile: Profile
) -> dict[str, tuple[int, Channel]]:
    """Return, for each channel of the signal log that was recorded, a pair (index, rule). The index
    is that of the recording that contains the channel's signals. The rule, from the profile,
    converts these signals to the channel.

    A recording of a position receiver provides those position channels for which the profile names
    no signal.
    """
    found: dict[str, tuple[int, Channel]] = {}
    for name in (*CHANNELS, GROUND, *CONTEXT):
        first = next(_sources_of(name, profile.channels.get(name), recordings), None)
        if first is not None:
            found[name] = first
    return found


def _sources_of(
    name: str, rule: Channel | None, recordings: Sequence[Recording]
) -> Iterator[tuple[int, Channel]]:
    """Yield the pairs (index of the recording, rule) from which the channel `name` may be filled,
    the best first. `rule` is the channel in the profile, if it has one.
    """
    if rule is not None:
        for index, recording in enumerate(recordings):
            is_source = rule.source in (None, recording.name)
            if is_source and recording.signals.keys() >= set(rule.signals):
                yield index, rule
    if name in GNSS:
        for index, recording in enumerate(recordings):
            if recording.signals.keys() >= RECEIVED:
                yield index, GNSS[name]


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
    t = parts[0].t
    values = _sum_signals(parts)
    if channel.wrap is not None:
        values = np.mod(values, channel.wrap)
    unit = _unit_of(name, channel, parts[0].unit)
    factor = _si_factor(where, name, unit, radius)
    if channel.at == "steering wheel":
        if ratio is None:
            raise InputError(
                where,
                "is the steering wheel's angle",
                "give steering_ratio in the profile or the vehicle file",
            )
        factor /= ratio
    values = (values - ZEROS.get(unit, 0.0)) * (factor * channel.scale)
    values = _apply_sign(where, values, t, channel, recording) + channel.offset
    values = _apply_gates(values, t, channel, recording)
    if channel.course:
        values = np.mod(np.pi / 2.0 - values + np.pi, 2.0 * np.pi) - np.pi
    if name in CONTEXT:
        return Series(t, context_values(name, values, channel.active)), 0.0
    if recording.rows:
        return Series(t, values), 0.0
    t, jitter = straighten_times(t)
    return Series(t, values), jitter


def _sum_signals(parts: Sequence[Series]) -> FloatArray:
    """Return the sum of recorded signals at the times of the first one."""
    first = parts[0]
    values = first.values.copy()
    for part in parts[1:]:
        values = values + np.interp(first.t, part.t, part.values)
    return values


def _unit_of(name: str, channel: Channel, stated: str) -> str:
    """Return the unit of a channel's signals: that of the profile, else the unit `stated` in the
    recording if it suits the channel, else the channel's own unit.
    """
    if name == GROUND:
        spelt = standard_spelling(stated)
        return spelt if spelt in SPEED else next(iter(SPEED))
    return channel.unit or unit_of_channel(name, stated) or next(iter(QUANTITY[name]))


def _si_factor(where: str, name: str, unit: str, radius: float | None) -> float:
    """Return the factor that converts the values of the channel `name` from `unit` to SI."""
    factor = SPEED[unit] if name == GROUND else to_si(name, unit, radius)
    if factor is None:
        raise InputError(
            where,
            f"is a speed in {unit}",
            "give the wheel's radius: --vehicle, or wheel_radius in the profile",
        )
    return factor


def _apply_sign(
    where: str, values: FloatArray, t: FloatArray, channel: Channel, recording: Recording
) -> FloatArray:
    """Return the values with the sign that another signal of the recording states, if the profile
    names such a signal; NaN where it is unknown.
    """
    if channel.sign is None:
        return values
    flag = recording.signals.get(channel.full_name(channel.sign.signal))
    if flag is None:
        raise InputError(
            where,
            f"the signal of its sign, {channel.sign.signal}, is missing",
            "name the signal of the sign",
        )
    signs = _hold_last(flag, t)
    signed = np.where(signs == channel.sign.negative, -values, values)
    return np.where(np.isfinite(signs), signed, np.nan)


def _apply_gates(
    values: FloatArray, t: FloatArray, channel: Channel, recording: Recording
) -> FloatArray:
    """Return the values with NaN where a recorded gate (signal of validity) is not "valid"."""
    for gate, valid in channel.gates.items():
        if gate in recording.signals:
            is_valid = np.isin(_hold_last(recording.signals[gate], t), valid)
            values = np.where(is_valid, values, np.nan)
    return values


def _hold_last(series: Series, t: FloatArray) -> FloatArray:
    """Return, for each time in `t` (n,) [s], the last reading of a series (recorded signal) at or
    before this time. For a time before the first reading, return the first reading.
    """
    return series.values[
        np.clip(np.searchsorted(series.t, t, side="right") - 1, 0, len(series.t) - 1)
    ]


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
    deviation = t - t[0] - period * count
    total = np.concatenate([[0.0], np.cumsum(deviation)])
    half = np.minimum(np.minimum(count, count[::-1]), SMOOTH)
    smooth = (total[count + half + 1] - total[count - half]) / (2 * half + 1)
    jitter = float(np.std(deviation - smooth))
    is_bursty = 0.05 * period < jitter < period and float(np.max(np.diff(t))) < 10.0 * period
    if is_bursty:
        t = np.asarray(t[0] + period * count + smooth)
    return t, jitter
