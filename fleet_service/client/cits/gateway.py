"""Running gateway: it sends the map's alerts to an interchange of cooperative ITS, and receives
hazard messages from it.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from fleet_service.client.cits.amqp import AmqpLink
from fleet_service.client.cits.denm import decode_denm
from fleet_service.client.cits.foreign import encode_reports
from fleet_service.client.cits.output import DenmOutput
from fleet_service.client.cits.properties import Originator
from fleet_service.client.datex_feed import DatexFeed, publish_alerts
from schemas import keys
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime.zenoh_session import open_session, quality_of
from schemas.wire import JSON

log = logging.getLogger(__name__)


class Sending(NamedTuple):
    """Settings for sending DENM (hazard messages): address at the interchange, identifier of the
    station, publisher, and file in which the state is saved.
    """

    target: str
    station: int
    originator: Originator
    state: Path


class Receiving(NamedTuple):
    """Settings for receiving DENM: address at the AMQP server, filter on the messages, and the
    vehicle name under which reports are made from received DENM.
    """

    source: str
    selector: str
    witness: str


class Witness:
    """Publisher that converts received DENM to reports of one vehicle name and publishes them on
    Zenoh.

    Attributes:
        refused: number of messages that are not a DENM.
        silent: number of DENM that say nothing about friction at present.
    """

    def __init__(
        self, session: zenoh.Session, name: str, clock: Callable[[], int] = time.time_ns
    ) -> None:
        self._session = session
        self._name = name
        self._clock = clock
        self._boot = secrets.randbits(63)
        self._seq = 1
        self.refused = 0
        self.silent = 0

    def close(self) -> None:
        """Close the publisher's Zenoh session."""
        self._session.close()

    def publish_report(self, body: bytes, _: Mapping[str, Any]) -> None:
        """Publish on Zenoh the report about friction that a received DENM contains."""
        try:
            batches = encode_reports(
                decode_denm(body), self._name, self._boot, self._seq, self._clock()
            )
        except InputError as error:
            self.refused += 1
            log.warning("a foreign message is ignored: %s", error)
            return
        self.silent += not batches
        for key, payload in batches:
            self._session.put(key, payload, encoding=JSON, **quality_of(keys.TOPICS["obs"]))
        self._seq += len(batches)


def run_gateway(
    connection: ZenohSettings,
    url: str,
    sending: Sending | None,
    receiving: Receiving | None,
    stop: threading.Event,
) -> None:
    """Send and receive DENM until `stop` is set.

    Raises:
        InputError: no service answers, a package is missing, or the file `sending.state` is damaged
            or belongs to another station.
    """
    witness = None
    if receiving is not None:
        session = open_session(connection, stop, receiving.witness)
        if session is None:
            return
        witness = Witness(session, receiving.witness)
    settled: list[Callable[[str], None]] = []
    link = AmqpLink(
        url,
        "" if sending is None else sending.target,
        "" if receiving is None else receiving.source,
        selector="" if receiving is None else receiving.selector,
        on_accepted=lambda name: settled[0](name),
        on_message=(lambda *_: None) if witness is None else witness.publish_report,
    )
    output = None
    if sending is not None:
        output = DenmOutput(sending.station, sending.originator, sending.state, link.send)
        settled.append(output.mark_accepted)
    link.open()
    try:
        if output is None:
            stop.wait()
        else:
            publish_alerts(connection, DatexFeed(output), stop)
    finally:
        link.close()
        if witness is not None:
            witness.close()
