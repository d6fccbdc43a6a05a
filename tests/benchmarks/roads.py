"""`make roads-bench`: share of positions for which the join of cells to road links is right,
measured with SUMO's traffic in the centre of Helsinki.

Each position has a random error of NOISE_M in each axis. Writes `.roads/figures.json` and prints
the table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from fleet_service.analytics.roads.join import join_roads
from fleet_service.analytics.roads.network import RoadNetwork, read_network
from schemas import grid
from schemas.numeric import FloatArray
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.thresholds import METRES_PER_DEGREE
from tests.benchmarks.sumo import Sumo

FOLDER: Final = Path(".roads")
NOISE_M = 3.0
SEEDS = (11, 12, 13)
SECONDS = 600


class Traffic(NamedTuple):
    """Positions of moving vehicles, arrays of shape (n,): latitude and longitude [deg], yaw [rad
    from east], and the id of the OpenStreetMap way on which the vehicle was.
    """

    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray
    way: list[str]


def simulate_traffic(sumo: Sumo, seed: int) -> Traffic:
    """Return one position per second of each moving vehicle, from random trips through the town
    during SECONDS.
    """
    sumo.draw_trips(SECONDS, 0.7, seed)
    rows = pd.read_parquet(sumo.drive_trips(SECONDS + 300, 1, seed))
    rows = rows[(rows.vehicle_speed > 1.0) & ~rows.vehicle_lane.str.startswith(":")]
    way = rows.vehicle_lane.str.rpartition("_")[0].str.partition("#")[0].str.lstrip("-")
    yaw = np.radians(90.0 - rows.vehicle_angle.to_numpy(float))
    return Traffic(rows.vehicle_y.to_numpy(), rows.vehicle_x.to_numpy(), yaw, way.tolist())


def judge_join(network: RoadNetwork, traffic: Traffic, seed: int) -> dict[str, float]:
    """Join vehicle positions to road links by map place (map cell and heading sector), and compare
    the result with the true links. One map place may have several links.

    Return by name:
        fixes: number of positions.
        join_right: share of positions for which a joined link is the right one.
        street_right: share of positions for which a joined link is on the right street.
        best_single: share of right positions if each map place had only its most frequent link.
        links_per_place: mean number of links that are joined to a position.
    """
    rng = np.random.default_rng(seed)
    east = METRES_PER_DEGREE * np.cos(np.radians(traffic.latitude))
    error = rng.normal(0.0, NOISE_M, (2, len(east)))
    cell = grid.cell_of(
        traffic.latitude + error[0] / METRES_PER_DEGREE, traffic.longitude + error[1] / east
    )
    place = cell * grid.SECTORS + grid.sector_of(traffic.yaw).astype(np.int64)
    names = {link.id: link.name for link in network.links}
    fixes = pd.DataFrame({"place": place, "way": traffic.way, "fix": np.arange(len(place))})
    fixes = fixes[fixes.way.isin(set(names))]
    links = join_roads(network).to_pandas()
    links["place"] = links.cell * grid.SECTORS + links.sector
    rows = fixes.merge(links[["place", "link"]], on="place", how="left")
    right = rows.link == rows.way
    street = right | ((rows.link.map(names) == rows.way.map(names)) & (rows.way.map(names) != ""))
    commonest = fixes.groupby("place").way.transform(lambda ways: ways.mode().iloc[0])
    return {
        "fixes": float(len(fixes)),
        "join_right": float(right.groupby(rows.fix).any().mean()),
        "street_right": float(street.groupby(rows.fix).any().mean()),
        "best_single": float((commonest == fixes.way).mean()),
        "links_per_place": len(rows) / len(fixes),
    }


def main() -> int:
    """Simulate traffic, join its positions to road links, and measure the share of right links.
    Return 1 if a figure misses its target, otherwise 0.
    """
    sumo = Sumo(FOLDER)
    network = read_network(sumo.extract)
    found = [judge_join(network, simulate_traffic(sumo, seed), seed) for seed in SEEDS]
    least = {name: min(one[name] for one in found) for name in found[0]}
    most = {name: max(one[name] for one in found) for name in found[0]}
    rows = [
        Figure("roads.fixes", least["fixes"], "fixes of a seed, the fewest", 50_000, "more"),
        Figure("roads.join_right", least["join_right"], "of fixes, the worst seed", 0.95, "more"),
        Figure(
            "roads.street_right", least["street_right"], "of fixes, the worst seed", None, "more"
        ),
        Figure("roads.best_single", most["best_single"], "of fixes, the best seed"),
        Figure(
            "roads.links_per_place", most["links_per_place"], "links of a fix's cell, the most", 1.5
        ),
    ]
    figures.write_figures(FOLDER / "figures.json", "roads", SEEDS, rows)
    print(figures.format_table(rows))
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
