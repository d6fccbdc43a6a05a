"""Tests of the validation of messages: a bad row is refused with its reason, good rows are
accepted, and malicious bytes never stop the intake.
"""

from __future__ import annotations

import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.acks import Acks, consecutive_ranges
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.inbox import BatchIntake, Inbox, Message
from fleet_service.ingest.rate_limit import RateLimiter
from fleet_service.ingest.validation import Clock
from schemas import grid, wire
from schemas.proto.gripmap_pb2 import ObservationBatch
from schemas.wire import Kind
from tests.fleet_service.examples import CELL, LATITUDE, REGION, SECOND, batch, key

NOW = time.time_ns()
CLOCK = Clock(NOW, 30 * SECOND, 30 * 86_400 * SECOND)


@given(st.sets(st.integers(1, 40)))
def test_ranges_hold_exactly_their_numbers(numbers: set[int]) -> None:
    runs = consecutive_ranges(numbers)
    assert {n for first, last in runs for n in range(first, last + 1)} == numbers
    assert all(a[1] + 1 < b[0] for a, b in pairwise(runs))


class Desk:
    """Intake of messages as in a service, with its counters and acknowledgements, but without a
    running service.
    """

    def __init__(self, folder: Path) -> None:
        self.counts = ServiceCounts()
        self.acks = Acks()
        self.intake = BatchIntake(SequenceTrackers(), Pseudonyms(folder), self.counts, self.acks)

    def take(self, *messages: Message) -> int:
        """Process messages as the service does, and return the number of admitted rows."""
        return sum(
            len(accepted.rows["row"]) for accepted in self.intake.accept(messages, CLOCK).values()
        )

    def list_rejected(self) -> list[tuple[int, int, str]]:
        return [
            r
            for _, ack in self.acks.messages()
            for s in wire.decode_ack(ack)[1]
            for r in s.rejected
        ]


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def message(sent: wire.Batch, payload: bytes | None = None) -> Message:
    data = wire.encode(sent) if payload is None else payload
    return Message(Kind.OBSERVATION, key(sent.vehicle), data, wire.ENCODING[Kind.OBSERVATION])


def good(seq: int = 1, vehicle: str = "sim-001") -> wire.Batch:
    return batch(vehicle, seq, NOW - SECOND, [0.8, 0.7])


NEIGHBOUR = int(grid.neighbours(CELL)[0])
FAR = int(grid.cell_of(LATITUDE, 12.02))


def one(column: str, values: list[float]) -> dict[str, Any]:
    """Return keyword arguments of the function `batch` with these values for the named column."""
    return {column: values}


@pytest.mark.parametrize(
    ("column", "values", "rule"),
    [
        ("latitude", [np.nan, 57.7], "latitude"),
        ("latitude", [np.inf, 57.7], "latitude"),
        ("longitude", [191.0, 11.97], "longitude"),
        ("position_std", [-1.0, 1.0], "position_std"),
        ("yaw", [np.inf, 0.0], "yaw"),
        ("mu", [-0.1, 0.7], "mu"),
        ("mu", [0.3, 0.7], "mu"),
        ("mu_utilised", [np.inf, 0.5], "mu_utilised"),
        ("speed", [-1.0, 5.0], "speed"),
        ("sector", [4, 0], "sector"),
        ("sector", [2, 0], "sector"),
        ("tyre_season", [9, 0], "tyre_season"),
        ("abs_active", [2, 0], "abs_active"),
        ("esc_active", [-2, 0], "esc_active"),
        ("tcs_active", [2, 0], "tcs_active"),
        ("wiper", [1.5, 0.0], "wiper"),
        ("air_temperature", [99.0, 0.0], "air_temperature"),
        ("cell", [FAR, CELL], "cell"),
        ("cell", [-5, CELL], "cell"),
        ("enter_time", [NOW - 10**18, NOW], "time"),
        ("enter_time", [-(2**63), NOW - SECOND], "time"),
        ("leave_time", [NOW + 10**12, NOW], "time"),
        ("leave_time", [NOW - 10**12, NOW], "time"),
    ],
)
def test_a_bad_value_is_refused_with_its_row_and_a_reason(
    desk: Desk, column: str, values: list[float], rule: str
) -> None:
    assert (
        desk.take(message(batch("sim-001", 1, NOW - SECOND, [0.8, 0.7], **one(column, values))))
        == 0
    )
    assert desk.counts == ServiceCounts(refused=Counter({rule: 1}))
    ((seq, row, reason),) = desk.list_rejected()
    assert (seq, row) == (1, 0)
    assert ": " in reason
    assert "; " in reason


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("mu", [np.nan] * 2),
        ("yaw", [np.nan] * 2),
        ("speed", [np.nan] * 2),
        ("cell", [NEIGHBOUR] * 2),
        ("yaw", [1.0, -1.0]),
    ],
)
def test_absent_values_and_values_just_outside_are_admitted(
    desk: Desk, column: str, values: list[float]
) -> None:
    assert (
        desk.take(message(batch("sim-001", 1, NOW - SECOND, [0.8, 0.7], **one(column, values))))
        == 2
    )


def test_controllers_and_surroundings_are_taken_as_they_were_sent(desk: Desk) -> None:
    context: dict[str, Any] = {
        "abs_active": [1, -1],
        "esc_active": [0, 1],
        "wiper": [0.5, np.nan],
        "air_temperature": [-3.5, np.nan],
    }
    accepted = desk.intake.accept(
        [message(batch("sim-001", 1, NOW - SECOND, [0.8, 0.7], **context))], CLOCK
    )
    rows = accepted[Kind.OBSERVATION].rows
    for name, values in context.items():
        np.testing.assert_array_equal(rows[name], np.array(values, rows[name].dtype))
    assert rows["tcs_active"].tolist() == [-1, -1], "left out: unknown"


def test_a_bad_batch_among_good_ones_is_refused_alone(desk: Desk) -> None:
    bad = batch("sim-002", 1, NOW - SECOND, [0.8, 0.7], speed=[1.0, 1e9])
    assert desk.take(message(good()), message(bad), message(good(vehicle="sim-003"))) == 4
    assert desk.counts == ServiceCounts(refused=Counter({"speed": 1}))
    assert desk.list_rejected() == [
        (1, 1, "speed: lies outside [0, 100]; correct it at the source")
    ]


def test_repeated_batch_that_was_refused_is_refused_again(desk: Desk) -> None:
    bad = batch("sim-001", 1, NOW - SECOND, [0.8], speed=[1e9])
    for _ in range(2):
        assert desk.take(message(bad)) == 0
        assert len(desk.list_rejected()) == 1


def test_repeated_batch_is_admitted_once_at_any_service(desk: Desk) -> None:
    assert desk.take(message(good()), message(good())) == 2
    assert desk.take(message(good())) == 0
    assert desk.counts == ServiceCounts(duplicates=2)
    assert not desk.acks.messages(), "nothing of it is on disk yet"


def test_a_full_queue_drops_and_counts() -> None:
    counts = ServiceCounts()
    inbox = Inbox(2, counts, RateLimiter(1e6, 1e6, None, counts))
    for _ in range(5):
        inbox.put(message(good()))
    assert len(inbox.drain(0.0)) == 2
    assert counts == ServiceCounts(overload=3)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_mutation_of_a_batch_stops_the_intake_or_lets_nonsense_in(
    desk: Desk, data: st.DataObject
) -> None:
    payload = bytearray(wire.encode(good(data.draw(st.integers(1, 10**6)))))
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(payload) - 1))
        payload[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    accepted = desk.intake.accept(
        [message(good(), bytes(payload[cut:] if cut % 3 == 0 else payload))], CLOCK
    )
    for found in accepted.values():
        rows = found.rows
        assert np.isfinite(rows["latitude"]).all()
        assert (rows["leave_time"] <= NOW + CLOCK.ahead).all()
        assert (grid.region_of(rows["cell"]) == REGION).all()


@given(st.binary(max_size=200))
@example(b'{"seq": 1e400}')
@example(b"[" * 199)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_text_stops_the_intake(desk: Desk, payload: bytes) -> None:
    assert desk.take(Message(Kind.OBSERVATION, key("sim-001"), payload, wire.JSON)) == 0


def test_unusable_records_are_rejected_if_the_head_can_be_read(desk: Desk) -> None:
    """A batch with unusable records must be rejected if its head (all fields other than the
    records) can be read. Without a rejection, the vehicle would send the batch for ever. Its
    sequence number would stay missing, and the service stores at most 65536 numbers above a missing
    one. Therefore the service would in the end refuse all later batches of this vehicle.
    """
    pb = wire.parse(wire.encode(batch("sim-001", 7, NOW, [0.8, 0.8])), "", ObservationBatch, "")
    del pb.mu[1:]
    assert desk.take(message(batch("sim-001", 7, NOW, [0.8]), pb.SerializeToString())) == 0
    ((seq, row, reason),) = desk.list_rejected()
    assert (seq, row) == (7, -1)
    assert reason.startswith("mu: has 1 records")
    assert desk.counts.refused["mu"] == 1
    # With another vehicle's key the sender is unknown, so no rejection is sent.
    pb.vehicle = "sim-002"
    desk.take(message(batch("sim-001", 7, NOW, [0.8]), pb.SerializeToString()))
    desk.take(message(batch("sim-001", 7, NOW, [0.8]), b"\xff" * 40))
    assert desk.list_rejected() == []
    assert desk.counts.refused["payload"] == 1
