"""DENM (hazard message of cooperative ITS) about low adhesion (ETSI EN 302 637-3, cause code 6): a
record, and its encoding as bytes in unaligned PER. Pure (no I/O).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from fleet_service.client.cits.uper import BitWriter
from schemas.errors import InputError
from schemas.runtime.installing import install_command
from schemas.thresholds import METRES_PER_DEGREE, NS

PROTOCOL_VERSION: Final = 2
MESSAGE_ID: Final = 1  # number of the message type DENM
ADHESION: Final = 6  # cause code "adverse weather condition: adhesion"
# sub-cause codes of adhesion
UNKNOWN_SLIPPERY = 0
HEAVY_FROST = 1
SNOW = 4
ICE = 5
BLACK_ICE = 6
SALTED = 10
ROADSIDE: Final = 15  # station type "roadside unit", for a sender that is no vehicle
VALIDITY_DEFAULT_S: Final = 600
POINTS: Final = 23  # largest number of events of a history
REACH: Final = 131_071  # [0.1 µdeg] farthest point of a history or a trace from the event
UNITS: Final = 1e7  # units of latitude and longitude per degree
# Half axis of the ellipse that contains 95 % of positions, in standard deviations along an axis.
AXIS: Final = math.sqrt(-2.0 * math.log(0.05))
# Time is counted in milliseconds of TAI since 2004. UTC has had five leap seconds since then.
EPOCH_NS: Final = 1_072_915_200 * NS
LEAP_MS: Final = 5000
UNAVAILABLE: Final = {
    "latitude": 900_000_001,
    "longitude": 1_800_000_001,
    "heading": 3601,
    "axis": 4095,
}
# smallest value of integers whose range begins below 0
LEAST: Final = {
    "latitude": -900_000_000,
    "longitude": -1_800_000_000,
    "altitude": -100_000,
    "height": -12_700,
}
DELTA_BITS: Final = 18 + 18 + 15  # bits of a position difference: north, east, height
TRACES: Final = 7
TRACE_POINTS: Final = 40
APPROACH_M: Final = (100.0, 300.0, 600.0)  # [m] points of a trace before the event
# positions in the enumerations of `denm.asn`
LESS_THAN_5_KM: Final = 5
ALL_DIRECTIONS: Final = 0
UPSTREAM: Final = 1
Termination = Literal["isCancellation", "isNegation"]
TERMINATIONS: Final[tuple[Termination, ...]] = ("isCancellation", "isNegation")
Point = tuple[float, float]


@dataclass(frozen=True)
class Denm:
    """Hazard message (DENM).

    Attributes:
        station, sequence: identity of the event: originating station, and number of the event at
            this station.
        sender: station that sends this message.
        detected, referenced: time of detection, and time of this version [ns since 1970, UTC].
        termination: isCancellation by the originating station, isNegation by another station; None
            while the event lasts.
        position: latitude and longitude [deg].
        position_std: standard deviation of the position on each axis [m].
        validity_s: time after `detected` for which receivers assume that the event lasts [s].
        quality: information quality, 0 (unknown) to 7.
        cause, sub_cause: numeric codes of the cause of the hazard; cause 6 is low adhesion.
        history: further points of the event [deg].
        traces: paths that lead to the event, each from the event backwards [deg].
        heading: heading of the traffic concerned [deg from north, clockwise]; None for both
            directions.
        both_ways: True if `heading` is given and the opposite direction is concerned too.
    """

    station: int
    sequence: int
    sender: int
    detected: int
    referenced: int
    termination: Termination | None
    position: Point
    position_std: float
    validity_s: int
    quality: int = 0
    cause: int = ADHESION
    sub_cause: int = UNKNOWN_SLIPPERY
    history: tuple[Point, ...] = ()
    traces: tuple[tuple[Point, ...], ...] = ((),)
    heading: float | None = None
    both_ways: bool = False


def encode_denm(denm: Denm) -> bytes:
    """Return the bytes of a DENM (hazard message), encoded directly from the record.

    The layout is that of `denm.asn`. A general encoder would take three times as long.

    Raises:
        OverflowError: a number does not fit into the bits of its field.
    """
    lasts = denm.termination is None
    out = BitWriter()
    out.write(PROTOCOL_VERSION, 8)
    out.write(MESSAGE_ID, 8)
    out.write(denm.sender, 32)
    out.write(0b110 if lasts else 0, 3)  # presence bits: situation, location, alacarte
    _write_management(out, denm)
    if lasts:
        _write_situation(out, denm)
        _write_location(out, denm)
    return out.to_bytes()


def decode_denm(data: bytes) -> Denm:
    """Return the DENM that is encoded in `data`.

    Raises:
        InputError: the bytes are not a DENM.
    """
    try:
        message = compiled_denm().decode("DENM", data)
    except Exception as error:
        raise InputError(
            "payload",
            "is not a DENM",
            "send a DENM encoded in unaligned PER, without a security envelope",
        ) from error
    if message["header"]["messageID"] != MESSAGE_ID:
        raise InputError(
            "payload", f"has message id {message['header']['messageID']}", "send a DENM"
        )
    return _read_message(message)


def its_time(ns: int) -> int:
    """Return a time [ns since 1970, UTC] as an ITS timestamp [ms since 2004, with leap seconds]."""
    return (ns - EPOCH_NS) // 1_000_000 + LEAP_MS


def utc_of(its_ms: int) -> int:
    """Return an ITS timestamp [ms since 2004, with leap seconds] as time [ns since 1970, UTC]."""
    return (its_ms - LEAP_MS) * 1_000_000 + EPOCH_NS


@cache
def compiled_denm() -> Any:  # noqa: ANN401 the library has no types
    """Return a general encoder and decoder of DENM, compiled from the specification `denm.asn`."""
    try:
        import asn1tools
    except ImportError as error:
        raise InputError(
            "cits", "the package asn1tools is missing", install_command("cits")
        ) from error
    return asn1tools.compile_files(str(Path(__file__).with_name("denm.asn")), "uper")


def _write_management(out: BitWriter, denm: Denm) -> None:
    has_validity = denm.validity_s != VALIDITY_DEFAULT_S
    # Bits: extension; presence of termination, relevance distance, relevance direction, validity,
    # transmission interval.
    out.write(0b001100 | (denm.termination is not None) << 4 | has_validity << 1, 6)
    out.write(denm.station, 32)
    out.write(denm.sequence, 16)
    out.write(its_time(denm.detected), 42)
    out.write(its_time(denm.referenced), 42)
    if denm.termination is not None:
        out.write(TERMINATIONS.index(denm.termination), 1)
    out.write(round(UNITS * denm.position[0]) - LEAST["latitude"], 31)
    out.write(round(UNITS * denm.position[1]) - LEAST["longitude"], 32)
    axis = min(max(round(100.0 * AXIS * denm.position_std), 1), 4094)  # [cm]
    out.write(axis << 24 | axis << 12, 36)  # two half axes, and orientation 0
    out.write(800_001 - LEAST["altitude"], 20)  # altitude: unavailable
    out.write(15, 4)  # confidence of the altitude: unavailable
    out.write(LESS_THAN_5_KM, 3)
    one_way = denm.heading is not None and not denm.both_ways
    out.write(UPSTREAM if one_way else ALL_DIRECTIONS, 2)
    if has_validity:
        out.write(denm.validity_s, 17)
    out.write(ROADSIDE, 8)


def _write_situation(out: BitWriter, denm: Denm) -> None:
    deltas = _encode_deltas(denm.position, denm.history)[:POINTS]
    out.write(bool(deltas), 3)  # bits: extension; presence of linked cause, history
    out.write(denm.quality, 3)
    out.write(0, 1)  # extension bit of the cause
    out.write(denm.cause, 8)
    out.write(denm.sub_cause, 8)
    if deltas:
        out.write(len(deltas) - 1, 5)
    for delta in deltas:
        out.write(delta, 1 + DELTA_BITS)  # the first bit says that there is no time
        out.write(denm.quality, 3)


def _write_location(out: BitWriter, denm: Denm) -> None:
    out.write((denm.heading is not None) << 1, 4)  # bits: extension; speed, heading, road type
    if denm.heading is not None:
        out.write(round(10.0 * (denm.heading % 360.0)) % 3600, 12)
        out.write(126 - 1, 7)  # confidence of the heading: unavailable
    traces = denm.traces[:TRACES] or ((),)
    out.write(len(traces) - 1, 3)
    for trace in traces:
        deltas = _encode_deltas(denm.position, trace)[:TRACE_POINTS]
        out.write(len(deltas), 6)
        for delta in deltas:
            out.write(delta, 1 + DELTA_BITS)  # the first bit says that there is no time


def _encode_deltas(origin: Point, points: Iterable[Point]) -> list[int]:
    """Return the offsets of points from `origin` in the encoding of a DENM. Each number contains
    the offsets to the north and to the east, and a height marked as unavailable. Points too far
    away for the encoding are left out.
    """
    found = list[int]()
    height = 12_800 - LEAST["height"]
    for point in points:
        north = round(UNITS * (point[0] - origin[0]))
        east = round(UNITS * (point[1] - origin[1]))
        if max(abs(north), abs(east)) <= REACH:
            found.append((north + REACH) << 33 | (east + REACH) << 15 | height)
    return found


def _read_message(message: Mapping[str, Any]) -> Denm:
    content = message["denm"]
    management = content["management"]
    situation = content.get("situation", {})
    place = management["eventPosition"]
    action = management["actionID"]
    position = (place["latitude"] / UNITS, place["longitude"] / UNITS)
    axis = place["positionConfidenceEllipse"]["semiMajorConfidence"]
    location = content.get("location", {})
    heading = _heading(location)
    direction = management.get("relevanceTrafficDirection", "allTrafficDirections")
    if heading is not None and direction == "oppositeTraffic":
        heading = (heading + 180.0) % 360.0
    event = situation.get("eventType", {"causeCode": 0, "subCauseCode": 0})
    return Denm(
        station=action["originatingStationID"],
        sequence=action["sequenceNumber"],
        sender=message["header"]["stationID"],
        detected=utc_of(management["detectionTime"]),
        referenced=utc_of(management["referenceTime"]),
        termination=management.get("termination"),
        position=position if place["latitude"] != UNAVAILABLE["latitude"] else (math.nan, math.nan),
        position_std=axis / (100.0 * AXIS) if axis != UNAVAILABLE["axis"] else math.nan,
        validity_s=management["validityDuration"],
        quality=situation.get("informationQuality", 0),
        cause=event["causeCode"],
        sub_cause=event["subCauseCode"],
        history=tuple(
            _decode_delta(position, one["eventPosition"])
            for one in situation.get("eventHistory", ())
        ),
        traces=tuple(
            tuple(_decode_delta(position, one["pathPosition"]) for one in trace)
            for trace in location.get("traces", ())
        ),
        heading=heading,
        both_ways=heading is not None and direction == "allTrafficDirections",
    )


def _heading(location: Mapping[str, Any]) -> float | None:
    """Return the heading of the hazard event in a decoded DENM [deg from north]; None if it is
    unknown.
    """
    tenths = location.get("eventPositionHeading", {}).get("headingValue", UNAVAILABLE["heading"])
    return None if tenths == UNAVAILABLE["heading"] else tenths / 10.0


def _decode_delta(origin: Point, delta: Mapping[str, int]) -> Point:
    return origin[0] + delta["deltaLatitude"] / UNITS, origin[1] + delta["deltaLongitude"] / UNITS


def approach_points(position: Point, heading: float) -> tuple[Point, ...]:
    """Return points (latitude, longitude) on the road before a hazard event, for traffic with the
    given heading [deg from north], at the distances APPROACH_M, nearest first.
    """
    north = math.cos(math.radians(heading))
    east = math.sin(math.radians(heading))
    width = METRES_PER_DEGREE * math.cos(math.radians(position[0]))
    return tuple(
        (position[0] - far * north / METRES_PER_DEGREE, position[1] - far * east / width)
        for far in APPROACH_M
    )
