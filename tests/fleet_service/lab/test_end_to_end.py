"""Tests of the end-to-end campaign (simulated vehicles and a service): it reads the files of the
vehicles and compares the map with the true friction.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.lab.end_to_end import main
from fleet_service.fusion import Fusion
from fleet_service.lab import end_to_end
from fleet_service.lab.score import mean_or_nan
from schemas import grid
from schemas.thresholds import NS
from schemas.wire import Alert
from tests.fleet_service.examples import CELL, START, observations, value


@pytest.mark.campaign
def test_observations_of_the_vehicles_are_joined_with_their_truth(tmp_path: Path) -> None:
    def drive(folder: Path) -> None:
        world = ["--scenario", end_to_end.HILLS.scenario, "--rough", "0.5"]
        assert (
            main(
                ["--out", str(folder), "--vehicles", "4", "--duration", "20", "--seed", "3", *world]
            )
            == 0
        )

    figures = end_to_end.measure(drive, tmp_path, end_to_end.HILLS)
    assert figures["fusion.whole_way.hills.observations"] > 4
    assert figures["fusion.whole_way.hills.false_ice"] <= figures["fusion.whole_way.hills.alerts"]
    columns = end_to_end.read_observations(tmp_path / "whole_way.hills" / end_to_end.OBSERVATIONS)
    truth = pq.read_table(tmp_path / "whole_way.hills" / end_to_end.TRUTH)
    reported = set(zip(columns["cell"].tolist(), columns["sector"].tolist(), strict=True))
    true = set(zip(truth["cell"].to_pylist(), truth["sector"].to_pylist(), strict=True))
    assert len(reported & true) > 0.5 * len(reported)
    fusion = Fusion(120.0)
    fusion.update(end_to_end.observations_in(columns))
    slots, mu = end_to_end.slots_with_truth(fusion, truth)
    assert 0 < len(slots) <= fusion.size
    assert ((mu > 0.05) & (mu < 1.2)).all()


def test_figure_without_data_is_nan_and_meets_no_target() -> None:
    assert np.isnan(mean_or_nan(np.array([])))
    assert mean_or_nan(np.array([True, False])) == 0.5


def visits(*rows: tuple[int, float, float]) -> pa.Table:
    """Return a table of visits (passages of cells).

    Args:
        rows: (steps east of CELL, time [s], friction) of each visit.
    """
    cell, seconds, mu = np.array(rows).T
    return pa.table(
        {
            "cell": CELL + cell.astype(np.int64),
            "sector": np.zeros(len(rows), np.int8),
            "leave_time": pa.array(
                START + (seconds * 1e9).astype(np.int64), pa.timestamp("ns", "UTC")
            ),
            "mu": mu,
            "enter_time": pa.array(
                START + (seconds * 1e9).astype(np.int64) - NS, pa.timestamp("ns", "UTC")
            ),
            "utilisation": np.where(mu > 0.5, 0.9, 0.1),
            "vehicle": [f"v{k % 2}" for k in range(len(rows))],
        }
    )


def test_truth_of_a_cell_is_that_of_its_last_half_minute_or_all_visits() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations([1.0, 1.0], [1, 2], value([0.5, 0.5]), cell=[CELL, CELL + 1]))
    slots, mu = end_to_end.slots_with_truth(
        fusion,
        visits(
            (0, 10.0, 0.9),
            (0, 80.0, 0.2),
            (0, 99.0, 0.4),
            (1, 5.0, 0.8),
            (1, 6.0, 0.6),
            (7, 99.0, 0.1),
        ),
    )
    found = dict(zip(fusion.cell[slots].tolist(), mu.tolist(), strict=True))
    assert found == {CELL: pytest.approx(0.3), CELL + 1: pytest.approx(0.7)}


def test_an_alert_is_false_where_nothing_near_was_slippery_before_it() -> None:
    east, north = (int(value[0]) for value in grid.deinterleave(np.array([CELL])))

    def alert(cells_east: int, seconds: float) -> Alert:
        cell = int(grid.interleave(np.array([east + cells_east]), np.array([north]))[0])
        return Alert(
            cell, 0, True, START + int(seconds * NS), 0.2, 0.1, 0.3, 0.95, 2, 57.7, 11.97, "test"
        )

    rows = visits((0, 10.0, 0.2), (0, 2.0, 0.9))
    assert end_to_end.false_ice([alert(0, 20.0)], rows) == (0, 0)
    assert end_to_end.false_ice([alert(0, 5.0)], rows) == (1, 0)  # the ice came after the alert
    assert end_to_end.false_ice([alert(1, 20.0), alert(2, 20.0)], rows) == (1, 1)
    assert end_to_end.false_ice([], rows) == (0, 0)


def test_alerts_equal_those_of_a_service_fed_second_by_second() -> None:
    fusion = Fusion(120.0)
    raised = end_to_end.raised_alerts(
        fusion, observations(list(range(1, 9)), [1, 2] * 4, value([0.15] * 8))
    )
    assert [alert.cell for alert in raised] == [CELL]


def test_excited_vehicles_are_counted_once_per_cell() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations([1.0, 1.0], [1, 2], value([0.5, 0.5]), cell=[CELL, CELL + 1]))
    rows = visits((0, 1.0, 0.9), (0, 2.0, 0.9), (0, 3.0, 0.9), (1, 4.0, 0.1), (1, 5.0, 0.9))
    counts = end_to_end.excited_vehicles(fusion, rows)
    assert counts[fusion.slots_of(np.array([CELL, CELL + 1]), np.zeros(2, np.int64))].tolist() == [
        2,
        1,
    ]


def test_cell_with_two_surfaces_is_recognised() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations([1.0, 1.0], [1, 2], value([0.5, 0.5]), cell=[CELL, CELL + 1]))
    same = end_to_end.one_surface(
        fusion, visits((0, 1.0, 0.9), (0, 2.0, 0.8), (1, 4.0, 0.6), (1, 5.0, 0.61))
    )
    assert same[fusion.slots_of(np.array([CELL, CELL + 1]), np.zeros(2, np.int64))].tolist() == [
        False,
        True,
    ]
