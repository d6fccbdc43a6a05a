"""Joining of recordings that are consecutive parts of one drive, such as the files of a recorder
that begins a new file every minute.

Two recordings are parts of one drive if they share at least half of their signals and one begins
when the other ends. Recordings that overlap for longer are different sources, for example two
receivers. Without dates, a clock that continues from file to file shows the order of the parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.profile import Profile
from edge_agent.inputs.recording import Recording, Series
from schemas.errors import InputError
from schemas.thresholds import NS

LONGEST_GAP_S: Final = 600.0  # after a longer pause, it is another drive


class _Part(NamedTuple):
    """A recording and the times [s] of its first and last reading. The times count from 1970, or
    from the start of the recorder's clock if the recording has no date.
    """

    recording: Recording
    first: float
    last: float

    @property
    def name(self) -> str:
        """Return the name of the file."""
        return self.recording.name

    @property
    def is_dated(self) -> bool:
        """Return True if the recording has a date."""
        return self.recording.start_ns is not None


def join_parts(
    recordings: Sequence[Recording], profile: Profile, shifts: Mapping[str, float]
) -> list[Recording]:
    """Return the recordings, with consecutive parts of one drive joined to one recording.

    A joined recording has the name and the clock of its first part. `shifts` are corrections [s] by
    source. A recording that the profile names as a `source` is not joined.

    Raises:
        InputError: the order of two parts is unknown, the pause between them is too long, or
            they have different units.
    """
    named = {channel.source for channel in profile.channels.values()}
    parts = [
        _locate_part(one, shifts.get(one.name, 0.0))
        for one in recordings
        if one.name not in named and one.signals
    ]
    chains: list[list[_Part]] = []
    for part in sorted(parts, key=lambda part: part.first):
        # With several similar sources, a part continues the one whose end is nearest.
        nearest = sorted(chains, key=lambda chain: abs(part.first - chain[-1].last))
        chain = next((chain for chain in nearest if _continues(chain[-1], part)), None)
        if chain is None:
            chains.append([part])
        else:
            chain.append(part)
    joined = {id(chain[0].recording): _join_chain(chain, shifts) for chain in chains}
    later = {id(part.recording) for chain in chains for part in chain[1:]}
    return [joined.get(id(one), one) for one in recordings if id(one) not in later]


def _locate_part(recording: Recording, shift: float) -> _Part:
    """Return a recording with its first and last time, after `shift` [s] was added."""
    start = shift + (recording.start_ns or 0) / NS
    first, last = recording.time_span
    return _Part(recording, start + first, start + last)


def _continues(one: _Part, later: _Part) -> bool:
    """Return True if the part `later` continues the part `one`.

    Raises:
        InputError: both have the same signals, but their order is unknown or the pause is too long.
    """
    names = one.recording.signals.keys()
    others = later.recording.signals.keys()
    is_similar = 2 * len(names & others) >= min(len(names), len(others))
    if not is_similar or one.is_dated != later.is_dated:
        return False
    shorter = min(one.last - one.first, later.last - later.first)
    pause = later.first - one.last
    if pause < 0.0 and -pause >= 0.5 * shorter:
        if names == others and not one.is_dated:
            raise InputError(
                later.name,
                f"has the signals and the times of {one.name}, and no date",
                f"if it is the next part of the drive, give --clock {later.name}=SECONDS from the "
                f"start of {one.name}; else name the sources in the profile",
            )
        return False
    if pause > LONGEST_GAP_S:
        raise InputError(
            later.name,
            f"begins {pause:.0f} s after the end of {one.name}",
            f"import each drive on its own, or correct the clock with --clock {later.name}=SECONDS",
        )
    return True


def _join_chain(chain: Sequence[_Part], shifts: Mapping[str, float]) -> Recording:
    """Return consecutive parts of a drive as one recording with the clock of the first part."""
    first = chain[0].recording
    if len(chain) == 1:
        return first
    notes = [note for part in chain for note in part.recording.notes]
    notes += [
        f"{later.name}: continues {one.name} after {max(later.first - one.last, 0.0):.2f} s"
        for one, later in pairwise(chain)
    ]
    offsets = [_clock_offset(part.recording, first, shifts) for part in chain]
    names = dict.fromkeys(name for part in chain for name in part.recording.signals)
    rows = all(part.recording.rows for part in chain)
    signals = {name: _join_signal(name, chain, offsets, rows=rows) for name in names}
    has_zone = all(part.recording.has_zone for part in chain)
    return Recording(first.name, signals, first.start_ns, rows, notes, has_zone)


def _clock_offset(part: Recording, first: Recording, shifts: Mapping[str, float]) -> float:
    """Return the seconds to add to the times of a part, so that they count from the start of the
    part `first`.
    """
    start = (part.start_ns or 0) - (first.start_ns or 0)
    return start / NS + shifts.get(part.name, 0.0) - shifts.get(first.name, 0.0)


def _join_signal(
    name: str, chain: Sequence[_Part], offsets: Sequence[float], *, rows: bool
) -> Series:
    """Return the readings of a signal in all parts. Readings of a part before the end of the part
    before it are left out. With `rows`, a part without the signal has NaN in its rows.

    Raises:
        InputError: the parts state different units.
    """
    times = [np.empty(0)]
    values = [np.empty(0)]
    units: dict[str, str] = {}
    end = -np.inf
    for part, offset in zip(chain, offsets, strict=True):
        series = part.recording.signals.get(name)
        if series is None and rows:
            t = next(iter(part.recording.signals.values())).t
            series = Series(t, np.full(len(t), np.nan))
        if series is None or not len(series.t):
            continue
        if name in part.recording.signals:
            units.setdefault(series.unit, part.name)
        is_new = series.t + offset > end
        times.append(series.t[is_new] + offset)
        values.append(series.values[is_new])
        end = max(end, float(series.t[-1]) + offset)
    if len(units) > 1:
        stated = ", ".join(f"{unit!r} in {file}" for unit, file in units.items())
        raise InputError(name, f"has different units: {stated}", "import each file on its own")
    return Series(np.concatenate(times), np.concatenate(values), next(iter(units), ""))
