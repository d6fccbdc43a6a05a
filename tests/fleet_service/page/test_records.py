"""Tests of the records in which the page receives map cells. A record must have the map's values,
rounded so that it never shows more grip than the map. A square of the overview must have the values
of its worst cell.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.fusion import Fusion
from fleet_service.page import records
from fleet_service.page.records import (
    BOUND,
    CELL_LEVEL,
    GONE,
    HEAD,
    LEAST_LEVEL,
    MEASURED,
    NO_NUMBER,
    RECORD,
    TileBlock,
)
from fleet_service.serve.encode import cell_table
from schemas import grid
from tests.fleet_service.examples import CELL, START, TILE, at_least, observations, value


@pytest.fixture(scope="module")
def table() -> pa.Table:
    """Return the table of a tile with a thousand cells, some with only a lower bound of μ."""
    rng = np.random.default_rng(3)
    n = 1000
    fusion = Fusion(120.0)
    cells = (TILE << 14) + rng.choice(1 << 14, n, replace=False)
    found = np.where(
        rng.random(n)[:, None] < 0.6,
        value(rng.uniform(0.1, 1.0, n)),
        at_least(rng.uniform(0.1, 0.4, n)),
    )
    fusion.update(observations(np.arange(n) * 0.05, np.arange(n), found, cells))
    return cell_table(fusion, np.arange(fusion.size), START + 60 * 10**9)


def test_a_record_is_accurate_and_never_narrower_or_drier(table: pa.Table) -> None:
    found = records.of_table(table)
    place = (table["cell"].to_numpy() & 0x3FFF) * 4 + table["sector"].to_numpy()
    row = {key: k for k, key in enumerate(place.tolist())}
    order = [row[key] for key in found["place"].tolist()]
    expected = {
        name: table[name].to_numpy()[order]
        for name in ("mu", "mu_lower", "mu_upper", "p_slippery", "vehicles")
    }
    known = found["basis"] == MEASURED
    assert 0.2 < known.mean() < 0.9
    assert np.abs(found["mu"][known] / 200 - expected["mu"][known]).max() <= 0.0025 + 1e-6
    assert (found["lower"] / 200 <= expected["mu_lower"] + 1e-6).all()
    assert (found["upper"] / 200 >= expected["mu_upper"] - 1e-6).all()
    assert (found["slippery"] / 254 >= expected["p_slippery"] - 1e-6).all()
    assert np.array_equal(
        found["last"], table["last_time"].cast(pa.int64()).to_numpy()[order] // 10**9
    )
    assert np.array_equal(found["vehicles"], expected["vehicles"])


def test_bound_has_no_value_to_colour_by(table: pa.Table) -> None:
    place = table.schema.get_field_index("mu")
    lying = table.set_column(
        place, table.schema.field(place), pa.array(np.full(table.num_rows, 0.8, np.float32))
    )
    found = records.of_table(lying)
    assert (found["mu"][found["basis"] == BOUND] == NO_NUMBER).all()


@pytest.mark.parametrize("level", range(LEAST_LEVEL, CELL_LEVEL + 1))
def test_an_ancestor_has_the_worst_of_its_cells_and_the_unknown_share(
    table: pa.Table, level: int
) -> None:
    cells = records.of_table(table)
    found = records.aggregate_worst(cells, level)
    shift = 2 * (CELL_LEVEL - level)
    assert len(np.unique(found["place"])) == len(found)
    for one in found:
        below = cells[cells["place"] >> (2 + shift) == one["place"] >> 2]
        known = below[below["basis"] == MEASURED]
        share = 1 - len(known) / len(below)
        assert share <= one["unknown"] / 254 < share + 1 / 254 + 1e-9
        if len(known):
            assert all(one[name] == known[name].min() for name in ("mu", "lower", "upper"))
            assert one["slippery"] == known["slippery"].max()
        else:
            assert (one["basis"], one["mu"], one["lower"]) == (
                BOUND,
                NO_NUMBER,
                below["lower"].min(),
            )


def test_one_icy_cell_among_thousands_is_visible_at_low_zoom() -> None:
    cells = np.zeros(4000, RECORD)
    cells["place"] = np.arange(4000) * 4
    for name, whole in (("mu", 170), ("lower", 160), ("upper", 180), ("basis", MEASURED)):
        cells[name] = whole
    cells[1234] = (0, 1234 * 4, 24, 14, 40, 254, MEASURED, 3, 0)
    far = records.aggregate_worst(cells, LEAST_LEVEL)
    assert len(far) == 1
    assert (far["mu"][0], far["upper"][0], far["slippery"][0]) == (24, 40, 254)


def test_changed_records_applied_to_the_old_ones_give_the_new_ones(table: pa.Table) -> None:
    before = records.of_table(table)[:700]
    after = records.of_table(table)[300:].copy()
    after["mu"][::7] = 11
    change = records.changed_records(before, after)
    held = {int(one["place"]): one for one in before} | {int(one["place"]): one for one in change}
    left = {place: one for place, one in held.items() if one["basis"] != GONE}
    assert left == {int(one["place"]): one for one in after}
    assert len(change) < len(before) + len(after)
    assert len(records.changed_records(after, after)) == 0


def test_a_cell_takes_thirteen_bytes(table: pa.Table) -> None:
    cells = records.of_table(table)
    block = TileBlock(TILE, CELL_LEVEL, 3, 2, 1.5, cells).encoded()
    assert len(block) <= 16 * len(cells)
    assert HEAD.unpack_from(block) == (TILE, 3, 2, len(cells), CELL_LEVEL, 1.5)
    assert np.array_equal(
        np.frombuffer(block, "<u2", len(cells), HEAD.size + 4 * len(cells)), cells["place"]
    )
    assert int(grid.tile_of(CELL)) == TILE
