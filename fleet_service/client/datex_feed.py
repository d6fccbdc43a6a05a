"""DATEX II publication of the slippery stretches of road as a file: written once, or kept up to
date while alerts are raised and cleared.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import zenoh

from fleet_service.client.datex import Supplier, make_publication, same_but_for_time
from fleet_service.client.map_client import is_place_served, is_served, open_connected
from fleet_service.client.stretches import StretchAlert, Stretches
from fleet_service.client.watching import GATHER_S, REFRESH_S, standing_alerts
from schemas import grid, keys, query, wire
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.durable import open_durably


class DatexFile:
    """DATEX II publication (message for road authorities) that is stored in a file. Each version is
    made from the previous content of the file, so that the reported hazards keep their ids.

    Args:
        supplier: supplier of the publication.
        path: path of the file; a new publication is begun if the file does not exist.
        say: called with a line of text for the operator when the content changes.

    Raises:
        InputError: the file exists, but its content is not a publication that this class wrote.
    """

    def __init__(self, supplier: Supplier, path: Path, log_line: Callable[[str], None]) -> None:
        self._supplier = supplier
        self._path = path
        self._log_line = log_line
        self.document = path.read_bytes() if path.exists() else None
        self._written = 0.0
        if self.document is not None:
            make_publication(supplier, [], 0, self.document)

    @property
    def is_due(self) -> bool:
        """Return True if the DATEX II publication is so old that it must be written again."""
        return time.monotonic() >= self._written + REFRESH_S

    def keep_up(
        self, standing: list[StretchAlert], has_service: Callable[[float, float], bool]
    ) -> None:
        """Write the DATEX II publication if its content has changed, or if it is old.

        Args:
            standing: every stretch of road with an active alert.
            has_service: function that returns True if a service answers for a place (latitude,
                longitude).

        Raises:
            InputError: the file cannot be written; the attribute `document` is then already the new
                version.
        """
        before = self.document
        new = make_publication(self._supplier, standing, time.time_ns(), before, has_service)
        changed = before is None or not same_but_for_time(new, before)
        if not changed and not self.is_due:
            return
        self.document = new
        self._written = time.monotonic()
        with commandline.report_write_errors(self._path), open_durably(self._path) as file:
            file.write(new)
        if changed:
            self._log_line(f"{len(standing)} slippery stretches in {self._path}")


class StretchOutput(Protocol):
    """Interface of an output that publishes slippery stretches and is kept up to date."""

    @property
    def is_due(self) -> bool:
        """Return True if the output must be published again even though no alert has changed."""

    def keep_up(
        self, standing: list[StretchAlert], has_service: Callable[[float, float], bool]
    ) -> None:
        """Publish the stretches of road that have an active alert."""


class DatexFeed:
    """Updater that keeps a DATEX II publication consistent with received alerts.

    Args:
        file: the publication.
    """

    def __init__(self, file: StretchOutput) -> None:
        self._file = file
        self._stretches = Stretches()
        self._lock = threading.Lock()
        self._has_news = True
        self._served_tiles: dict[int, bool] = {}
        self._has_service: Callable[[float, float], bool] = lambda *_: False

    def apply_alert(self, alert: wire.Alert) -> None:
        """Record that an alert was raised, cleared, or repeated because it is still active."""
        with self._lock:
            self._stretches.apply_alert(alert)
            self._has_news = True

    def query_alerts(self, session: zenoh.Session) -> None:
        """Query all services for the active alerts, and replace the known alerts by the answer. A
        known alert that is missing from the answer is ended, unless no service answers for its
        place.
        """
        found = standing_alerts(session)
        self._served_tiles = {}

        def has_service(latitude: float, longitude: float) -> bool:
            tile = int(grid.tile_of(int(grid.cell_of(latitude, longitude))))
            if tile not in self._served_tiles:
                self._served_tiles[tile] = is_place_served(session, latitude, longitude)
            return self._served_tiles[tile]

        self._has_service = has_service
        with self._lock:
            self._stretches.replace_alerts(
                found, lambda alert: has_service(alert.latitude, alert.longitude)
            )
            self._has_news = True

    def write_if_due(self) -> None:
        """Write the DATEX II publication if alerts have changed, or if it is old.

        Raises:
            InputError: the file cannot be written.
        """
        with self._lock:
            if not self._has_news and not self._file.is_due:
                return
            self._has_news = False
            self._stretches.take_changes()
            standing = self._stretches.standing
        self._file.keep_up(standing, self._has_service)


def publish_alerts(
    connection: ZenohSettings, feed: DatexFeed, stop: threading.Event | None
) -> None:
    """Write the DATEX II publication of alerts once; with `stop`, keep it up to date until this
    event is set.

    Raises:
        InputError: no router answers, or no service answers at the start. Without a service the
            road must not be published as dry.
    """
    with open_connected(connection) as session:
        session.declare_subscriber(
            f"{keys.ROOT}/alert/**", lambda sample: _apply_sample(feed, sample)
        )
        if not is_served(session, query.parse({})):
            raise InputError(
                "connect",
                "no service answers for the map",
                "start one; published situations stay until a service answers",
            )
        feed.query_alerts(session)
        feed.write_if_due()
        looked = time.monotonic()
        while stop is not None and not stop.wait(GATHER_S):
            if time.monotonic() > looked + REFRESH_S:
                feed.query_alerts(session)
                looked = time.monotonic()
            feed.write_if_due()


def _apply_sample(feed: DatexFeed, sample: zenoh.Sample) -> None:
    feed.apply_alert(wire.decode_alert(sample.payload.to_bytes()))
