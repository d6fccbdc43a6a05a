"""Tests of the sizing calculator, which estimates a service's needs. The estimates must grow with
the number of vehicles and other inputs, and an error must name a bad input.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from fleet_service.app.sizing import (
    MemoryContent,
    PlannedFleet,
    cells_of_roads,
    estimate_size,
    remembered_pairs,
    split_memory,
)
from fleet_service.cli import main
from schemas import grid

FLEET = PlannedFleet(vehicles=1e5, rate_hz=0.2, cells=1e6)


def test_the_size_grows_with_the_fleet_in_proportion() -> None:
    small = estimate_size(FLEET)
    large = estimate_size(FLEET._replace(vehicles=1e6, cells=1e7))
    assert large.observations_per_s == pytest.approx(10.0 * small.observations_per_s)
    assert large.service_cores == pytest.approx(10.0 * small.service_cores)
    assert large.archive_bytes_per_day == pytest.approx(10.0 * small.archive_bytes_per_day)
    data = [size.memory_bytes - size.parts_bytes["processes"] for size in (small, large)]
    assert data[1] == pytest.approx(10.0 * data[0])
    assert large.services >= large.service_cores / 0.6


def test_only_values_are_remembered_for_three_hours() -> None:
    assert remembered_pairs(1.0, 0.0) == pytest.approx(1.125 * 3600.0)
    assert remembered_pairs(1.0, 1.0) == pytest.approx(3.125 * 3600.0)


def test_memory_counts_each_part_of_the_content() -> None:
    nothing = MemoryContent(0.0, 0.0, 0.0, 0.0)
    assert sum(split_memory(nothing).values()) == 0.0
    for name in nothing._fields:
        assert sum(split_memory(nothing._replace(**{name: 1e3})).values()) > 0.0


@pytest.mark.parametrize("bearing", [0.0, 30.0, 45.0, 90.0])
def test_cells_of_a_road_are_about_those_that_it_touches(bearing: float) -> None:
    latitude = 57.7 + 0.05 * np.cos(np.radians(bearing)) * np.linspace(0.0, 1.0, 100_000)
    shrink = np.cos(np.radians(57.725))
    longitude = 12.0 + 0.05 / shrink * np.sin(np.radians(bearing)) * np.linspace(0.0, 1.0, 100_000)
    touched = len(np.unique(grid.cell_of(latitude, longitude)))
    estimated = cells_of_roads(0.05 * 111.2, 57.725) / 2.0
    assert 0.75 < touched / estimated < 1.25


def test_the_command_prints_a_table_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["size", "--vehicles", "1e6", "--road-km", "200000"]
    assert main(words) == 0
    table = capsys.readouterr().out
    for name in ("observations", "services", "routers", "memory", "network", "archive"):
        assert f"\n{name} " in f"\n{table}"
    assert main([*words, "--json", "--rate", "1", "--latitude", "0"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["observations_per_s"] == 1e6
    assert found["cells"] == pytest.approx(cells_of_roads(200_000.0, 0.0))


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["--vehicles", "0", "--road-km", "1"], "vehicles"),
        (["--vehicles", "1", "--road-km", "-1"], "road-km"),
        (["--vehicles", "1", "--road-km", "1", "--rate", "nan"], "rate"),
        (["--vehicles", "1", "--road-km", "1", "--latitude", "89"], "latitude"),
    ],
)
def test_bad_input_is_named(
    words: list[str], field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["size", *words]) == 2
    assert f"error: {field}: " in capsys.readouterr().err
