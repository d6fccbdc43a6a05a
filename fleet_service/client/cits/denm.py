"""DENM of low adhesion (ETSI EN 302 637-3, cause code 6): a record, its bytes by unaligned PER,
and back. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from schemas.errors import InputError
from schemas.thresholds import METRES_PER_DEGREE, NS

PROTOCOL_VERSION: Final = 2
MESSAGE_ID: Final = 1  # of a DENM
ADHESION: Final = 6  # adverse weather condition: adhesion
# sub-causes of adhesion
UNKNOWN_SLIPPERY = 0
HEAVY_FROST = 1
SNOW = 4
ICE = 5
BLACK_ICE = 6
SALTED = 10
ROADSIDE: Final = 15  # station type of an infrastructure that has no vehicle
VALIDITY_DEFAULT_S: Final = 600
POINTS: Final = 23  # most events of a history
REACH: Final = 131_071  # [0.1 µdeg] farthest point of a history or a trace from the event
UNITS: Final = 1e7  # per degree
# Time counts milliseconds since 2004 by TAI; five leap seconds were added to UTC since then.
EPOCH_NS: Final = 1_072_915_200 * NS
LEAP_MS: Final = 5000
UNAVAILABLE: Final = {
    "latitude": 900_000_001,
    "longitude": 1_800_000_001,
    "heading": 3601,
    "axis": 4095,
}
Termination = Literal["isCancellation", "isNegation"]
Point = tuple[float, float]


@dataclass(frozen=True)
class Denm:
    """One DENM.

    Attributes:
        station, sequence: identity of the event: originating station and its number there.
        sender: station that sends this message.
        detected, referenced: time of detection, and of this version [ns since 1970, UTC].
        termination: isCancellation by the originating station, isNegation by another one; None
            while the event lasts.
        position: latitude and longitude [deg].
        position_std: [m].
        validity_s: after `detected`, for how long the event is taken for present.
        quality: 0 (unknown) to 7.
        cause, sub_cause: codes; 6 is adhesion.
        history: further points of the event [deg].
        traces: ways that lead to the event, each from the event backwards [deg].
        heading: [deg from north, clockwise] of the traffic concerned; None for both directions.
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


def encode(denm: Denm) -> bytes:
    """Return the bytes of a DENM."""
    management: dict[str, Any] = {
        "actionID": {"originatingStationID": denm.station, "sequenceNumber": denm.sequence},
        "detectionTime": its_time(denm.detected),
        "referenceTime": its_time(denm.referenced),
        "eventPosition": _position(denm),
        "relevanceDistance": "lessThan5km",
        "relevanceTrafficDirection": "allTrafficDirections"
        if denm.heading is None
        else "upstreamTraffic",
        "validityDuration": denm.validity_s,
        "stationType": ROADSIDE,
    }
    if denm.termination is not None:
        management["termination"] = denm.termination
    content: dict[str, Any] = {"management": management}
    if denm.termination is None:
        content["situation"] = _situation(denm)
        content["location"] = _location(denm)
    header = {
        "protocolVersion": PROTOCOL_VERSION,
        "messageID": MESSAGE_ID,
        "stationID": denm.sender,
    }
    message = {"header": header, "denm": content}
    return bytes(_compiled().encode("DENM", message, check_types=False))


def decode(data: bytes) -> Denm:
    """Return the DENM of bytes.

    Raises:
        InputError: they are not a DENM.
    """
    try:
        message = _compiled().decode("DENM", data)
    except Exception as error:
        raise InputError(
            "payload", "is no DENM", "send one by unaligned PER, without a security envelope"
        ) from error
    if message["header"]["messageID"] != MESSAGE_ID:
        raise InputError(
            "payload", f"has message id {message['header']['messageID']}", "send a DENM"
        )
    return _record(message)


def its_time(ns: int) -> int:
    """Return a time [ns since 1970, UTC] as ITS timestamp [ms]."""
    return (ns - EPOCH_NS) // 1_000_000 + LEAP_MS


def utc_of(its_ms: int) -> int:
    """Return an ITS timestamp as time [ns since 1970, UTC]."""
    return (its_ms - LEAP_MS) * 1_000_000 + EPOCH_NS


@cache
def _compiled() -> Any:  # noqa: ANN401 the library has no types
    try:
        import asn1tools
    except ImportError as error:
        raise InputError(
            "cits", "the package asn1tools is missing", "pip install 'gripmap[cits]'"
        ) from error
    return asn1tools.compile_files(str(Path(__file__).with_name("denm.asn")), "uper")


def _position(denm: Denm) -> dict[str, Any]:
    axis = min(max(round(100.0 * denm.position_std), 1), 4094)
    return {
        "latitude": round(UNITS * denm.position[0]),
        "longitude": round(UNITS * denm.position[1]),
        "positionConfidenceEllipse": {
            "semiMajorConfidence": axis,
            "semiMinorConfidence": axis,
            "semiMajorOrientation": 0,
        },
        "altitude": {"altitudeValue": 800_001, "altitudeConfidence": "unavailable"},
    }


def _situation(denm: Denm) -> dict[str, Any]:
    found: dict[str, Any] = {
        "informationQuality": denm.quality,
        "eventType": {"causeCode": denm.cause, "subCauseCode": denm.sub_cause},
    }
    points = [
        delta for point in denm.history if (delta := _delta(denm.position, point)) is not None
    ][:POINTS]
    if points:
        found["eventHistory"] = [
            {"eventPosition": delta, "informationQuality": denm.quality} for delta in points
        ]
    return found


def _location(denm: Denm) -> dict[str, Any]:
    traces = [
        [
            {"pathPosition": delta}
            for point in trace
            if (delta := _delta(denm.position, point)) is not None
        ][:40]
        for trace in denm.traces[:7]
    ]
    found: dict[str, Any] = {"traces": traces or [[]]}
    if denm.heading is not None:
        tenths = round(10.0 * (denm.heading % 360.0)) % 3600
        found["eventPositionHeading"] = {"headingValue": tenths, "headingConfidence": 126}
    return found


def _delta(origin: Point, point: Point) -> dict[str, int] | None:
    north, east = (round(UNITS * (there - here)) for here, there in zip(origin, point, strict=True))
    if max(abs(north), abs(east)) > REACH:
        return None
    return {"deltaLatitude": north, "deltaLongitude": east, "deltaAltitude": 12_800}


def _record(message: Mapping[str, Any]) -> Denm:
    content = message["denm"]
    management = content["management"]
    situation = content.get("situation", {})
    place = management["eventPosition"]
    action = management["actionID"]
    position = (place["latitude"] / UNITS, place["longitude"] / UNITS)
    axis = place["positionConfidenceEllipse"]["semiMajorConfidence"]
    location = content.get("location", {})
    heading = location.get("eventPositionHeading", {"headingValue": UNAVAILABLE["heading"]})[
        "headingValue"
    ]
    event = situation.get("eventType", {"causeCode": 0, "subCauseCode": 0})
    return Denm(
        station=action["originatingStationID"],
        sequence=action["sequenceNumber"],
        sender=message["header"]["stationID"],
        detected=utc_of(management["detectionTime"]),
        referenced=utc_of(management["referenceTime"]),
        termination=management.get("termination"),
        position=position if place["latitude"] != UNAVAILABLE["latitude"] else (math.nan, math.nan),
        position_std=axis / 100.0 if axis != UNAVAILABLE["axis"] else math.nan,
        validity_s=management["validityDuration"],
        quality=situation.get("informationQuality", 0),
        cause=event["causeCode"],
        sub_cause=event["subCauseCode"],
        history=tuple(
            _point(position, one["eventPosition"]) for one in situation.get("eventHistory", ())
        ),
        traces=tuple(
            tuple(_point(position, one["pathPosition"]) for one in trace)
            for trace in location.get("traces", ())
        ),
        heading=None if heading == UNAVAILABLE["heading"] else heading / 10.0,
    )


def _point(origin: Point, delta: Mapping[str, int]) -> Point:
    return origin[0] + delta["deltaLatitude"] / UNITS, origin[1] + delta["deltaLongitude"] / UNITS


def approach(
    position: Point, heading: float, metres: tuple[float, ...] = (100.0, 300.0, 600.0)
) -> tuple[Point, ...]:
    """Return points of the way to an event along its heading [deg from north], nearest first."""
    north = math.cos(math.radians(heading))
    east = math.sin(math.radians(heading))
    width = METRES_PER_DEGREE * math.cos(math.radians(position[0]))
    return tuple(
        (position[0] - far * north / METRES_PER_DEGREE, position[1] - far * east / width)
        for far in metres
    )
