"""Events (hazards in the sense of DENM) of one originating station: the event number of each
stretch of road with an active alert, and the messages that must be sent. Pure (no I/O).

A stretch is one event from its first alert until the alerts of all its cells are over. The events
are saved to a file, so a restart of the program neither ends nor duplicates an event. An event is
sent when it begins, when it changes, before its validity ends, and once more when it is over.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from fleet_service.client.cits.denm import ICE, UNKNOWN_SLIPPERY, Denm, Termination, approach_points
from fleet_service.client.stretches import StretchAlert
from schemas import grid
from schemas.errors import InputError
from schemas.thresholds import NS

VALID_NS: Final = 1800 * NS  # [ns] as long as the service keeps an alert without confirmation
RENEW_NS: Final = VALID_NS // 2
ICE_MU: Final = 0.2  # below this friction, a DENM names ice
SEQUENCES: Final = 1 << 16
SURE: Final = 0.97  # P(slippery) from which the DENM's information quality is one level higher
CELL_STD: Final = 5.0  # [m] position error within a cell
# [ns] Time for which the number of an ended event is not used again.
TERMINATED_NS: Final = VALID_NS


@dataclass(frozen=True)
class OpenEvent:
    """Event (hazard) that has been sent to receivers.

    Attributes:
        name: id of the stretch of road.
        sequence: number of the event.
        detected, sent: time of the first detection, and of the last message [ns UTC].
        state: content of the last message, which is compared to detect changes.
        position: latitude and longitude [deg] of the event; never changed, so that all messages
            refer to the same place.
        ended: end of the event [ns UTC], 0 while it lasts.
    """

    name: str
    sequence: int
    detected: int
    sent: int
    state: tuple[float, ...]
    position: tuple[float, float]
    ended: int = 0


class EventBook:
    """All hazard events of a station that sends DENM (hazard messages).

    Args:
        station: identifier of the originating station.
        content: value of the property `content` that was saved before a restart; None for a station
            without events.

    Raises:
        InputError: the content belongs to another station or is not valid.
    """

    def __init__(self, station: int, content: dict[str, Any] | None = None) -> None:
        if not 0 < station < 1 << 32:
            raise InputError(
                "station", f"{station} is not a station identifier", "give 1 to 4294967295"
            )
        self.station = station
        self._next = 0
        self._events: dict[str, OpenEvent] = {}
        self._used: set[int] = set()  # event numbers in use
        if content is not None:
            self._restore_content(content)

    @property
    def content(self) -> dict[str, Any]:
        """Return all hazard events in a form that JSON supports, to be saved to a file."""
        return {
            "station": self.station,
            "next": self._next,
            "events": [vars(event) for event in self._events.values()],
        }

    def update(
        self,
        standing: Sequence[StretchAlert],
        now: int,
        has_service: Callable[[float, float], bool],
    ) -> list[Denm]:
        """Return the hazard messages (DENM) that are due now. Events at places for which no service
        answers are not ended, because their state is unknown.

        Args:
            standing: every stretch of road with an active alert.
            now: current time [ns UTC].
            has_service: function that returns True if a service answers for a place (latitude,
                longitude).
        """
        out: list[Denm] = []
        for name in [
            name
            for name, event in self._events.items()
            if event.ended and now - event.ended > TERMINATED_NS
        ]:
            self._used.discard(self._events.pop(name).sequence)
        for alert in standing:
            state = _reported_state(alert)
            known = self._events.get(alert.id)
            if known is None or known.ended:
                if known is not None:
                    self._used.discard(known.sequence)
                known = OpenEvent(
                    alert.id,
                    self._next_number(),
                    alert.since,
                    0,
                    (),
                    (alert.latitude, alert.longitude),
                )
            if known.state != state or now - known.sent >= RENEW_NS:
                self._events[alert.id] = OpenEvent(
                    known.name, known.sequence, known.detected, now, state, known.position
                )
                out.append(self._event_message(self._events[alert.id], alert, now))
        present = {alert.id for alert in standing}
        for name, event in list(self._events.items()):
            if name not in present and not event.ended and has_service(*event.position):
                out.append(self._end_event(event, now))
        return out

    def _end_event(self, event: OpenEvent, now: int) -> Denm:
        self._events[event.name] = OpenEvent(
            event.name, event.sequence, event.detected, now, event.state, event.position, now
        )
        return self._common_fields(event, now, "isCancellation")

    def _event_message(self, event: OpenEvent, alert: StretchAlert, now: int) -> Denm:
        one_way = len(alert.headings) == 1
        bearings = [90.0 - 90.0 * grid.HEADINGS.index(heading) for heading in alert.headings]
        return replace(
            self._common_fields(event, now, None),
            quality=min(7, 1 + alert.vehicles + int(alert.p_slippery > SURE)),
            sub_cause=ICE if alert.mu < ICE_MU else UNKNOWN_SLIPPERY,
            history=tuple(point for point in alert.points if point != event.position),
            traces=tuple(approach_points(event.position, bearing) for bearing in bearings),
            heading=bearings[0] % 360.0 if one_way else None,
        )

    def _common_fields(self, event: OpenEvent, now: int, termination: Termination | None) -> Denm:
        """Return a DENM of an event. Only the fields that every message of an event contains are
        set. Both the detection time and the reference time (the time of this version of the
        message) are `now` [ns UTC].
        """
        return Denm(
            self.station,
            event.sequence,
            self.station,
            now,
            now,
            termination,
            event.position,
            CELL_STD,
            VALID_NS // NS,
        )

    def _next_number(self) -> int:
        for _ in range(SEQUENCES):
            number = self._next
            self._next = (self._next + 1) % SEQUENCES
            if number not in self._used:
                self._used.add(number)
                return number
        raise InputError(
            "events",
            "all 65536 numbers of the station are in use",
            "use a second station identifier for a part of the alerts",
        )

    def _restore_content(self, content: dict[str, Any]) -> None:
        try:
            if content["station"] != self.station:
                problem = f"the file belongs to station {content['station']}"
                raise InputError("station", problem, "give that station or another file")
            self._next = int(content["next"])
            for one in content["events"]:
                both = {"state": tuple(one["state"]), "position": tuple(one["position"])}
                self._events[one["name"]] = OpenEvent(**{**one, **both})
                self._used.add(self._events[one["name"]].sequence)
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            fix = "move it away; its events end when their validity expires"
            raise InputError("state", "the file of events is damaged", fix) from error


def _reported_state(alert: StretchAlert) -> tuple[float, ...]:
    """Return the properties of an alert for which a change is reported to receivers: number of
    cells, length [m], 1 for ice (0 for another slippery road), and number of vehicles (at most 6).
    """
    return (
        float(alert.cells),
        round(alert.length_m),
        float(alert.mu < ICE_MU),
        float(min(alert.vehicles, 6)),
    )
