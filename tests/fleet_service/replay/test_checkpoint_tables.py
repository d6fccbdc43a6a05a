"""Tests that beliefs (a `Fusion`) restored from a checkpoint, the saved state of a service,
continue exactly like the original.
"""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.fusion import Fusion
from fleet_service.replay.checkpoint_tables import fusion_from, tables_of
from schemas.errors import InputError
from tests.fleet_service.fusion.test_order import LATENESS_S, delay_arrivals, drive
from tests.fleet_service.fusion.test_weather import RAIN, reports


def store_tables(tables: dict[str, pa.Table]) -> dict[str, pa.Table]:
    """Write the tables of a fusion (beliefs about all cells) as Parquet, read them back, and return
    them.
    """
    out = {}
    for name, table in tables.items():
        buffer = io.BytesIO()
        pq.write_table(table, buffer)
        out[name] = pq.read_table(buffer)
    return out


@pytest.mark.parametrize("cut", [0, 1, 700, 1500])
def test_fusion_from_its_checkpoint_continues_bit_for_bit(cut: int) -> None:
    o = drive(11, 1500, 8.0 * 3600.0)  # longer than the memory of vehicles
    order = delay_arrivals(o, 100.0, 12)
    whole = Fusion(LATENESS_S)
    whole.update_weather(reports((0.5, RAIN)))
    whole.update(o.take(order[:cut]))
    again = fusion_from(store_tables(tables_of(whole)), LATENESS_S)
    for part in np.array_split(order[cut:], 9):
        for fusion in (whole, again):
            fusion.update(o.take(part))
    assert again.size == whole.size > 6
    now = int(o.time.max()) + 10**12
    slots = again.slots_of(whole.cell, whole.sector)
    np.testing.assert_array_equal(
        again.beliefs(slots, now), whole.beliefs(np.arange(whole.size), now)
    )
    for name in ("visits", "vehicles", "values", "returned", "untrusted"):
        np.testing.assert_array_equal(
            getattr(again.live, name)[slots], getattr(whole.live, name)[: whole.size]
        )
    assert [again.trust(v) for v in range(13)] == [whole.trust(v) for v in range(13)]


def test_another_version_or_half_a_checkpoint_is_refused() -> None:
    tables = tables_of(Fusion(LATENESS_S))
    with pytest.raises(InputError, match="not of version"):
        fusion_from(tables | {"used": tables["used"].replace_schema_metadata({})}, LATENESS_S)
    del tables["pairs"]
    with pytest.raises(InputError, match="incomplete"):
        fusion_from(tables, LATENESS_S)
