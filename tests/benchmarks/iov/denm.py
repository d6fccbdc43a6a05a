"""Benchmark of many DENM (hazard messages), sent through a message broker (interchange). A second
decoder checks each message, event numbers must survive restarts of the sender, and the message rate
is measured.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.client.cits.amqp import AmqpLink, Parcel
from fleet_service.client.cits.denm import compiled_denm, decode_denm, encode_denm
from fleet_service.client.cits.output import DenmOutput
from fleet_service.client.cits.properties import Originator
from fleet_service.client.stretches import StretchAlert
from schemas import grid
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from tests.fleet_service.client.cits.interchange import free_url, separate_interchange
from tests.waiting import until

START: Final = 1_700_000_000 * NS
STATION: Final = 4711
CENTRE: Final = (57.7, 11.97)


def _stretch(number: int, draw: np.random.Generator) -> StretchAlert:
    latitude, longitude = draw.normal(CENTRE, 0.2).tolist()
    points = tuple((latitude + 1e-4 * k, longitude) for k in range(int(draw.integers(1, 12))))
    return StretchAlert(
        f"s{number}",
        "raised",
        START,
        START,
        20.0,
        "north-south",
        ("north",),
        latitude,
        longitude,
        (0, 0, 0, 0),
        len(points),
        float(draw.uniform(0.1, 0.35)),
        0.1,
        0.4,
        0.95,
        int(draw.integers(2, 6)),
        "",
        points,
    )


def _count_and_send(parcels: list[Parcel], link: AmqpLink, parcel: Parcel) -> None:
    parcels.append(parcel)
    link.send(parcel)


class Transfer(NamedTuple):
    """One step of the benchmark: number of messages, and the time [s] and processor time [s] until
    the interchange has accepted them.
    """

    messages: int
    seconds: float
    processor_s: float


Received = list[tuple[bytes, dict[str, object]]]


def measure_denm(folder: Path, quick: bool) -> list[Figure]:
    """Simulate hazard events (DENM) that begin, change and end, and restart the gateway after each
    step.

    Return as figures the numbers of invalid messages and of events that were duplicated or never
    ended, and the message rates. A further figure counts errors of the filter `quadTree`, with
    which a receiver selects the events in a map square.
    """
    events = 500 if quick else 2000
    transfers, received = _send_events(folder / "cits.json", events)
    whole = [transfer for transfer in transfers if transfer.messages > events // 4]
    rate = max(one.messages / one.seconds for one in whole)
    processor_rate = max(one.messages / one.processor_s for one in whole)
    return [
        *_check_received(received, events),
        Figure("denm.per_s", rate, "messages/s, encoded, sent and accepted", 2000.0, "more"),
        Figure(
            "denm.per_processor_s",
            processor_rate,
            "messages for each second of the gateway's processor time",
        ),
        Figure(
            "denm.encode_speedup",
            _encode_speedup([body for body, _ in received]),
            "times the general encoder's rate, in one run",
            3.0,
            "more",
        ),
    ]


def _send_events(path: Path, events: int) -> tuple[list[Transfer], Received]:
    """Send all events, changes of every second one, the ends of the first half and the ends of the
    others. Each step uses a new gateway with the state file `path`. Return the transfers, and the
    messages that the interchange received.
    """
    draw = np.random.default_rng(4202)
    url = free_url()
    path.unlink(missing_ok=True)
    now = [START]
    stretches = [_stretch(number, draw) for number in range(events)]
    steps = [
        stretches,
        [replace(one, cells=one.cells + 1) if k % 2 else one for k, one in enumerate(stretches)],
        stretches[events // 2 :],
        [],
    ]
    transfers: list[Transfer] = []
    received: Received = []
    with separate_interchange(url) as peer:
        for standing in steps:
            settled: list[str] = []
            link = AmqpLink(url, "deliveries", on_accepted=settled.append).open()
            until(lambda link=link: link.is_connected)  # type: ignore[misc]
            parcels: list[Parcel] = []
            send = partial(_count_and_send, parcels, link)
            output = DenmOutput(STATION, Originator("SE", "SE00001"), path, send, lambda: now[0])
            now[0] += NS
            before = len(received)
            began = time.perf_counter()
            processor_began = time.process_time()
            output.keep_up(standing, lambda *_: True)
            sent = len(parcels)
            until(lambda settled=settled, sent=sent: len(settled) >= sent)  # type: ignore[misc]
            worked = time.process_time() - processor_began
            transfers.append(Transfer(sent, time.perf_counter() - began, worked))
            for name in settled:
                output.mark_accepted(name)
            output.keep_up(standing, lambda *_: True)
            link.close()
            peer.send(True)
            received = peer.recv()
            assert len(received) - before == sent
    return transfers, received


def _check_received(received: Received, events: int) -> list[Figure]:
    """Return the figures about the received messages. A second decoder checks each message."""
    from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions

    oracle = DENM_PDU_Descriptions.DENM
    invalid = 0
    first: dict[int, tuple[float, float]] = {}
    doubled = 0
    last: dict[int, str | None] = {}
    for body, _ in received:
        oracle.from_uper(body)
        invalid += oracle.to_uper() != body
        denm = decode_denm(body)
        doubled += first.setdefault(denm.sequence, denm.position) != denm.position
        last[denm.sequence] = denm.termination
    unterminated = sum(end is None for end in last.values())
    different = "messages that a second decoder does not write byte for byte"
    return [
        Figure("denm.invalid", float(invalid), different, 0.0),
        Figure(
            "denm.duplicated", float(doubled + len(first) - events), "events over restarts", 0.0
        ),
        Figure("denm.unterminated", float(unterminated), "events over restarts", 0.0),
        Figure(
            "denm.selector",
            float(_selected_wrongly(received)),
            "events of a quadTree selector",
            0.0,
        ),
        Figure("denm.events", float(len(first)), "events", 100.0, "more"),
    ]


def _encode_speedup(bodies: list[bytes]) -> float:
    """Encode the given DENM (hazard messages) with the library asn1tools and with our encoder.
    Return the processor time of asn1tools divided by ours.
    """
    general = compiled_denm()
    contents = [general.decode("DENM", body) for body in bodies]
    records = [decode_denm(body) for body in bodies]
    began = time.process_time()
    theirs = [general.encode("DENM", content, check_types=False) for content in contents]
    between = time.process_time()
    ours = [encode_denm(record) for record in records]
    ended = time.process_time()
    assert [bytes(one) for one in theirs] == ours == bodies
    return (between - began) / (ended - between)


def _selected_wrongly(received: Received) -> int:
    """Test the filter `quadTree LIKE '%,DIGITS%'` by which a receiver selects the events in a map
    square; DIGITS is the number of the square. Return the number of errors: events outside the
    square that it selects, or events inside that it omits.
    """
    wrong = 0
    squares = set[tuple[int, int]]()
    denms = [(decode_denm(body), given) for body, given in received]
    lasting = [(denm, given) for denm, given in denms if denm.termination is None]
    for denm, _ in lasting[:10]:
        for zoom in (8, 11, 14):
            squares.add((zoom, int(grid.cell_of(*denm.position, zoom=zoom))))
    for zoom, square in squares:
        digits = f",{grid.quadkey(square, zoom)}"
        for denm, given in lasting:
            inside = any(
                int(grid.cell_of(*point, zoom=zoom)) == square
                for point in (denm.position, *denm.history)
            )
            wrong += (digits in str(given["quadTree"])) != inside
    return wrong
