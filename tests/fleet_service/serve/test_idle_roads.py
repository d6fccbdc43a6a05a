"""Tests of the limit on alerts on idle roads (roads without other traffic). Two vehicles alone can
raise alerts only in a few places. Other traffic, or a third vehicle, removes this limit.
"""

from __future__ import annotations

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.idle_roads import AREA_NS, MOST_AREAS, IdleRoads
from schemas import grid
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, START, observations, value

CELLS = [int(grid.cell_of(LATITUDE, LONGITUDE + 0.05 * k)) for k in range(6)]


def test_each_vehicle_supports_alerts_in_few_areas() -> None:
    roads = IdleRoads()
    assert [roads.admit(cell, [1, 2], START, 2) for cell in CELLS] == [
        True,
        True,
        False,
        False,
        False,
        False,
    ]
    assert roads.admit(CELLS[0], [1, 2], START + SECOND, 2), "within an area of before"
    assert not roads.admit(CELLS[2], [1, 3], START, 2), (
        "a new partner does not renew the first vehicle"
    )
    assert roads.admit(CELLS[2], [3, 4], START, 2)
    assert roads.admit(CELLS[3], [1, 2], START + AREA_NS, 2)


def alerts_of(vehicles: int) -> int:
    """Let `vehicles` vehicles report ice in each cell of CELLS, and return the number of alerts."""
    fusion = Fusion(120.0)
    alerts = Alerts(fusion, IdleRoads())
    raised = 0
    for number, cell in enumerate(CELLS):
        for vehicle in range(vehicles):
            seconds = [100.0 * number + vehicle]
            slots = fusion.update(observations(seconds, [vehicle], value([0.15]), cell)).slots
            raised += sum(alert.raised for alert in alerts.update(np.asarray(slots)))
    return raised


def test_third_vehicle_lifts_the_limit() -> None:
    assert alerts_of(2) == MOST_AREAS
    assert alerts_of(3) == len(CELLS)
