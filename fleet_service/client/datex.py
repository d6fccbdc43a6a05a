"""Slippery stretches as a DATEX II publication (version 3) for a National Access Point. Pure (no
I/O).

A stretch is published as a situation "temporary slippery road", which is category (a) of the
safety-related traffic information in Regulation (EU) 886/2013. Its condition is `slippery`, never
`ice`, because the map knows the friction but not its cause. A situation keeps its id; the version
of its record increases with every change. When the alert is over, the record is published with its
end time for another KEPT_S.

Each publication is made from the previous one and the active alerts; no other state must be stored.
"""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Literal

from fleet_service.client.stretches import StretchAlert, format_time
from schemas import grid
from schemas.errors import InputError
from schemas.thresholds import NS, SLIPPERY_MU, Z_95

# [s] Time for which an ended situation stays published, so that clients that poll every few minutes
# see its end.
KEPT_S: Final = 3600
INTERVAL_STD: Final = 2.0 * Z_95  # width of a 90 % interval in standard deviations
# P(slippery) from which a situation is published as certain, or as probable
CERTAIN = 0.97
PROBABLE = 0.8
DIGITS: Final = 6  # decimal places of a degree: .1 m, while cells have 10 m
_XSI: Final = "http://www.w3.org/2001/XMLSchema-instance"
_SPACES: Final = {
    "d2": "http://datex2.eu/schema/3/d2Payload",
    "com": "http://datex2.eu/schema/3/common",
    "sit": "http://datex2.eu/schema/3/situation",
    "loc": "http://datex2.eu/schema/3/locationReferencing",
    "xsi": _XSI,
}
_BEARINGS: Final = {
    name: (90.0 - 90.0 * sector) % 360.0 for sector, name in enumerate(grid.HEADINGS)
}


@dataclass(frozen=True)
class Supplier:
    """Supplier of a DATEX II publication.

    Attributes:
        country: two letters, ISO 3166.
        name: name of the supplier at its National Access Point.
        status: real, or one of the kinds of exercise of the standard.

    Raises:
        InputError: the country is not valid, or the name is empty.
    """

    country: str
    name: str
    status: Literal["real", "test", "technicalExercise", "securityExercise"] = "test"

    def __post_init__(self) -> None:
        """Check the supplier's country and name; raise InputError if one is not valid."""
        if not re.fullmatch("[a-z]{2}", self.country):
            raise InputError(
                "country", f"{self.country!r} is not a country code", "give two letters, e.g. se"
            )
        if not self.name.strip():
            raise InputError("supplier", "is empty", "give the supplier's name at the access point")


def make_publication(
    supplier: Supplier,
    standing: list[StretchAlert],
    now: int,
    before: bytes | None = None,
    has_service: Callable[[float, float], bool] = lambda *_: True,
) -> bytes:
    """Return the publication at time `now` as an XML document.

    Args:
        supplier: supplier of the publication.
        standing: all road stretches with an active alert.
        now: current time [ns UTC].
        before: the previous publication; None to start a new one.
        has_service: function that returns True if a service answers for a place (latitude,
            longitude). Situations at other places are not ended.

    Raises:
        InputError: `before` is not a publication, or is that of another supplier.
    """
    old = {} if before is None else _parse_records(before, supplier)
    root = _make_payload(supplier, now)
    written: set[str] = set()
    for alert in standing:
        known = alert.id if alert.id in old else _same_place(alert, old, written)
        record = _make_record(alert, known or alert.id, now)
        if known is not None:
            record = _next_version(record, old[known])
        written.add(record.get("id", ""))
        root.append(_make_situation(supplier, record))
    for name, record in old.items():
        if name in written:
            continue
        place = (
            float(child.text or "nan")
            for child in _find_element(record, "sit:locationReference/loc:coordinatesForDisplay")
        )
        ended = _end_record(record, now) if _has_ended(record) or has_service(*place) else record
        if ended is not None:
            root.append(_make_situation(supplier, ended))
    return _serialise_payload(root)


def _make_payload(supplier: Supplier, now: int) -> ET.Element:
    """Return a publication of the time `now` [ns UTC] without situations."""
    root = ET.Element(
        _qualified_name("d2:payload"),
        {
            _qualified_name("xsi:type"): "sit:SituationPublication",
            "lang": "en",
            "modelBaseVersion": "3",
        },
    )
    _add_text(root, "com:publicationTime", format_time(now))
    creator = ET.SubElement(root, _qualified_name("com:publicationCreator"))
    _add_text(creator, "com:country", supplier.country)
    _add_text(creator, "com:nationalIdentifier", supplier.name)
    return root


def _serialise_payload(root: ET.Element) -> bytes:
    ET.indent(root)
    text = bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"
    # The payload's type needs this namespace even if there is no situation.
    used = f'xmlns:sit="{_SPACES["sit"]}"'.encode()
    return text if used in text else text.replace(b"<d2:payload ", b"<d2:payload " + used + b" ", 1)


def same_but_for_time(one: bytes, other: bytes) -> bool:
    """Return True if two DATEX II publications are equal except for their publication time."""
    cut = re.compile(rb"<com:publicationTime>[^<]*</com:publicationTime>")
    return cut.sub(b"", one) == cut.sub(b"", other)


def _make_record(alert: StretchAlert, name: str, now: int) -> ET.Element:
    record = ET.Element(
        _qualified_name("sit:situationRecord"),
        {
            _qualified_name("xsi:type"): "sit:WeatherRelatedRoadConditions",
            "id": name,
            "version": "1",
        },
    )
    _add_text(record, "sit:situationRecordCreationTime", format_time(now))
    _add_text(record, "sit:situationRecordObservationTime", format_time(alert.time))
    _add_text(record, "sit:situationRecordVersionTime", format_time(now))
    _add_text(record, "sit:probabilityOfOccurrence", _probability_word(alert.p_slippery))
    _add_text(record, "sit:severity", "high" if alert.mu < SLIPPERY_MU / 2 else "medium")
    _add_text(record, "sit:safetyRelatedMessage", "true")
    source = ET.SubElement(record, _qualified_name("sit:source"))
    _add_english_text(
        source, "com:sourceName", "GripMap: peak friction estimated from the motion of vehicles"
    )
    _add_text(source, "com:sourceType", "vehicleProbeMeasurement")
    validity = ET.SubElement(record, _qualified_name("sit:validity"))
    _add_text(validity, "com:validityStatus", "active")
    period = ET.SubElement(validity, _qualified_name("com:validityTimeSpecification"))
    _add_text(period, "com:overallStartTime", format_time(alert.since))
    record.append(_make_location(alert))
    _add_text(record, "sit:weatherRelatedRoadConditionType", "slippery")
    measured = ET.SubElement(record, _qualified_name("sit:roadSurfaceConditionMeasurements"))
    friction = ET.SubElement(
        measured,
        _qualified_name("com:friction"),
        {
            "numberOfInputValuesUsed": str(alert.vehicles),
            "standardDeviation": f"{(alert.mu_upper - alert.mu_lower) / INTERVAL_STD:.3f}",
        },
    )
    _add_text(friction, "com:friction", f"{alert.mu:.2f}")
    return record


def _probability_word(p_slippery: float) -> str:
    """Return the DATEX II word for the probability that the road is slippery."""
    if p_slippery > CERTAIN:
        return "certain"
    if p_slippery > PROBABLE:
        return "probable"
    return "riskOf"


def _make_location(alert: StretchAlert) -> ET.Element:
    """Return the DATEX II location element of a stretch of road: a line from end to end in driving
    direction, or a point if the stretch is one cell.
    """
    points = list(alert.points)
    line = len(alert.points) > 1
    kind = "loc:LinearLocation" if line else "loc:PointLocation"
    place = ET.Element(
        _qualified_name("sit:locationReference"), {_qualified_name("xsi:type"): kind}
    )
    _add_coordinates(place, "loc:coordinatesForDisplay", alert.latitude, alert.longitude)
    about = ET.SubElement(place, _qualified_name("loc:supplementaryPositionalDescription"))
    _add_text(about, "loc:lengthAffected", f"{alert.length_m:.0f}")
    _add_english_text(
        about,
        "loc:locationDescription",
        f"{alert.direction}; vehicles heading {' and '.join(alert.headings)}",
    )
    if line:
        north = points[-1][0] - points[0][0]
        east = points[-1][1] - points[0][1]
        along = {"north": north, "south": -north, "east": east, "west": -east}
        points = points if along[alert.headings[0]] >= 0.0 else points[::-1]
        drawn = ET.SubElement(
            place, _qualified_name("loc:gmlLineString"), {"srsName": "urn:ogc:def:crs:EPSG::4326"}
        )
        _add_text(
            drawn,
            "loc:posList",
            " ".join(f"{value:.{DIGITS}f}" for point in points for value in point),
        )
    else:
        point = ET.SubElement(place, _qualified_name("loc:pointByCoordinates"))
        if len(alert.headings) == 1:
            _add_text(point, "loc:bearing", f"{_BEARINGS[alert.headings[0]]:.0f}")
        _add_coordinates(point, "loc:pointCoordinates", *points[0])
    return place


def _next_version(record: ET.Element, old: ET.Element) -> ET.Element:
    """Return the DATEX II `record` with the version number after that of the record `old`. If only
    times differ, return `old`.
    """
    for tag in (
        "sit:situationRecordCreationTime",
        "sit:validity/com:validityTimeSpecification/com:overallStartTime",
    ):
        _find_element(record, tag).text = _find_element(old, tag).text
    times = ("sit:situationRecordVersionTime", "sit:situationRecordObservationTime")
    compared = [copy.deepcopy(one) for one in (record, old)]
    for one in compared:
        one.set("version", "")
        for tag in times:
            _find_element(one, tag).text = ""
    if _canonical_bytes(compared[0]) == _canonical_bytes(compared[1]):
        return old
    record.set("version", str(int(old.get("version", "0")) + 1))
    return record


def _end_record(record: ET.Element, now: int) -> ET.Element | None:
    """Return a DATEX II record with `now` [ns] as its end time; a record that already has an end
    time keeps it. Return None if the end was published long ago and need not be repeated.
    """
    period = _find_element(record, "sit:validity/com:validityTimeSpecification")
    end = period.find("com:overallEndTime", _SPACES)
    if end is not None:
        at = datetime.fromisoformat(end.text or "").timestamp()
        return record if now / NS - at < KEPT_S else None
    _add_text(period, "com:overallEndTime", format_time(now))
    _find_element(record, "sit:validity/com:validityStatus").text = "definedByValidityTimeSpec"
    _find_element(record, "sit:situationRecordVersionTime").text = format_time(now)
    record.set("version", str(int(record.get("version", "0")) + 1))
    return record


def _has_ended(record: ET.Element) -> bool:
    return record.find(".//com:overallEndTime", _SPACES) is not None


def _same_place(alert: StretchAlert, old: dict[str, ET.Element], written: set[str]) -> str | None:
    """Return the id of the situation (hazard) in the previous publication that belongs to the
    stretch of road of `alert`; None if there is none. The situation must not have ended, and must
    contain a cell of the stretch. Cells are compared instead of names, because a client gives a
    stretch another name after a restart.

    Args:
        alert: stretch of road with an active alert.
        old: records of the previous publication by id.
        written: ids that the new publication already contains; they are skipped.
    """
    cells = {
        f"{latitude:.{DIGITS}f} {longitude:.{DIGITS}f}" for latitude, longitude in alert.points
    }
    for name, record in old.items():
        if name not in written and not _has_ended(record) and cells & _cell_coordinates(record):
            return name
    return None


def _cell_coordinates(record: ET.Element) -> set[str]:
    words = (record.findtext(".//loc:posList", "", _SPACES)).split()
    point = record.find(".//loc:pointCoordinates", _SPACES)
    if point is not None:
        words = [f"{float(child.text or 'nan'):.{DIGITS}f}" for child in point]
    return {
        f"{latitude} {longitude}"
        for latitude, longitude in zip(words[::2], words[1::2], strict=True)
    }


def _parse_records(document: bytes, supplier: Supplier) -> dict[str, ET.Element]:
    """Return the situation records (hazards) of a supplier's DATEX II publication by id."""
    problem = InputError("out", "is not a publication of this command", "name another file")
    try:
        root = ET.fromstring(document)
    except ET.ParseError as error:
        raise problem from error
    if (
        root.tag != _qualified_name("d2:payload")
        or root.get(_qualified_name("xsi:type")) != "sit:SituationPublication"
    ):
        raise problem
    creator = root.find("com:publicationCreator", _SPACES)
    names = ("com:country", "com:nationalIdentifier")
    former = (
        tuple(creator.findtext(name, "", _SPACES) for name in names) if creator is not None else ()
    )
    if former not in ((), (supplier.country, supplier.name)):
        raise InputError(
            "supplier",
            f"the file is the publication of {' '.join(former)}",
            "give each supplier a file of its own (--out)",
        )
    return {
        record.get("id", ""): record for record in root.iterfind(".//sit:situationRecord", _SPACES)
    }


def _make_situation(supplier: Supplier, record: ET.Element) -> ET.Element:
    situation = ET.Element(
        _qualified_name("sit:situation"), {"id": f"situation-{record.get('id')}"}
    )
    _add_text(
        situation,
        "sit:situationVersionTime",
        _find_element(record, "sit:situationRecordVersionTime").text or "",
    )
    header = ET.SubElement(situation, _qualified_name("sit:headerInformation"))
    _add_text(header, "com:informationStatus", supplier.status)
    situation.append(record)
    return situation


def _add_coordinates(parent: ET.Element, tag: str, latitude: float, longitude: float) -> None:
    point = ET.SubElement(parent, _qualified_name(tag))
    _add_text(point, "loc:latitude", f"{latitude:.{DIGITS}f}")
    _add_text(point, "loc:longitude", f"{longitude:.{DIGITS}f}")


def _add_english_text(parent: ET.Element, tag: str, text: str) -> None:
    values = ET.SubElement(
        ET.SubElement(parent, _qualified_name(tag)), _qualified_name("com:values")
    )
    ET.SubElement(values, _qualified_name("com:value"), {"lang": "en"}).text = text


def _add_text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, _qualified_name(tag)).text = text


def _find_element(element: ET.Element, path: str) -> ET.Element:
    found = element.find(path, _SPACES)
    if found is None:
        raise InputError("out", f"contains a record without {path}", "name another file")
    return found


def _canonical_bytes(element: ET.Element) -> bytes:
    ET.indent(element)
    element.tail = None
    return bytes(ET.tostring(element))


def _qualified_name(tag: str) -> str:
    prefix, _, local = tag.partition(":")
    return f"{{{_SPACES[prefix]}}}{local}"


for _prefix, _space in _SPACES.items():
    ET.register_namespace(_prefix, _space)
