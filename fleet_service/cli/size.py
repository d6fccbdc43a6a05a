"""`fleet-service size`: estimate processor cores, memory, disk and network for a fleet."""

from __future__ import annotations

import argparse
import json
import math

from schemas.errors import InputError

RATE_HZ = 0.2  # visits per vehicle in the simulated country: one every five seconds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service size`."""
    parser.add_argument(
        "--vehicles",
        metavar="N",
        type=float,
        required=True,
        help="number of vehicles on the road at the same time, e.g. 1e6",
    )
    parser.add_argument(
        "--road-km",
        metavar="KM",
        type=float,
        required=True,
        help="length of the roads on which they drive [km]",
    )
    parser.add_argument(
        "--latitude",
        metavar="DEG",
        type=float,
        default=55.0,
        help="latitude of the roads; cells are smaller in the north (default %(default)s)",
    )
    parser.add_argument(
        "--rate",
        metavar="HZ",
        type=float,
        default=RATE_HZ,
        help="observations per second of each vehicle (default %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Estimate the size of a deployment and print it. Return 0.

    Raises:
        InputError: a number is not positive, or the latitude is outside the map.
    """
    from fleet_service.app.sizing import PlannedFleet, cells_of_roads, estimate_size
    from schemas.grid import MAX_LATITUDE

    for name in ("vehicles", "road_km", "rate"):
        value = getattr(arguments, name)
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(name.replace("_", "-"), f"{value:g} is not positive", "give a number")
    if not abs(arguments.latitude) <= MAX_LATITUDE:
        raise InputError(
            "latitude",
            f"{arguments.latitude:g} is outside the map",
            f"give degrees from -{MAX_LATITUDE:.0f} to {MAX_LATITUDE:.0f}",
        )
    cells = cells_of_roads(arguments.road_km, arguments.latitude)
    size = estimate_size(PlannedFleet(arguments.vehicles, arguments.rate, cells))
    if arguments.json:
        print(json.dumps(size._asdict() | {"cells": cells}))
        return 0
    parts = ", ".join(
        f"{name} {value * 1e-9:.3g} GB"
        for name, value in sorted(size.parts_bytes.items(), key=lambda part: -part[1])
    )
    print(
        "\n".join(
            [
                f"observations   {size.observations_per_s:.4g}/s on {cells:.3g} cells",
                f"services       {size.services}, {size.service_cores:.3g} cores in all",
                f"routers        {size.router_cores:.3g} cores",
                f"memory         {size.memory_bytes * 1e-9:.3g} GB: {parts}",
                f"network        {8e-6 * size.network_bytes_per_s:.3g} Mbit/s from the vehicles",
                f"archive        {size.archive_bytes_per_day * 1e-9:.3g} GB per day",
            ]
        )
    )
    return 0
