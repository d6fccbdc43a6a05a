"""Tests of DENM (hazard messages). Other encoders must write the same bytes. An event must keep its
number over restarts. The DENM of all other parties together must count as reports of one vehicle.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import proton
import pytest
from hypothesis import given, settings, strategies
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions

from fleet_service.app.engine import Engine
from fleet_service.client.cits.amqp import AmqpLink, Parcel
from fleet_service.client.cits.denm import (
    EPOCH_NS,
    ICE,
    LEAP_MS,
    SALTED,
    TERMINATIONS,
    Denm,
    Termination,
    approach_points,
    compiled_denm,
    decode_denm,
    encode_denm,
)
from fleet_service.client.cits.events import RENEW_NS, VALID_NS
from fleet_service.client.cits.foreign import encode_reports
from fleet_service.client.cits.output import DenmOutput
from fleet_service.client.cits.properties import Originator, message_properties
from fleet_service.client.stretches import StretchAlert
from fleet_service.ingest.inbox import Message
from schemas import grid
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.thresholds import NS
from schemas.wire import JSON, Kind
from tests.fleet_service.client.cits.interchange import free_url, interchange
from tests.fleet_service.examples import START
from tests.waiting import until

OURS = Originator("SE", "SE00001")
PLACE = (57.7, 11.97)


def random_denm(draw: np.random.Generator) -> Denm:
    """Return a random DENM (hazard message) with every field that the gateway can set."""
    position = (float(draw.uniform(-80, 80)), float(draw.uniform(-179, 179)))
    near = [
        (position[0] + float(draw.normal(0, 1e-3)), position[1] + float(draw.normal(0, 1e-3)))
        for _ in range(40)
    ]
    endings: list[Termination | None] = [None, None, "isCancellation", "isNegation"]
    termination = endings[int(draw.integers(0, 4))]
    heading = float(draw.uniform(0, 360)) if termination is None and draw.random() < 0.5 else None
    return Denm(
        station=int(draw.integers(1, 1 << 32)),
        sequence=int(draw.integers(0, 1 << 16)),
        sender=int(draw.integers(1, 1 << 32)),
        detected=START,
        referenced=START + int(draw.integers(0, 1 << 40)),
        termination=termination,
        position=position,
        position_std=float(draw.uniform(0, 60)),
        validity_s=int(draw.integers(0, 86_401)),
        quality=int(draw.integers(0, 8)),
        sub_cause=int(draw.integers(0, 11)),
        history=tuple(near[: int(draw.integers(0, 30))]),
        traces=(approach_points(position, heading or 0.0), *(((),) if draw.random() < 0.5 else ())),
        heading=heading,
    )


latitudes = strategies.floats(-89.9, 89.9)
longitudes = strategies.floats(-179.9, 179.9)
offsets = strategies.lists(
    strategies.tuples(
        strategies.integers(-140_000, 140_000), strategies.integers(-140_000, 140_000)
    ),
    max_size=45,
)
times = strategies.integers(EPOCH_NS, EPOCH_NS + (1 << 42) * 10**6 - LEAP_MS * 10**6 - 1)
stations = strategies.integers(0, (1 << 32) - 1)
bytes_of_causes = strategies.integers(0, 255)


@strategies.composite
def any_denm(draw: strategies.DrawFn) -> Denm:
    """Return a DENM (hazard message) with any content that its fields allow (Hypothesis
    strategy).
    """
    position = (draw(latitudes), draw(longitudes))

    def points() -> tuple[tuple[float, float], ...]:
        return tuple(
            (position[0] + 1e-7 * north, position[1] + 1e-7 * east) for north, east in draw(offsets)
        )

    return Denm(
        station=draw(stations),
        sequence=draw(strategies.integers(0, 65_535)),
        sender=draw(stations),
        detected=draw(times),
        referenced=draw(times),
        termination=draw(strategies.sampled_from([None, None, *TERMINATIONS])),
        position=position,
        position_std=draw(strategies.floats(0.0, 100.0)),
        validity_s=draw(strategies.integers(0, 86_400) | strategies.just(600)),
        quality=draw(strategies.integers(0, 7)),
        cause=draw(bytes_of_causes),
        sub_cause=draw(bytes_of_causes),
        history=points(),
        traces=tuple(points() for _ in range(draw(strategies.integers(0, 8)))),
        heading=draw(strategies.none() | strategies.floats(-360.0, 720.0)),
        both_ways=draw(strategies.booleans()),
    )


@settings(max_examples=300)
@given(any_denm())
def test_two_other_encoders_write_the_same_bytes(sent: Denm) -> None:
    data = encode_denm(sent)
    oracle = DENM_PDU_Descriptions.DENM
    oracle.from_uper(data)
    assert oracle.to_uper() == data
    general = compiled_denm()
    assert general.encode("DENM", general.decode("DENM", data)) == data
    management = oracle.get_val()["denm"]["management"]
    assert management["actionID"]["sequenceNumber"] == sent.sequence
    assert management["eventPosition"]["latitude"] == round(1e7 * sent.position[0])
    assert management.get("termination") == sent.termination


@settings(max_examples=300)
@given(any_denm())
def test_an_encoded_denm_is_read_as_it_was(sent: Denm) -> None:
    read = decode_denm(encode_denm(sent))
    for name in ("station", "sequence", "sender", "termination", "validity_s"):
        assert getattr(read, name) == getattr(sent, name), name
    assert read.detected == sent.detected // 10**6 * 10**6
    assert read.position == pytest.approx(sent.position, abs=6e-8)
    assert read.position_std == pytest.approx(min(sent.position_std, 16.73), abs=5e-3)
    if sent.termination is not None:
        return
    for name in ("quality", "cause", "sub_cause"):
        assert getattr(read, name) == getattr(sent, name), name
    assert (read.heading is None) == (sent.heading is None)
    assert read.both_ways == (sent.both_ways and sent.heading is not None)
    if read.heading is not None and sent.heading is not None:
        assert math.cos(math.radians(read.heading - sent.heading)) > 0.999
    for got, given_points, most in (
        (read.history, sent.history, 23),
        *((one, other, 40) for one, other in zip(read.traces, sent.traces, strict=False)),
    ):
        near = [
            point
            for point in given_points
            if max(abs(round(1e7 * (a - b))) for a, b in zip(point, sent.position, strict=True))
            <= 131_071
        ][:most]
        assert len(got) == len(near)
        assert np.allclose(got, near, rtol=0, atol=1.1e-7)


@pytest.mark.parametrize(
    "wrong",
    [
        {"station": 1 << 32},
        {"sequence": -1},
        {"validity_s": 1 << 17},
        {"quality": 8},
        {"position": (91.0, 400.0)},
    ],
)
def test_a_number_too_large_for_its_field_is_not_encoded(wrong: dict[str, Any]) -> None:
    denm = random_denm(np.random.default_rng(5))
    with pytest.raises(OverflowError):
        encode_denm(replace(denm, **{"termination": None, **wrong}))


def test_a_foreign_denm_with_further_containers_is_read() -> None:
    oracle = DENM_PDU_Descriptions.DENM
    oracle.from_uper(encode_denm(replace(random_denm(np.random.default_rng(1)), termination=None)))
    content = oracle.get_val()
    content["denm"]["alacarte"] = {"externalTemperature": -3}
    oracle.set_val(content)
    read = decode_denm(oracle.to_uper())
    assert read.sequence == content["denm"]["management"]["actionID"]["sequenceNumber"]
    assert read.history or "eventHistory" not in content["denm"]["situation"]


@pytest.mark.parametrize("data", [b"", b"\x02", bytes(40), b"no DENM at all"])
def test_bytes_that_are_no_denm_are_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="^payload: "):
        decode_denm(data)


def stretch(
    name: str, mu: float = 0.15, place: tuple[float, float] = PLACE, cells: int = 2
) -> StretchAlert:
    points = tuple((place[0] + 1e-4 * k, place[1]) for k in range(cells))
    return StretchAlert(
        name,
        "raised",
        START,
        START,
        20.0,
        "north-south",
        ("north",),
        *place,
        (0, 0, 0, 0),
        cells,
        mu,
        0.1,
        0.3,
        0.95,
        3,
        "",
        points,
    )


class Run:
    """Gateway output under test, with a simulated clock. The list `sent` collects the messages that
    the gateway sends. If `settles`, the simulated interchange (message broker) accepts them.
    """

    def __init__(self, path: Path, settles: bool = True) -> None:
        self.now = START
        self.sent = list[Parcel]()
        self.path = path
        self.settles = settles
        self.start()

    def start(self) -> None:
        self.output = DenmOutput(4711, OURS, self.path, self.sent.append, lambda: self.now)

    def step(self, *standing: StretchAlert, is_received: bool = True) -> list[Denm]:
        before = len(self.sent)
        self.output.keep_up(standing, lambda *_: is_received)
        fresh = self.sent[before:]
        for parcel in fresh if self.settles else ():
            self.output.mark_accepted(parcel.name)
        return [decode_denm(parcel.body) for parcel in fresh]


def test_an_event_keeps_its_number_over_restarts_until_it_is_cancelled(tmp_path: Path) -> None:
    run = Run(tmp_path / "cits.json")
    (begun,) = run.step(stretch("a"))
    assert (begun.sequence, begun.termination, begun.sub_cause) == (0, None, ICE)
    assert run.step(stretch("a")) == []
    run.start()
    assert run.step(stretch("a")) == [], "a restart says nothing twice"
    run.now += NS
    changed, other = run.step(stretch("a", cells=5), stretch("b", place=(57.8, 11.9)))
    assert (changed.sequence, other.sequence) == (0, 1)
    assert changed.referenced > begun.referenced
    run.now += RENEW_NS
    assert {
        one.sequence for one in run.step(stretch("a", cells=5), stretch("b", place=(57.8, 11.9)))
    } == {0, 1}
    run.start()
    assert run.step(stretch("b", place=(57.8, 11.9)), is_received=False) == [], (
        "no service answers there: nothing ends"
    )
    (ended,) = run.step(stretch("b", place=(57.8, 11.9)))
    assert (ended.sequence, ended.termination) == (0, "isCancellation")
    run.start()
    assert run.step(stretch("b", place=(57.8, 11.9))) == []
    assert [one.sequence for one in run.step(stretch("a"), stretch("b", place=(57.8, 11.9)))] == [
        2
    ], "a new event"
    assert begun.validity_s * NS == VALID_NS


def test_message_that_the_interchange_has_not_accepted_is_sent_again(tmp_path: Path) -> None:
    run = Run(tmp_path / "cits.json", settles=False)
    run.step(stretch("a"))
    run.now += NS
    run.step()
    first = list(run.sent)
    run.sent.clear()
    run.start()
    assert [(one.name, one.body) for one in run.sent] == [(one.name, one.body) for one in first]
    for parcel in first:
        run.output.mark_accepted(parcel.name)
    run.step()
    run.sent.clear()
    run.start()
    assert run.sent == []


def test_a_quadtree_selector_finds_all_events_of_a_square_and_no_other() -> None:
    draw = np.random.default_rng(7)
    places = draw.normal(PLACE, 0.2, (300, 2)).tolist()
    denms = [replace(random_denm(draw), position=tuple(place), history=()) for place in places]
    found = 0
    for zoom in (6, 9, 11, 13):
        for denm in denms[:20]:
            square = int(grid.parent(int(grid.cell_of(*denm.position)), zoom))
            selector = f",{grid.quadkey(square, zoom)}"
            for one in denms:
                within = int(grid.parent(int(grid.cell_of(*one.position)), zoom)) == square
                assert (selector in message_properties(one, OURS)["quadTree"]) == within
                found += within
    assert found > 300


def test_denm_reach_a_late_interchange_and_foreign_ones_are_received(tmp_path: Path) -> None:
    url = free_url()
    settled = list[str]()
    received = list[bytes]()
    foreign = encode_denm(replace(random_denm(np.random.default_rng(3)), termination=None))

    def keep(body: bytes, _: Mapping[str, Any]) -> None:
        received.append(body)

    link = AmqpLink(
        url, "deliveries", "subscriptions", on_accepted=settled.append, on_message=keep
    ).open()
    run = Run(tmp_path / "cits.json", settles=False)
    run.step(stretch("a"), stretch("b", place=(57.8, 11.9)))
    for parcel in run.sent:
        link.send(parcel)
    with interchange(url, [proton.Message(body=foreign, inferred=True)]) as peer:
        until(lambda: len(settled) == 2 and received)
        link.close()
    assert sorted(settled) == sorted(parcel.name for parcel in run.sent)
    assert [body for body, _ in peer.received] == [parcel.body for parcel in run.sent]
    assert all(
        given["messageType"] == "DENM" and given["causeCode"] == 6 for _, given in peer.received
    )
    assert received == [foreign]


@pytest.mark.campaign
def test_foreign_denm_alone_raise_no_alert(tmp_path: Path) -> None:
    denm = Denm(99, 1, 99, START, START, None, PLACE, 5.0, 3600, sub_cause=ICE, heading=0.0)
    engine = Engine(ServiceConfig(), tmp_path / "archive")
    try:
        for turn in range(10):
            now = START + 30 * turn * NS
            batches = encode_reports(
                replace(denm, referenced=now, sequence=turn), "cits-se", 5, 1 + turn, now
            )
            engine.intake.ingest(
                [Message(Kind.OBSERVATION, place, payload, JSON) for place, payload in batches], now
            )
        assert engine.counts.observations == 10, engine.counts
        assert engine.alerts.all == []
    finally:
        engine.close()


def _yaws(denm: Denm) -> list[float]:
    """Return the distinct yaw angles [deg], sorted, of the reports that the gateway makes from a
    DENM (hazard message).
    """
    batches = [json.loads(body) for _, body in encode_reports(denm, "cits-se", 5, 1, START)]
    return sorted({round(math.degrees(yaw)) % 360 for batch in batches for yaw in batch["yaw"]})


def test_a_foreign_denm_without_a_heading_means_both_directions() -> None:
    denm = Denm(99, 1, 99, START, START, None, PLACE, 5.0, 600, sub_cause=ICE)
    south = (PLACE[0] - 1e-3, PLACE[1])
    east = (PLACE[0], PLACE[1] + 1e-3)
    assert _yaws(denm) == [0, 90, 180, 270], "an unknown axis"
    assert _yaws(replace(denm, traces=((), (south,)))) == [90, 270]
    assert _yaws(replace(denm, history=(east, south))) == [0, 180]
    assert _yaws(replace(denm, traces=((south,),), heading=90.0)) == [0], "one direction"
    assert _yaws(replace(denm, heading=90.0, both_ways=True)) == [0, 180]


@pytest.mark.parametrize(
    ("direction", "heading", "both_ways"),
    [
        ("allTrafficDirections", 30.0, True),
        (None, 30.0, True),
        ("upstreamTraffic", 30.0, False),
        ("downstreamTraffic", 30.0, False),
        ("oppositeTraffic", 210.0, False),
    ],
)
def test_traffic_direction_of_a_foreign_denm_is_read(
    direction: str | None, heading: float, both_ways: bool
) -> None:
    denm = Denm(99, 1, 99, START, START, None, PLACE, 5.0, 600, sub_cause=ICE, heading=30.0)
    oracle = DENM_PDU_Descriptions.DENM
    oracle.from_uper(encode_denm(denm))
    content = oracle.get_val()
    del content["denm"]["management"]["relevanceTrafficDirection"]
    if direction is not None:
        content["denm"]["management"]["relevanceTrafficDirection"] = direction
    oracle.set_val(content)
    read = decode_denm(oracle.to_uper())
    assert (read.heading, read.both_ways) == (heading, both_ways)


def test_batches_of_an_event_are_numbered_and_short() -> None:
    history = tuple((PLACE[0], PLACE[1] + 3e-4 * k) for k in range(1, 23))
    denm = Denm(99, 1, 99, START, START, None, PLACE, 5.0, 600, sub_cause=ICE, history=history)
    batches = [json.loads(body) for _, body in encode_reports(denm, "cits-se", 5, 7, START)]
    assert sum(len(batch["mu"]) for batch in batches) == 2 * 23
    assert max(len(batch["mu"]) for batch in batches) <= 50
    assert [batch["seq"] for batch in batches] == [str(7 + k) for k in range(len(batches))]
    assert all(batch["first_held"] == batch["seq"] for batch in batches)


def test_denm_without_grip_makes_no_report() -> None:
    denm = Denm(99, 1, 99, START, START, None, PLACE, 5.0, 600, sub_cause=ICE, heading=0.0)
    report = json.loads(encode_reports(denm, "cits-se", 5, 1, START)[0][1])
    assert report["mu"] == [0.12]
    for other in (
        replace(denm, termination="isCancellation"),
        replace(denm, cause=1),
        replace(denm, sub_cause=SALTED),
        replace(denm, position_std=16.7),
    ):
        assert encode_reports(other, "cits-se", 5, 1, START) == []
    assert encode_reports(denm, "cits-se", 5, 1, START + 601 * NS) == []
