"""Tests of the batches of a recorded drive: the same records have the same identity, and other
records have another one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.publish.batching import batch_drive
from schemas.wire import ENCODING, Columns, Kind, decode
from tests.edge_agent.fakes import Watch, estimates, wanderers

ROWS = 7


def records(mu: float | None = None) -> list[RecordBlock]:
    """Return the records of a random drive of one vehicle, in two blocks of samples."""
    block = wanderers(400, 1, seed=2)
    made = estimates(400, 1, seed=2, mu=mu)
    watch = Watch.of(1)
    out: list[RecordBlock] = []
    for rows in (slice(0, 150), slice(150, 400)):
        part = replace(block, t=block.t[rows], time=block.time[rows], signals=block.signals[rows])
        out += watch.step(part, made.part(rows))[1:]
    return out


def boot_of(found: list[RecordBlock], **changes: object) -> int:
    given = {"name": "car-a", "estimator": "test", "rows": ROWS, **changes}
    return batch_drive(found, **given).boot  # type: ignore[arg-type]


def change_records(change: Callable[[Columns], Columns]) -> list[RecordBlock]:
    return [one._replace(columns=change(dict(one.columns))) for one in records()]


def test_the_batches_of_a_drive_contain_each_record_once_in_order() -> None:
    drive = batch_drive(records(), "car-a", "test", ROWS)
    batches = [
        decode(draft.encode(5, 1), ENCODING[draft.kind], draft.kind) for draft in drive.drafts
    ]
    assert {(one.vehicle, one.boot, one.seq, one.first_held) for one in batches} == {
        ("car-a", drive.boot, 5, 1)
    }
    assert max(one.rows for one in batches) <= ROWS
    for kind, time in ((Kind.OBSERVATION, "enter_time"), (Kind.STATE, "time")):
        sent = np.concatenate([one.columns[time] for one in batches if one.kind is kind])
        made = np.concatenate([one.columns[time] for one in records() if one.kind is kind])
        assert np.array_equal(sent, made)
        assert len(sent) > ROWS


def test_the_same_records_have_the_same_boot() -> None:
    assert boot_of(records()) == boot_of(records())
    assert 0 <= boot_of(records()) < 2**63


def test_rounding_errors_of_another_processor_do_not_change_the_boot() -> None:
    def disturb(columns: Columns) -> Columns:
        for name, values in columns.items():
            if values.dtype.kind == "f":
                moved = np.nextafter(values, -np.inf) - values.dtype.type(1e-12)
                columns[name] = np.where(np.isnan(values), -moved, moved)
        return columns

    assert boot_of(change_records(disturb)) == boot_of(records())


@pytest.mark.parametrize("column", ["mu", "time", "enter_time", "health", "log_likelihood"])
def test_other_records_have_another_boot(column: str) -> None:
    def change(columns: Columns) -> Columns:
        if column in columns:
            columns[column] = columns[column].copy()
            columns[column][-1:] += 1
        return columns

    assert boot_of(change_records(change)) != boot_of(records())


@pytest.mark.parametrize("change", [{"name": "car-b"}, {"estimator": "ckf"}, {"rows": 8}])
def test_another_vehicle_estimator_or_division_has_another_boot(change: dict[str, object]) -> None:
    assert boot_of(records(), **change) != boot_of(records())
