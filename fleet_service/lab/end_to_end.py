"""End-to-end evaluation: simulated vehicles with the real estimator drive, their observations are
fused, and the map is compared with the true road.

A command of the agent's laboratory (`edge_agent.lab.end_to_end`) drives the vehicles. It runs in a
process of its own, because the service must not import the agent. This module reads the files that
the command writes.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.lab.drive import LATENESS_S
from fleet_service.lab.resampled import DrivenVisits, TrueVisits, attach_truth
from fleet_service.lab.score import SURE_GRIP, Scores, mean_or_nan, of_beliefs, safe_share
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.view import LOWER, UPPER, is_measured
from schemas import grid, mugrid, wire
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import EXCITED_SHARE, NS
from schemas.wire import Alert

OBSERVATIONS = "observations.parquet"
TRUTH = "truth.parquet"
# Smallest number of vehicles of an evaluated cell, because one vehicle's report is not a map.
SEVERAL: Final = 2
SAME: Final = 0.02  # largest difference of μ within a cell that counts as one surface

# Function that simulates a drive and writes both files into a folder.
Drive = Callable[[Path], None]


class World(NamedTuple):
    """Conditions of a simulated drive.

    Attributes:
        scenario: scenario of the simulator.
        rough: share of vehicles with realistic ("rough") sensor errors.
        prefix: first part of the names of this drive's figures.
        seed: seed of the simulation.
    """

    scenario: str
    rough: float
    prefix: str
    seed: int = 20_000


WHOLE_WAY: Final = "fusion.whole_way"  # prefix of the names of these figures
LEVEL: Final = World("demo", 0.0, f"{WHOLE_WAY}.level")
# Friction and hills of this world were not used for tuning.
HILLS: Final = World("hills-20000", 0.5, f"{WHOLE_WAY}.hills")
# Ten towns with friction and hills of their own. Half of the vehicles have the errors of real cars.
# All cells of one drive have the same snow, so P(slippery) needs many drives. Figures of all drives
# together have no further name, see `moments.ask_moments`.
WAYS: Final = tuple(
    World(f"hills-{seed}", 0.5, f"{WHOLE_WAY}.{seed}", seed) for seed in range(20_001, 20_011)
)


def drive_command(vehicles: int, seconds: float, world: World) -> Drive:
    """Return a function that simulates a drive in `world` with the command `python -m
    edge_agent.lab.end_to_end`, which writes its files to the folder given to the function.
    """

    def run_drive(folder: Path) -> None:
        options = ["--out", str(folder), "--vehicles", str(vehicles), "--duration", str(seconds)]
        options += ["--scenario", world.scenario, "--rough", str(world.rough)]
        options += ["--seed", str(world.seed)]
        done = subprocess.run(
            [sys.executable, "-m", "edge_agent.lab.end_to_end", *options], check=False
        )
        if done.returncode:
            raise InputError(
                "end-to-end",
                "the simulated vehicles failed",
                "see the output above, or use --skip-end-to-end",
            )

    return run_drive


def measure(drive: Drive, folder: Path, world: World = LEVEL) -> dict[str, float]:
    """Return figures of the map after one simulated drive, by name. Only cells that at least
    SEVERAL vehicles visited are judged.

    One figure is the share of the judged cells whose 90 % interval contains the true friction.
    Another is the error of μ in the judged cells where the map contains a measurement, not only a
    lower bound. The numbers of alerts and observations are also included.
    """
    folder = folder / world.prefix.removeprefix("fusion.")
    drive(folder)
    columns = read_observations(folder / OBSERVATIONS)
    visits = pq.read_table(folder / TRUTH)
    fusion = Fusion(LATENESS_S)
    raised = raised_alerts(fusion, observations_in(columns))
    false, next_to_ice = false_ice(raised, visits)
    slots, truth = slots_with_truth(fusion, visits)
    several = fusion.live.vehicles[slots] >= SEVERAL
    slots = slots[several]
    truth = truth[several]
    belief = fusion.beliefs(slots, int(fusion.live.time[: fusion.size].max()))
    scores = of_beliefs(belief, truth, excited_vehicles(fusion, visits)[slots])
    lower = mugrid.quantiles(belief, LOWER)
    upper = mugrid.quantiles(belief, UPPER)
    with_value = is_measured(
        lower, upper, fusion.live.values[slots], belief @ mugrid.SLIPPERY_SHARE
    )
    pure = with_value & one_surface(fusion, visits)[slots]
    found = _score_figures(scores, with_value) | {
        "rmse.one_surface": mean_or_nan(scores.error[pure] ** 2) ** 0.5,
        "safe95": safe_share(scores),
        "observations": float(len(columns["cell"])),
        "alerts": float(len(raised)),
        "false_ice": float(false),
        "false_ice.beside": float(next_to_ice),
    }
    return {f"{world.prefix}.{name}": value for name, value in found.items()}


def raised_alerts(fusion: Fusion, observations: Observations) -> list[Alert]:
    """Compute a map from the observations of a drive second by second, as a service does; return
    the alerts that were raised.
    """
    alerts = Alerts(fusion)
    raised = []
    second = (observations.time - observations.time.min()) // NS
    for rows in np.split(np.argsort(second, kind="stable"), np.cumsum(np.bincount(second))[:-1]):
        if len(rows):
            raised += [
                alert
                for alert in alerts.update(fusion.update(observations.take(rows)).slots)
                if alert.raised
            ]
    return raised


def false_ice(raised: Sequence[Alert], visits: pa.Table) -> tuple[int, int]:
    """Return two counts of alerts on wet or dry road: alerts without slippery road nearby, and
    alerts in a cell next to slippery road.

    A cell is slippery if any vehicle truly had less friction than SURE_GRIP in it before the alert.
    A cell is ten metres wide and positions are wrong by some metres, so an alert in the cell next
    to the ice is acceptable.
    """
    east, north = grid.deinterleave(visits["cell"].to_numpy())
    mu = visits["mu"].to_numpy()
    enter = visits["enter_time"].cast(pa.int64()).to_numpy()
    false = 0
    next_to_ice = 0
    for alert in raised:
        x, y = (int(value[0]) for value in grid.deinterleave(np.array([alert.cell])))
        far = np.maximum(np.abs(east - x), np.abs(north - y))
        slippery = (mu < SURE_GRIP) & (enter <= alert.time)
        if not (slippery & (far == 0)).any():
            is_near = bool((slippery & (far == 1)).any())
            false = false + (not is_near)
            next_to_ice = next_to_ice + is_near
    return false, next_to_ice


def _score_figures(scores: Scores, measured: np.ndarray[Any, Any]) -> dict[str, float]:
    value = scores.taken(measured)
    return {
        "coverage90": mean_or_nan(scores.covered),
        "rmse": mean_or_nan(value.error**2) ** 0.5,
        "coverage90.measured": mean_or_nan(value.covered),
        "bias.measured": mean_or_nan(value.error),
        "rmse.excited3": mean_or_nan(value.error[value.vehicles >= 3] ** 2) ** 0.5,
        "cells": float(len(scores.error)),
        "cells.measured": float(measured.sum()),
    }


def read_observations(path: Path) -> dict[str, Any]:
    """Return the columns of a file of observations, in the form in which the archive returns
    them.
    """
    table = pq.read_table(path)
    out = {}
    for name, dtype in wire.column_types(wire.Kind.OBSERVATION).items():
        if name == "log_likelihood":
            out[name] = np.frombuffer(
                b"".join(bytes(row) for row in table[name].to_pylist() if row is not None), np.uint8
            ).reshape(table.num_rows, -1)
        else:
            out[name] = table[name].to_numpy().astype(dtype)
    return out | {"vehicle": table["vehicle"].to_numpy()}


def driven_in(folder: Path) -> DrivenVisits:
    """Read the files of a simulated drive in `folder`. Return the visits (passages of cells) as
    columns: the vehicles' reports, and the true values of the simulation.
    """
    truth = pq.read_table(folder / TRUTH)
    _, vehicle = np.unique(truth["vehicle"].to_numpy(zero_copy_only=False), return_inverse=True)
    enter = truth["enter_time"].cast(pa.int64()).to_numpy()
    true = TrueVisits(vehicle, enter, truth["mu"].to_numpy(), truth["utilisation"].to_numpy())
    return attach_truth(read_observations(folder / OBSERVATIONS), true)


def observations_in(columns: dict[str, Any]) -> Observations:
    """Return columns of a drive as observations that a `Fusion` (the map's beliefs) accepts; each
    row is given as a separate batch (message with records).
    """
    n = len(columns["cell"])
    with_likelihood = np.full(n, columns["log_likelihood"].shape[1] > 0)
    identity = {
        "boot": columns["vehicle"] + 1,
        "region": grid.region_of(columns["cell"]),
        "seq": np.arange(1, n + 1),
        "row": np.zeros(n, np.int32),
        "with_likelihood": with_likelihood,
    }
    return observations_of(columns | identity, columns["vehicle"])


def slots_with_truth(fusion: Fusion, visits: pa.Table) -> tuple[IntArray, FloatArray]:
    """Return the slots (cell and heading sector) that vehicles truly visited, and the true friction
    of each. The friction is the mean over the visits in the last half minute of the drive, or over
    all visits if there were none in that time.
    """
    cell = visits["cell"].to_numpy()
    sector = visits["sector"].to_numpy()
    time = visits["leave_time"].cast(pa.int64()).to_numpy()
    recent = time > time.max() - 30 * NS
    slot = fusion.slots_of(cell, sector.astype(np.int64))
    total = np.zeros((2, fusion.size))
    count = np.zeros((2, fusion.size))
    for row, rows in enumerate((slot >= 0, (slot >= 0) & recent)):
        np.add.at(total[row], slot[rows], visits["mu"].to_numpy()[rows])
        np.add.at(count[row], slot[rows], 1)
    known = np.flatnonzero(count[0] > 0)
    row = (count[1] > 0).astype(np.int64)[known]
    return known, total[row, known] / count[row, known]


def one_surface(fusion: Fusion, visits: pa.Table) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return a mask of slots, (slots,): True if all visits to the slot truly had the same
    friction.
    """
    slot = fusion.slots_of(visits["cell"].to_numpy(), visits["sector"].to_numpy().astype(np.int64))
    mu = visits["mu"].to_numpy()
    known = slot >= 0
    least = np.full(fusion.size, np.inf)
    most = np.zeros(fusion.size)
    np.minimum.at(least, slot[known], mu[known])
    np.maximum.at(most, slot[known], mu[known])
    return np.asarray(most - least <= SAME)


def excited_vehicles(fusion: Fusion, visits: pa.Table) -> IntArray:
    """Return, for each slot, the number of distinct vehicles that used at least the share
    EXCITED_SHARE of the grip there, (slots,).
    """
    rows = visits["utilisation"].to_numpy() >= EXCITED_SHARE
    slot = fusion.slots_of(visits["cell"].to_numpy(), visits["sector"].to_numpy().astype(np.int64))
    _, who = np.unique(visits["vehicle"].to_numpy(zero_copy_only=False), return_inverse=True)
    pairs = np.unique(np.stack([slot, who])[:, rows & (slot >= 0)], axis=1)
    return np.bincount(pairs[0], minlength=fusion.size)
