"""Tests of the publisher on real sessions. Every record must arrive once under its vehicle's name,
and be settled (removed from the outbox) by an answer.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge_agent.app.live_loop import Progress
from edge_agent.app.metrics import health_problems
from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.publish.batching import Batcher, Draft
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.publisher import Publisher
from schemas import grid, keys
from schemas.config import AgentConfig, ZenohSettings
from schemas.thresholds import NS
from schemas.wire import Batch, Kind, StreamAck, encode_ack
from tests.edge_agent.fakes import Watch, estimates, wanderers
from tests.edge_agent.service import Router, Service
from tests.waiting import PATIENCE_S, until

NAMES = ("car-a", "car-b", "car-c")
Make = Callable[..., Publisher]


def drive(seed: int = 0, samples: int = 200) -> tuple[RecordBlock, RecordBlock]:
    """Return the observations and the states (two blocks of records) of a random simulated drive by
    three vehicles.
    """
    _, observations, states = Watch.of(3).step(
        wanderers(samples, 3, seed), estimates(samples, 3, seed, mu=0.8)
    )
    return observations, states


def rows(batches: list[Batch], kind: Kind) -> int:
    """Return the number of records of a kind in the received batches. A batch that arrived
    repeatedly counts once.
    """
    return sum(
        {(b.vehicle, b.boot, b.region, b.seq): b.rows for b in batches if b.kind is kind}.values()
    )


def settings(router: Router, tmp_path: Path, **changes: object) -> AgentConfig:
    quick = {"flush_s": 0.05, "resend_s": 0.2, "spool": tmp_path / "spool.sqlite"}
    return AgentConfig.model_validate({"zenoh": router.settings, **quick, **changes})


def publisher_of(config: AgentConfig, names: tuple[str, ...] = NAMES) -> Publisher:
    publisher = Publisher(
        names, Outbox(config.spool, first_resend_s=config.resend_s), config, "test"
    )
    publisher.start()
    return publisher


def test_every_record_arrives_once_under_its_vehicles_key_and_is_settled(
    router: Router, service: Service, tmp_path: Path
) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    observations, states = drive()
    publisher.offer(observations, states)
    until(lambda: publisher.counts.acknowledged[Kind.STATE] == len(states.vehicle))
    assert publisher.close(within_s=PATIENCE_S)
    assert publisher.count_unsettled() == 0
    assert rows(service.batches, Kind.OBSERVATION) == len(observations.vehicle)
    assert rows(service.batches, Kind.STATE) == len(states.vehicle)
    for key, batch in zip(service.keys, service.batches, strict=True):
        parsed = keys.parse(key)
        assert (parsed.name, parsed.quadint, parsed.topic.name) == (
            batch.vehicle,
            batch.region,
            batch.kind,
        )
        assert batch.estimator == "test"


def test_columns_arrive_as_they_were_observed(
    router: Router, service: Service, tmp_path: Path
) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    publisher.offer(observations)
    assert publisher.close(within_s=PATIENCE_S)
    for n, name in enumerate(NAMES):
        mine = sorted(
            (b for b in service.batches if b.vehicle == name), key=lambda b: (b.region, b.seq)
        )
        regions = grid.region_of(observations.columns["cell"])
        order = np.lexsort([np.arange(len(regions)), regions])
        chosen = order[observations.vehicle[order] == n]
        for column, sent in observations.columns.items():
            received = np.concatenate([b.columns[column] for b in mine])
            assert np.array_equal(received, sent[chosen], equal_nan=sent.dtype.kind == "f"), column


def test_unanswered_batches_are_sent_again_until_answered(
    router: Router, service: Service, tmp_path: Path
) -> None:
    service.answer = False
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    publisher.offer(observations)
    service.wait(lambda batches: len(batches) > len({b.seq for b in batches}) + 6)
    service.answer = True
    assert publisher.close(within_s=PATIENCE_S)
    assert publisher.count_unsettled() == 0
    assert publisher.counts.resent_batches >= 3
    assert publisher.counts.acknowledged[Kind.OBSERVATION] == len(observations.vehicle)
    assert rows(service.batches, Kind.OBSERVATION) == len(observations.vehicle)


def test_agent_waits_for_a_lost_router_and_loses_no_record(router: Router, tmp_path: Path) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    before = drive(1)[0]
    after = drive(2)[0]
    with Service(router) as service:
        publisher.offer(before)
        service.wait(lambda batches: rows(batches, Kind.OBSERVATION) == len(before.vehicle))
    until(lambda: publisher.status.links == len(NAMES))
    router.stop()
    publisher.offer(after)
    until(lambda: publisher.count_unsettled() >= len(after.vehicle))
    router.start()
    with Service(router) as service:
        until(lambda: publisher.count_unsettled() == 0)
        assert rows(service.batches, Kind.OBSERVATION) >= len(after.vehicle)
    assert publisher.close(within_s=2.0)


def test_an_agent_may_start_before_the_router(tmp_path: Path) -> None:
    router = Router()
    router.stop()
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    publisher.offer(observations)
    until(lambda: publisher.count_unsettled() == len(observations.vehicle))
    assert publisher.status.links == 0
    router.start()
    with Service(router) as service:
        until(lambda: publisher.count_unsettled() == 0)
        assert rows(service.batches, Kind.OBSERVATION) == len(observations.vehicle)
    assert publisher.close(within_s=2.0)
    router.stop()


def config_without_router(folder: Path) -> AgentConfig:
    unreachable = ZenohSettings(connect=["tcp/127.0.0.1:9"])
    return AgentConfig(zenoh=unreachable, spool=folder / "spool.sqlite", flush_s=0.05)


def test_without_a_router_it_exits_in_time_and_keeps_everything(tmp_path: Path) -> None:
    config = config_without_router(tmp_path)
    publisher = publisher_of(config)
    observations, _ = drive()
    publisher.offer(observations)
    assert publisher.close(within_s=0.5)
    assert publisher.count_unsettled() == len(observations.vehicle)
    again = Outbox(config.spool)
    assert again.held.count_records(set(NAMES)) == len(observations.vehicle)
    again.close()


def test_batches_of_an_earlier_start_are_sent_under_their_old_identity(
    router: Router, service: Service, tmp_path: Path
) -> None:
    service.answer = False
    config = settings(router, tmp_path)
    first = publisher_of(config)
    observations, _ = drive()
    first.offer(observations)
    service.wait(lambda batches: rows(batches, Kind.OBSERVATION) == len(observations.vehicle))
    first.close(within_s=0.1)
    earlier = set(service.identities())
    service.batches.clear()
    service.answer = True
    second = publisher_of(config)
    assert second.close(within_s=PATIENCE_S)
    assert set(service.identities()) == earlier
    assert second.count_unsettled() == 0


def test_a_rejected_batch_is_settled_counted_and_logged(
    router: Router, service: Service, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    service.refuse = lambda batch: "speed" if batch.vehicle == "car-b" else None
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    theirs = int((observations.vehicle == 1).sum())
    with caplog.at_level(logging.WARNING):
        publisher.offer(observations)
        assert publisher.close(within_s=PATIENCE_S)
    assert publisher.count_unsettled() == 0
    assert publisher.counts.rejected[Kind.OBSERVATION] == theirs
    assert publisher.counts.acknowledged[Kind.OBSERVATION] == len(observations.vehicle) - theirs
    assert "of car-b was rejected at row 0: speed" in caplog.text


def test_unreadable_or_foreign_acknowledgements_are_ignored(
    router: Router, service: Service, tmp_path: Path
) -> None:
    service.answer = False
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    publisher.offer(observations)
    service.wait(lambda batches: rows(batches, Kind.OBSERVATION) == len(observations.vehicle))
    mine = next(b for b in service.batches if b.vehicle == "car-a")
    service.put_ack("car-a", b"\xff\xff garbage")
    forged = StreamAck(mine.boot, mine.kind, mine.region, ((1, 99),))
    service.put_ack("car-a", encode_ack("car-b", [forged]))
    until(lambda: publisher.counts.bad_acks == 2)
    assert publisher.count_unsettled() == len(observations.vehicle)
    publisher.close(within_s=0.1)


def test_time_in_an_acknowledgement_reveals_a_wrong_clock(
    router: Router, service: Service, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    service.answer = False
    publisher = publisher_of(settings(router, tmp_path))
    observations, _ = drive()
    publisher.offer(observations)
    service.wait(lambda batches: rows(batches, Kind.OBSERVATION) == len(observations.vehicle))
    mine = next(b for b in service.batches if b.vehicle == "car-a")
    settled = StreamAck(
        mine.boot, mine.kind, mine.region, ((mine.seq, mine.seq),), late=((mine.seq, mine.seq),)
    )
    assert health_problems(publisher, Progress()) == []
    with caplog.at_level(logging.WARNING):
        service.put_ack("car-a", encode_ack("car-a", [settled], time.time_ns() + 130 * NS))
        until(lambda: publisher.counts.late[mine.kind] == 1)
    until(lambda: abs(publisher.status.clock_behind_s - 130.0) < 10.0)
    assert any("clock" in trouble for trouble in health_problems(publisher, Progress()))
    assert "behind the service's" in caplog.text
    service.put_ack("car-a", encode_ack("car-a", [settled], time.time_ns() - 3600 * NS))
    until(lambda: publisher.status.clock_behind_s < 0.0)
    assert re.search(r"is 36\d\d s ahead of", " ".join(health_problems(publisher, Progress())))
    service.put_ack("car-a", encode_ack("car-a", [settled], time.time_ns()))
    until(lambda: abs(publisher.status.clock_behind_s) < 10.0)
    # An old service sends acknowledgements without a time.
    service.put_ack("car-a", encode_ack("car-a", [settled]))
    until(lambda: publisher.counts.late[mine.kind] == 4)
    assert health_problems(publisher, Progress()) == []
    publisher.close(within_s=0.1)


def test_a_full_disk_is_waited_for(
    router: Router, service: Service, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The publisher must lose no record while the disk is full. The test prevents SQLite from
    growing its file, and later allows it.
    """
    config = settings(router, tmp_path)
    outbox = Outbox(config.spool)
    database = outbox._file.begin_transaction()
    (pages,) = database.execute("PRAGMA page_count").fetchone()
    database.execute(f"PRAGMA max_page_count = {pages}")
    publisher = Publisher(NAMES, outbox, config, "test")
    publisher.start()
    observations, states = drive(samples=1000)
    publisher.offer(observations, states)
    until(lambda: "the outbox refuses" in caplog.text)
    assert publisher.count_unsettled() == len(observations.vehicle) + len(states.vehicle)
    problem = f"the outbox {config.spool} cannot be read or written (database or disk is full)"
    assert any(text.startswith(problem) for text in health_problems(publisher, Progress()))
    database.execute("PRAGMA max_page_count = 1000000")
    until(lambda: not publisher.disk_error)
    assert publisher.close(within_s=PATIENCE_S)
    assert publisher.count_unsettled() == publisher.status.dropped_records == 0
    assert rows(service.batches, Kind.OBSERVATION) == len(observations.vehicle)
    for stream in {(b.vehicle, b.kind, b.region) for b in service.batches}:
        seqs = {b.seq for b in service.batches if (b.vehicle, b.kind, b.region) == stream}
        assert seqs == set(range(1, len(seqs) + 1))


def test_records_that_the_disk_never_accepted_count_as_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = config_without_router(tmp_path)
    outbox = Outbox(config.spool)
    outbox._file.begin_transaction().execute("PRAGMA query_only = ON")
    publisher = Publisher(NAMES, outbox, config, "test")
    publisher.start()
    observations, _ = drive()
    publisher.offer(observations)
    assert publisher.close(within_s=0.5)
    assert publisher.count_unsettled() == 0, "the outbox does not contain them"
    assert publisher.status.dropped_records == len(observations.vehicle)
    assert caplog.text.count("the outbox refuses") == 1, "each round tries again"


def test_stored_batches_are_sent_though_the_disk_refuses_to_delete(
    router: Router, service: Service, tmp_path: Path
) -> None:
    config = settings(router, tmp_path)
    stored = 60
    outbox = Outbox(config.spool, boot=1)
    draft = drafts_of(drive()[0])[0]
    outbox.store([draft] * stored, 0.0)
    outbox.close()
    outbox = Outbox(config.spool, first_resend_s=config.resend_s)
    outbox._file.begin_transaction().execute("PRAGMA query_only = ON")
    publisher = Publisher(NAMES, outbox, config, "test")
    publisher.start()
    service.wait(lambda batches: len({batch.seq for batch in batches}) == stored)
    publisher.close(within_s=0.1)


def test_vehicle_has_a_liveliness_token_until_it_leaves(
    router: Router, service: Service, tmp_path: Path
) -> None:
    def alive() -> set[str]:
        return {
            str(r.ok.key_expr)
            for r in service.session.liveliness().get(f"{keys.ROOT}/alive/*")
            if r.ok
        }

    publisher = publisher_of(settings(router, tmp_path))
    until(lambda: alive() == {keys.alive_key(name) for name in NAMES})
    publisher.close(within_s=1.0)
    until(lambda: not alive())


def test_many_sessions_open_together(router: Router, tmp_path: Path) -> None:
    names = tuple(f"sim-{n:03}" for n in range(36))
    publisher = publisher_of(settings(router, tmp_path), names)
    until(lambda: publisher.status.links == 36)
    assert publisher.close(within_s=1.0)


def drafts_of(records: RecordBlock) -> list[Draft]:
    batcher = Batcher(NAMES, 1, "test", flush_s=1.0, rows=5)
    batcher.add(records, 0.0)
    return batcher.take_due(0.0, flush_all=True)


def batches_of(batcher: Batcher, now: float, everything: bool = False) -> list[tuple[str, int]]:
    return sorted((d.vehicle, d.records) for d in batcher.take_due(now, flush_all=everything))


def one_vehicle(records: int, urgent: bool = False) -> RecordBlock:
    """Return the first `records` observations of one vehicle, changed so that they all lie in one
    cell.
    """
    observations, _ = drive(samples=3000)
    chosen = np.flatnonzero(observations.vehicle == 0)[:records]
    assert len(chosen) == records
    columns = {name: column[chosen] for name, column in observations.columns.items()}
    columns["cell"] = np.full(records, columns["cell"][0])
    return RecordBlock(
        Kind.OBSERVATION, columns, observations.vehicle[chosen], np.full(records, urgent)
    )


def test_a_batch_waits_for_its_time_or_for_fifty_records() -> None:
    batcher = Batcher(NAMES, 1, "test", flush_s=1.0, rows=50)
    batcher.add(one_vehicle(30), now=0.0)
    assert batches_of(batcher, now=0.9) == []
    batcher.add(one_vehicle(30), now=0.9)
    assert batches_of(batcher, now=0.9) == [("car-a", 50)]
    assert batches_of(batcher, now=1.8) == []
    assert batches_of(batcher, now=2.0) == [("car-a", 10)]


def test_slippery_visit_is_sent_at_once_with_its_batch() -> None:
    batcher = Batcher(NAMES, 1, "test", flush_s=1.0, rows=50)
    batcher.add(one_vehicle(2), now=0.0)
    batcher.add(one_vehicle(1, urgent=True), now=0.1)
    assert batches_of(batcher, now=0.1) == [("car-a", 3)]


def test_a_batch_never_spans_regions() -> None:
    records = one_vehicle(4)
    records.columns["cell"][2:] += 1 << (2 * (grid.CELL_ZOOM - grid.REGION_ZOOM))
    batcher = Batcher(NAMES, 1, "test", flush_s=1.0, rows=50)
    batcher.add(records, now=0.0)
    drafts = batcher.take_due(now=0.0, flush_all=True)
    assert sorted(d.records for d in drafts) == [2, 2]
    assert len({d.region for d in drafts}) == 2
    assert batcher.records == 0
