"""Alignment of the clocks of several recordings.

The time of a signal log is that of the source with the wheel speeds. A source with a date is
aligned by its date; a source without a date begins when the first source does. Some loggers write
local time without stating it. Therefore, if dates do not overlap, other time zones are tried, in
steps of a quarter of an hour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from edge_agent.inputs.recording import Recording
from schemas.errors import InputError
from schemas.thresholds import NS

ZONE_S: Final = 900.0
LARGEST_ZONE: Final = 56  # largest difference of time zones [quarters of an hour]


class Alignment(NamedTuple):
    """Common clock of several recordings.

    `offsets` are the seconds to add to the times of each recording. `start_ns` is the time [ns UTC]
    of t = 0, None without a date. `notes` are messages for the user.
    """

    offsets: list[float]
    start_ns: int | None
    notes: list[str]


def align_clocks(
    recordings: Sequence[Recording], reference: int, shifts: Mapping[str, float]
) -> Alignment:
    """Return the common clock of the recordings: that of the recording with index `reference`.
    `shifts` are further corrections [s] by source.

    Raises:
        InputError: the dates of two recordings do not overlap in any time zone.
    """
    main = recordings[reference]
    receiver_ns = _receiver_start(recordings)
    start_ns = main.start_ns
    offsets = []
    notes = []
    for index, recording in enumerate(recordings):
        shift = shifts.get(recording.name, 0.0)
        if index == reference:
            offsets.append(shift)
        elif main.start_ns is None or recording.start_ns is None:
            later = main.time_span[0] - recording.time_span[0]
            if recording.start_ns is not None:
                start_ns = recording.start_ns - round(later * NS)
            offsets.append(shift + later)
            notes.append(
                f"{recording.name}: no common date; assumed to begin when {main.name} does"
            )
        else:
            lead = (recording.start_ns - main.start_ns) / NS
            zone = _find_zone(recording, main, lead, shift)
            offsets.append(lead + shift + zone * ZONE_S)
            if zone:
                notes.append(
                    f"{recording.name}: its date is {-zone * ZONE_S / 3600.0:g} h from the "
                    "others', probably because of another time zone"
                )
            has_zone = recording.has_zone and not main.has_zone
            if zone and (has_zone or recording.start_ns == receiver_ns):
                # The date with a zone, or of a position receiver, is correct.
                start_ns = main.start_ns - round(zone * ZONE_S * NS)
    return Alignment(offsets, start_ns, notes)


def _receiver_start(recordings: Sequence[Recording]) -> int | None:
    """Return the start [ns UTC] of the first recording of a position receiver; None if there is no
    such recording, or it has no date.
    """
    position = {"latitude", "course"}
    return next((one.start_ns for one in recordings if one.signals.keys() >= position), None)


def _find_zone(recording: Recording, main: Recording, lead: float, shift: float) -> int:
    """Return the smallest difference of time zones [ZONE_S] with which a recording overlaps the
    recording `main`; 0 if no difference is needed. `lead` is the difference of their starts [s].
    """
    span = recording.time_span
    main_span = main.time_span
    for zone in sorted(range(-LARGEST_ZONE, LARGEST_ZONE + 1), key=abs):
        if _spans_overlap(span, lead + shift + zone * ZONE_S, main_span):
            return zone
    raise InputError(
        recording.name,
        f"its clock is {lead + shift:.0f} s later than that of {main.name}",
        f"give --clock {recording.name}={-lead:.0f}, or another number of seconds to add to it",
    )


def _spans_overlap(span: tuple[float, float], shift: float, other: tuple[float, float]) -> bool:
    """Return True if two spans of time [s] overlap in more than half of the shorter one, after
    `shift` [s] was added to the first one.
    """
    common = min(span[1] + shift, other[1]) - max(span[0] + shift, other[0])
    return common > 0.5 * min(span[1] - span[0], other[1] - other[0])
