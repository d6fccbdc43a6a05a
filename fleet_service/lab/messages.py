"""Simulated visits (passages of cells) encoded as messages, so that they pass through the service's
real admission.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fleet_service.ingest.inbox import Message
from fleet_service.lab.drive import rows_of
from fleet_service.lab.town import START, Visits
from schemas import grid, keys, wire
from schemas.numeric import IntArray
from schemas.thresholds import NS
from schemas.wire import Batch, Kind, decode

BATCH_ROWS = 12  # number of cells of one road


class SentMessage(NamedTuple):
    """Message of a simulated vehicle, and the index of the last visit that it reports."""

    message: Message
    last_visit: int


def name_of(vehicle: int) -> str:
    """Return the enrolled name of the simulated vehicle with this number."""
    return f"car-{vehicle:05d}"


def clock_of(seconds: float) -> int:
    """Return the time [ns] that the clock of the simulated service shows `seconds` [s] after the
    start of the drive.
    """
    return START + int(seconds * NS) + NS


def make_messages(visits: Visits) -> list[SentMessage]:
    """Return each vehicle's visits as messages with batches, in order of time per vehicle and
    region.
    """
    rows = rows_of(visits)
    out = []
    latitude, longitude = grid.centre(rows["cell"])
    order = np.lexsort((visits.seconds, rows["region"], visits.vehicle))
    streams = np.flatnonzero(np.diff(visits.vehicle[order]) | np.diff(rows["region"][order])) + 1
    for stream in np.split(order, streams):
        for seq, start in enumerate(range(0, len(stream), BATCH_ROWS), 1):
            out.append(
                _make_message(
                    visits, rows, latitude, longitude, stream[start : start + BATCH_ROWS], seq
                )
            )
    return out


def _make_message(
    visits: Visits,
    rows: dict[str, np.ndarray],
    latitude: np.ndarray,
    longitude: np.ndarray,
    part: IntArray,
    seq: int,
) -> SentMessage:
    n = len(part)
    columns: dict[str, np.ndarray] = {
        "enter_time": rows["leave_time"][part] - NS,
        "leave_time": rows["leave_time"][part],
        "cell": rows["cell"][part],
        "sector": rows["sector"][part],
        "latitude": latitude[part],
        "longitude": longitude[part],
        "position_std": np.full(n, 1.5),
        "yaw": np.zeros(n),
        "yaw_std": np.full(n, 0.02),
        "speed": np.full(n, 13.0),
        "mu_utilised": rows["mu_utilised"][part],
        "used_longitudinal": rows["used_longitudinal"][part],
        "used_lateral": rows["used_lateral"][part],
        "log_likelihood": rows["log_likelihood"][part],
    }
    vehicle = int(visits.vehicle[part[0]])
    region = int(rows["region"][part[0]])
    name = name_of(vehicle)
    batch = Batch(Kind.OBSERVATION, name, vehicle + 1, region, seq, 1, columns, "synthetic")
    key = keys.observation_key(region, name)
    return SentMessage(
        Message(Kind.OBSERVATION, key, wire.encode(batch), wire.ENCODING[Kind.OBSERVATION]),
        int(part[-1]),
    )


def forge_messages(message: Message, thief: int) -> tuple[Message, Message]:
    """Return two messages that an attacker (`thief`) makes from a message of another vehicle: the
    unchanged message under the attacker's own Zenoh key, and the same observations in a batch with
    the attacker's own name.
    """
    batch = decode(message.payload, message.encoding, message.kind)
    name = name_of(thief)
    key = keys.observation_key(batch.region, name)
    own = replace(batch, vehicle=name, boot=thief + 1)
    return message._replace(key=key), message._replace(key=key, payload=wire.encode(own))
