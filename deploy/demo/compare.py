"""Figures of the demo: the map compared with the true friction.

For each visit (passage of a map cell) the simulator records the mean friction under the wheels, and
the largest share of this friction that the vehicle used. A visit with a share of at least 0.6 is
called *excited*, because only then can the friction be measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from deploy.demo.ice import NewIce
from edge_agent.lab.simulation.listeners import choose_warned
from fleet_service.archive.format import reading
from fleet_service.client.stretches import Stretches, link_cells
from fleet_service.lab.end_to_end import false_ice
from fleet_service.lab.score import mean_or_nan
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.thresholds import EXCITED_SHARE, SLIPPERY_MU
from schemas.wire import Alert, Kind

PASSES: Final = "demo.passes"
ENOUGH: Final = 20  # least number of passes for a meaningful share
DELAY: Final = "demo.alert.delay_passes"
WALL: Final = "demo.wall_s"
COVERAGE: Final = "demo.map.coverage90"
WIDEST: Final = 0.99  # target: highest coverage of the map's intervals; above it they are too wide
# [ns] a longer time between two visits of a vehicle begins a new pass.
PASS_GAP_NS: Final = 10_000_000_000
NEVER: Final = int(np.iinfo(np.int64).max)
LOST: Final = 0.98  # share of the available grip at which a wheel counts as sliding


def demo_works(found: Sequence[Figure]) -> bool:
    """Return True if every figure of the demo with a mandatory target meets its target.

    Targets for the delay of alerts, the number of passes and the run time are not mandatory.
    Neither is the upper limit of the coverage, above which the map's intervals are too wide.
    """

    def breaks_promise(figure: Figure) -> bool:
        wide = figure.name == COVERAGE and figure.value > WIDEST
        goal = figure.name in (DELAY, WALL) or figure.name.startswith(PASSES)
        return not (figure.holds or goal or wide)

    return not any(map(breaks_promise, found))


@dataclass(frozen=True)
class MapComparison:
    """Map cells for which the true friction is known, one row per cell and heading sector. `cells`
    is the table of the map's values. `truth` (n,) is the true friction of each row at the end of
    the demo.
    """

    cells: pa.Table
    truth: FloatArray

    @property
    def is_covered(self) -> BoolArray:
        """Return a mask of the table's rows, (n,): True if the true friction lies in the map's 90 %
        interval.
        """
        lower = self.cells["mu_lower"].to_numpy()
        upper = self.cells["mu_upper"].to_numpy()
        return np.asarray((lower <= self.truth) & (self.truth <= upper))

    @property
    def has_several_vehicles(self) -> BoolArray:
        """Return a mask of the table's rows, (n,): True if two or more vehicles visited the row's
        cell.
        """
        return np.asarray(self.cells["vehicles"].to_numpy() >= 2)

    @property
    def is_measured(self) -> BoolArray:
        """Return a mask of the table's rows, (n,): True if a vehicle measured the friction in the
        row's cell, False if vehicles reported only lower bounds.
        """
        return np.asarray(self.cells["basis"].to_numpy(zero_copy_only=False) == "measured")

    @property
    def values(self) -> FloatArray:
        """Return the median friction according to the map, (n,), one value per row; NaN where no
        vehicle measured the friction.
        """
        mu = self.cells["mu"].to_numpy()
        return np.where(self.is_measured, mu, np.nan)


def final_truth(visits: pa.Table, changed_ns: int) -> dict[tuple[int, int], float]:
    """Return the true friction of each visited (cell, sector) at the end of the demo. It is the
    mean over the visits after the road changed at `changed_ns` [ns]. Without such visits it is the
    mean over all visits.
    """
    keys = _cell_keys(visits)
    after = visits["enter_time"].cast(pa.int64()).to_numpy() >= changed_ns
    mu = visits["mu"].to_numpy()
    groups: dict[tuple[int, int], list[int]] = {}
    for row, key in enumerate(keys):
        groups.setdefault(key, []).append(row)
    return {
        key: float(np.mean(mu[[r for r in rows if after[r]] or rows]))
        for key, rows in groups.items()
    }


def write_truth(visits: pa.Table, changed_ns: int, path: Path) -> None:
    """Write the true friction of each cell at the end of the demo as a file that the live page can
    draw over the map.
    """
    truth = final_truth(visits, changed_ns)
    cell, sector = zip(*truth, strict=True)
    table = pa.table(
        {
            "cell": pa.array(cell, pa.int64()),
            "sector": pa.array(sector, pa.int8()),
            "mu": list(truth.values()),
        }
    )
    part = path.with_suffix(".part")
    pq.write_table(table, part)
    part.rename(path)


def compare(cells: pa.Table, visits: pa.Table, changed_ns: int) -> MapComparison:
    """Join the map's cells with the true friction in `visits`; return one row per cell and heading
    sector for which the true friction is known.
    """
    truth = final_truth(visits, changed_ns)
    found = np.array([truth.get(key, np.nan) for key in _cell_keys(cells)])
    known = np.isfinite(found)
    return MapComparison(cells.filter(pa.array(known)), found[known])


def delay_passes(visits: pa.Table, ice: NewIce, alerts: list[tuple[int, Alert]]) -> float:
    """Return the number of passes over a new patch of ice before the first alert for the patch, as
    the median over all patches. Only excited passes count, in which a vehicle used enough grip to
    measure the friction.

    For a patch without an alert the number is infinite. Cells at most LINK_CELLS apart belong to
    one patch.

    Args:
        visits: true values of all visits.
        ice: the new ice.
        alerts: pairs of time of receipt [ns] and alert.
    """
    left: IntArray = visits["leave_time"].cast(pa.int64()).to_numpy()
    on = ice.find_visits(visits)
    excited = visits["utilisation"].to_numpy() >= EXCITED_SHARE
    cell = visits["cell"].to_numpy()
    delays = []
    for cells, known in known_patches(visits, ice, alerts):
        rows = visits.filter(pa.array(on & excited & np.isin(cell, cells) & (left <= known)))
        delays.append(float(count_passes(rows)) if known < NEVER else float("inf"))
    return float(np.median(delays)) if delays else float("inf")


def known_patches(
    visits: pa.Table, ice: NewIce, alerts: list[tuple[int, Alert]]
) -> list[tuple[IntArray, int]]:
    """Return a pair for each patch of new ice that vehicles visited: the grid numbers of its cells,
    and the time [ns] of the first alert for the patch (NEVER if there was no alert).
    """
    cells = np.unique(visits["cell"].to_numpy()[ice.find_visits(visits)])
    label = link_cells(cells)
    found = []
    for number in range(int(label.max(initial=-1)) + 1):
        own = cells[label == number]
        inside = set(own.tolist())
        alert_times = [
            at for at, one in alerts if one.raised and one.cell in inside and at >= ice.since_ns
        ]
        found.append((own, min(alert_times, default=NEVER)))
    return found


def count_passes(rows: pa.Table) -> int:
    """Return the number of passes in `rows`, a table of visits. A visit is a passage of one map
    cell; successive visits of one vehicle shortly after each other are one pass.
    """
    order = rows.sort_by([("vehicle", "ascending"), ("enter_time", "ascending")])
    vehicle = order["vehicle"].to_numpy(zero_copy_only=False)
    enter = order["enter_time"].cast(pa.int64()).to_numpy()
    left = order["leave_time"].cast(pa.int64()).to_numpy()
    if not len(order):
        return 0
    return 1 + int(np.sum((vehicle[1:] != vehicle[:-1]) | (enter[1:] - left[:-1] > PASS_GAP_NS)))


class DemoRun(NamedTuple):
    """Results of one run of the demo: the true values of all visits, the alerts with their times
    [ns], the ice that appears, and the counts of the agents.
    """

    visits: pa.Table
    alerts: list[tuple[int, Alert]]
    ice: NewIce
    counts: dict[str, float]


def demo_figures(
    comparison: MapComparison, run: DemoRun, archive: Path, wall_s: float
) -> list[Figure]:
    """Return all figures (measured values) of the demo about map, alerts and archive, each with its
    target. `wall_s` [s] is the duration of the demo.
    """
    visits, alerts, ice, counts = run
    several = comparison.has_several_vehicles
    value = comparison.has_several_vehicles & comparison.is_measured
    error = comparison.cells["mu"].to_numpy() - comparison.truth
    rows, distinct, vehicles = archive_counts(archive)
    false, _ = false_ice([alert for _, alert in alerts if alert.raised], visits)
    return [
        Figure("demo.vehicles", vehicles, "", 30, "more"),
        Figure(COVERAGE, mean_or_nan(comparison.is_covered[several]), "", (0.80, WIDEST), "within"),
        Figure("demo.map.rmse", float(np.sqrt(mean_or_nan(error[value] ** 2))), "", 0.12),
        Figure(
            DELAY,
            delay_passes(visits, ice, alerts),
            "passes, median of the new patches",
            3,
        ),
        Figure("demo.alerts.on_dry_roads", false, "alerts", 0),
        Figure(
            "demo.alerts.per_stretch",
            per_stretch(alerts, visits),
            "per icy stretch and direction",
            2,
        ),
        Figure("demo.observations.unacknowledged", counts["observations_unsettled"], "", 0),
        Figure("demo.observations.duplicates", rows - distinct, "", 0),
        Figure(WALL, wall_s, "s", 240),
        Figure("demo.observations", rows, ""),
        Figure("demo.map.cells", len(comparison.cells), ""),
        Figure("demo.map.cells_measured", int(value.sum()), "with two or more vehicles"),
    ]


@dataclass(frozen=True)
class LostGrip:
    """Passes over new ice after the first alert for the patch of ice, one row per pass. `warned` is
    True if the driver receives warnings, and `lost` is True if a wheel lost its grip.

    `cell` is the cell in which grip was lost, or the first cell of the pass.
    """

    warned: BoolArray
    lost: BoolArray
    cell: IntArray

    def figures(self) -> list[Figure]:
        """Return the figures for warned and for unwarned drivers: the share of passes over new ice
        in which grip was lost, and the number of passes.
        """
        kinds = (("warned", self.warned), ("unwarned", ~self.warned))
        # Without passes there is no share.
        shares = [
            Figure(f"demo.lost_grip.{name}", mean_or_nan(self.lost[rows]), "of passes")
            for name, rows in kinds
            if rows.any()
        ]
        counts = [int(rows.sum()) for _, rows in kinds]
        return shares + [
            Figure(f"{PASSES}.{name}", count, "over new ice", ENOUGH, "more")
            for (name, _), count in zip(kinds, counts, strict=True)
        ]

    def line(self) -> str:
        """Return one line of text that states, for warned and for unwarned drivers, how many of
        their passes over new ice lost grip.
        """
        counts = [
            f"{int(self.lost[rows].sum())} of {int(rows.sum())}"
            for rows in (self.warned, ~self.warned)
        ]
        known = "On the new ice, after it was known"
        return f"{known}: {counts[0]} warned drivers lost grip, and {counts[1]} unwarned drivers."


def lost_grip(
    visits: pa.Table, alerts: list[tuple[int, Alert]], ice: NewIce, share: float
) -> LostGrip:
    """Find the passes of cars over new ice after the first alert for the patch of ice. Return for
    each pass if the driver was warned and if a wheel lost its grip.

    `share` is the share of the drivers who receive warnings. It determines which of the vehicles
    have a warned driver.
    """
    on = ice.find_visits(visits)
    since = np.full(visits.num_rows, NEVER)
    for cells, known in known_patches(visits, ice, alerts):
        since[np.isin(visits["cell"].to_numpy(), cells)] = known
    vehicles = [str(name) for name in visits["vehicle"].to_pylist()]
    count = max((_vehicle_number(name) for name in vehicles), default=0)
    warned = choose_warned(count, share)
    passes: dict[tuple[str, int], tuple[bool, int]] = {}  # lost, cell; by vehicle and number
    enter = visits["enter_time"].cast(pa.int64()).to_numpy()
    left = visits["leave_time"].cast(pa.int64()).to_numpy()
    last: dict[str, tuple[int, int]] = {}
    order = np.argsort(enter, kind="stable")
    for k in order[on[order] & (enter[order] >= since[order])].tolist():
        name = vehicles[k]
        cell = int(visits["cell"][k].as_py())
        number, left_ns = last.get(name, (0, -PASS_GAP_NS))
        if enter[k] - left_ns > PASS_GAP_NS:
            number += 1
        last[name] = (number, int(left[k]))
        lost = bool(visits["utilisation"][k].as_py() >= LOST)
        before = passes.get((name, number))
        if before is None or (lost and not before[0]):
            passes[name, number] = (lost, cell)
    return LostGrip(
        np.array([warned[_vehicle_number(name) - 1] for name, _ in passes], np.bool_),
        np.array([lost for lost, _ in passes.values()], np.bool_),
        np.array([cell for _, cell in passes.values()], np.int64),
    )


def _vehicle_number(vehicle: str) -> int:
    return int(vehicle.rpartition("-")[2])


def per_stretch(alerts: list[tuple[int, Alert]], visits: pa.Table) -> float:
    """Return the number of road stretches for which an alert was raised, divided by the number of
    truly icy stretches (counted per driving direction); NaN without ice.
    """
    road = Stretches()
    ids = set[str]()
    for _, alert in alerts:
        road.apply_alert(alert)
        ids |= {one.id for one in road.take_changes()}
    icy = visits.filter(pc.less(visits["mu"], pa.scalar(SLIPPERY_MU)))
    cell = icy["cell"].to_numpy()
    sector = icy["sector"].to_numpy()
    stretches = sum(
        int(link_cells(np.unique(cell[sector == k])).max(initial=-1)) + 1 for k in np.unique(sector)
    )
    return len(ids) / stretches if stretches else float("nan")


def archive_counts(archive: Path) -> tuple[int, int, int]:
    """Return three counts of the observations in the archive: rows, distinct rows, and distinct
    vehicles.
    """
    identity = ["vehicle", "boot", "region", "seq", "row"]
    tables = list(reading.read_tables(archive, Kind.OBSERVATION, identity))
    if not tables:
        return 0, 0, 0
    whole = pa.concat_tables(tables)
    return (
        whole.num_rows,
        whole.group_by(identity).aggregate([]).num_rows,
        len(pc.unique(whole["vehicle"])),
    )


def start_time(visits: pa.Table) -> int:
    """Return the time [ns] of the earliest visit of any vehicle."""
    return int(visits["enter_time"].cast(pa.int64()).to_numpy().min())


def _cell_keys(table: pa.Table) -> list[tuple[int, int]]:
    return list(
        zip(table["cell"].to_numpy().tolist(), table["sector"].to_numpy().tolist(), strict=True)
    )
