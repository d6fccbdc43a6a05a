"""Tests of friction along a route. A part without reports must stay unknown, and the safe speed
must follow from the lower end of the friction interval.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.fusion import Fusion
from fleet_service.page.route import grip_profile
from fleet_service.serve.encode import cell_table
from schemas import grid, regions
from schemas.errors import InputError
from schemas.tables import MAP_SCHEMA
from schemas.thresholds import METRES_PER_DEGREE
from tests.fleet_service.examples import START, at_least, observations, value
from tests.fleet_service.page import street


def make_ice_table() -> pa.Table:
    """Return a map table with five cells of ice. The cells that follow to the east have only a
    lower bound of friction.
    """
    ice = street.cells(street.PARTS["ice"])
    passed = street.cells(street.PARTS["passed"])
    cells = np.concatenate([ice, passed])
    found = np.concatenate([value([0.12] * len(ice)), at_least([0.25] * len(passed))])
    fusion = Fusion(120.0)
    fusion.update(observations(np.arange(len(cells)) * 0.1, np.arange(len(cells)), found, cells))
    return cell_table(fusion, np.arange(fusion.size), START + 10**10)


def ends(first: int, last: int) -> list[tuple[float, float]]:
    """Return a route as two points (longitude, latitude) [deg]: the centres of the cells number
    `first` and `last`, counted eastward from the middle of the test street.
    """
    x = street.MIDDLE[0] + np.array([first, last])
    latitude, longitude = grid.centre(grid.interleave(x, np.array([street.MIDDLE[1]] * 2)))
    return list(zip(longitude.tolist(), latitude.tolist(), strict=True))


def shares(found: dict[str, Any]) -> dict[str, float]:
    lengths: dict[str, float] = {}
    for one in found["stretches"]:
        lengths[one["basis"]] = lengths.get(one["basis"], 0.0) + one["to_m"] - one["from_m"]
    return {basis: length / found["length_m"] for basis, length in lengths.items()}


def test_unmeasured_stretches_along_a_route_have_no_number() -> None:
    found = grip_profile(ends(-20, 30), make_ice_table())
    stretches = found["stretches"]
    assert stretches[0]["from_m"] == 0.0
    assert stretches[-1]["to_m"] == pytest.approx(found["length_m"], abs=0.1)
    assert all(a["to_m"] == b["from_m"] for a, b in pairwise(stretches))
    assert {one["basis"] for one in stretches} == {"unknown", "measured", "bound"}
    for one in stretches:
        assert (
            (one.get("mu") is not None)
            == (one.get("safe_speed") is not None)
            == (one["basis"] == "measured")
        )
    assert found["share"]["measured"] == pytest.approx(5 / 50, abs=0.02)
    assert found["share"]["unknown"] > 0.5
    assert sum(found["share"].values()) == pytest.approx(1.0, abs=1e-3)
    assert shares(found) == pytest.approx({k: v for k, v in found["share"].items() if v}, abs=0.01)
    assert stretches[found["worst"]]["basis"] == "measured"


def test_the_other_direction_is_another_road() -> None:
    found = grip_profile(ends(10, -10), make_ice_table())
    assert found["share"]["unknown"] == pytest.approx(1.0)
    assert found["worst"] is None


def test_unmeasured_route_is_unknown_and_not_dry() -> None:
    assert grip_profile(ends(-5, 5), MAP_SCHEMA.empty_table())["share"]["unknown"] == pytest.approx(
        1.0
    )


def test_a_point_or_a_continent_is_refused() -> None:
    for points in ([(11.0, 57.0)], [(11.0, 57.0), (11.0, 57.0)], [(11.0, 57.0), (11.0, 67.0)]):
        with pytest.raises(InputError, match="route"):
            grip_profile(points, MAP_SCHEMA.empty_table())


def test_route_over_the_180_degree_meridian_takes_the_short_way() -> None:
    points = [(179.999, -17.0), (-179.999, -17.0)]
    found = grip_profile(points, MAP_SCHEMA.empty_table())
    assert found["length_m"] == pytest.approx(0.002 * METRES_PER_DEGREE * np.cos(np.radians(17)))
    assert all(abs(one["longitude"]) > 179.99 for one in found["stretches"])
    keys = regions.keys_along(points)
    cells = keys // grid.SECTORS
    assert cells[0] == grid.cell_of(-17.0, 179.999)
    assert cells[-1] == grid.cell_of(-17.0, -179.999)
    assert set(keys % grid.SECTORS) == {0}
    back = regions.keys_along(points[::-1])
    assert set(back % grid.SECTORS) == {2}
