"""Benchmark on a city: vehicles with the default estimator drive SUMO's routes, and their fused
observations are compared with the true friction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from edge_agent.lab.end_to_end import RATE_HZ, write_drive
from edge_agent.lab.simulation import SimulatedFleet
from fleet_service.lab.end_to_end import World, measure
from schemas.runtime.figures import Figure
from tests.benchmarks.country.streets import make_streets, simulate_drives
from tests.benchmarks.sumo import Sumo

VEHICLES: Final = 300
SECONDS: Final = 240
ROUGH: Final = 0.5  # share of the vehicles whose sensors have the errors of real cars
PREFIX: Final = "country.city"


def simulate_city(sumo: Sumo, folder: Path, seed: int) -> list[Figure]:
    """Simulate the drives of the city, fuse their observations, and compare the map with the true
    friction. The observations stay in a subfolder of `folder` for the benchmark of a country.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def drive_fleet(into: Path) -> None:
        into.mkdir(exist_ok=True)
        streets = make_streets(simulate_drives(sumo, VEHICLES, SECONDS, seed), seed)
        write_drive(SimulatedFleet(streets, VEHICLES, seed, RATE_HZ, rough=ROUGH), SECONDS, into)

    found = measure(drive_fleet, folder, World("helsinki", ROUGH, PREFIX, seed))
    cells = f"of {found[f'{PREFIX}.cells']:.0f} cells with two vehicles or more"
    return [
        Figure(
            f"{PREFIX}.observations",
            found[f"{PREFIX}.observations"],
            f"of {VEHICLES} vehicles in {SECONDS} s",
        ),
        Figure(f"{PREFIX}.coverage90", found[f"{PREFIX}.coverage90"], cells, 0.85, "more"),
        Figure(f"{PREFIX}.rmse", found[f"{PREFIX}.rmse"], "where a friction is given"),
        Figure(
            f"{PREFIX}.measured",
            found[f"{PREFIX}.cells.measured"],
            "cells where a friction is given",
        ),
        Figure(
            f"{PREFIX}.false_ice",
            found[f"{PREFIX}.false_ice"],
            "alerts far from anything slippery",
            0,
        ),
        Figure(f"{PREFIX}.alerts", found[f"{PREFIX}.alerts"], "alerts"),
    ]
