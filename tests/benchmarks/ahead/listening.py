"""Simulate a town whose cars receive the map and its alerts, and measure how many lose grip.

    python -m tests.benchmarks.ahead.listening --out DIR [--seeds 20] [--vehicles 36]
        [--duration 150] [--scenario hills-SEED]

No network is used. Every second the cars' observations are fused (combined into a map), as in a
fleet service. Alerts and, at intervals, tiles are passed to the listening cars as bytes. The drive
of each random seed is simulated twice from the same start: once with all cars receiving the map and
alerts, once with none. The figures are written to DIR/figures.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.ahead.cell_decoder import decode_alert_message, decode_cells
from edge_agent.ahead.horizon import horizon_length, look_ahead
from edge_agent.ahead.local_map import LocalMap
from edge_agent.ahead.path import Pose
from edge_agent.ahead.prior import MapPrior
from edge_agent.ahead.warnings import Active, update_warnings
from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.listeners import WarnedDrivers
from edge_agent.observe.pipeline import Pipeline
from fleet_service.fusion import Fusion
from fleet_service.lab.end_to_end import observations_in
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.encode import arrow_stream, batch_of
from fleet_service.serve.view import view_cells
from schemas import grid, keys, mugrid, wire
from schemas.config import AgentConfig
from schemas.numeric import FloatArray, IntArray
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.thresholds import NS, SLIPPERY_MU

RATE_HZ: Final = 100.0
BLOCK: Final = 50  # [samples] half a second
START_NS: Final = 1_800_000_000 * NS
LATENESS_S: Final = 120.0
ASKED_S: Final = 30.0  # time between two readings of the map's tiles
SEEDS: Final = 20  # drives of a campaign that is compared with targets
LOST: Final = 0.98  # share of the available grip at which a wheel counts as sliding


@dataclass
class Drive:
    """Result of one simulated drive of all cars, computed with the simulator's true values. "New
    ice" is the ice that appears during the drive. "Lap" means one passage of a car over the new
    ice.
    """

    # (vehicle, lap) of the laps in which a wheel lost its grip on the new ice.
    slid: set[tuple[int, int]] = field(default_factory=set)
    # (vehicle, lap) of all laps.
    passed: set[tuple[int, int]] = field(default_factory=set)
    alert_passes: float = float("nan")  # number of laps before the first alert of the new ice
    # For each cell that several vehicles visited: True if the map's interval contains the true
    # friction.
    inside: list[bool] = field(default_factory=list)
    visits: int = 0  # number of visits (passages of a cell) that were fused into the map
    alerts: int = 0  # number of alerts on the new ice
    warnings: int = 0  # number of warnings that the cars gave
    # Absolute errors of the friction estimate with and without the map, in cells that the map
    # knows.
    known_error: list[tuple[float, float]] = field(default_factory=list)


class ListeningTown:
    """Simulated town with its cars and the fusion of their reports into a map. One object simulates
    one drive, second by second.
    """

    def __init__(
        self, scenario: str, vehicles: int, seed: int, *, listening: bool, rough: float = 0.5
    ) -> None:
        self.fleet = SimulatedFleet(scenario, vehicles, seed, RATE_HZ, rough=rough)
        config = AgentConfig()
        self.bank = bank_of(config.estimator, self.fleet.vehicles)
        self.pipeline = Pipeline(self.bank, vehicles, config)
        self.fusion = Fusion(LATENESS_S)
        self.alerts = Alerts(self.fusion)
        self.drivers = WarnedDrivers(self.fleet, 1.0 if listening else 0.0)
        self.received_map = LocalMap()
        self.prior = MapPrior(vehicles)
        self.active: list[tuple[Active, ...]] = [()] * vehicles
        self.drive = Drive()
        self.ice = self.fleet.scenario.events[0]
        self._listening = listening
        self._last_query = -ASKED_S
        self._lap = np.zeros(vehicles, np.int64)
        self._was_on_ice = np.zeros(vehicles, np.bool_)
        self._true: dict[int, float] = {}  # friction of each place when it was last driven over

    def run(self, duration_s: float) -> Drive:
        """Simulate a drive of the town's cars for `duration_s` [s], and evaluate the map at the end
        of the drive. Return the results, such as how many cars lost grip and how well the map fits
        the true friction.
        """
        for second in range(int(duration_s)):
            parts = [self._simulate_block() for _ in range(round(RATE_HZ / BLOCK))]
            self._fuse([part for part in parts if len(part["cell"])])
            if self._listening:
                self._receive_map(second)
                self._warn_drivers()
        self.drive.inside = self._check_intervals()
        self.drive.visits = self.fusion.live.visits[: self.fusion.size].sum()
        return self.drive

    def _check_intervals(self) -> list[bool]:
        """Return one boolean for each cell and heading sector that several vehicles visited. It is
        True if the map's friction interval at the end of the drive contains the true friction of
        the last visit.
        """
        place = np.array(list(self._true), np.int64)
        slots = self.fusion.slots_of(place // grid.SECTORS, place % grid.SECTORS)
        several = slots >= 0
        several[several] = self.fusion.live.vehicles[slots[several]] >= 2
        belief = self.fusion.beliefs(slots[several], self._now())
        truth = np.array(list(self._true.values()))[several]
        lower, upper = (mugrid.quantiles(belief, q) for q in (0.05, 0.95))
        return [bool(inside) for inside in (lower <= truth) & (truth <= upper)]

    def _simulate_block(self) -> dict[str, Any]:
        t, signals = self.fleet.step(BLOCK)
        samples = Block(t, to_utc_ns(t, START_NS), signals)
        _, seen, _ = self.pipeline.step(samples)
        self._record_truth(float(t[-1, 0]))
        if self._listening:
            self._compare_estimates()
        return seen.columns | {"vehicle": seen.vehicle}

    def _record_truth(self, now: float) -> None:
        """Record, from the true values of the simulator at the time `now` [s], which cars are on
        the new ice and which of them slide there.
        """
        true = self.fleet.truth
        patch = self.ice
        cells = grid.cell_of(*self.fleet.scenario.to_latlon(true.x[-1], true.y[-1]))
        places = cells * grid.SECTORS + grid.sector_of(true.yaw[-1])
        self._true |= dict(
            zip(places.tolist(), true.mu_wheel[-1].mean(axis=1).tolist(), strict=True)
        )
        on_patch = (np.abs(true.x - patch.x) <= patch.length / 2) & (
            np.abs(true.y - patch.y) <= patch.width / 2
        )
        on_patch &= (now >= patch.start) & (true.mu_wheel.mean(axis=2) < SLIPPERY_MU)
        is_on_ice = on_patch.any(axis=0)
        self._lap += is_on_ice & ~self._was_on_ice
        self._was_on_ice[:] = is_on_ice
        slid = (on_patch & (true.utilisation.max(axis=2) >= LOST)).any(axis=0)
        self.drive.passed |= {(k, int(self._lap[k])) for k in np.flatnonzero(is_on_ice).tolist()}
        self.drive.slid |= {(k, int(self._lap[k])) for k in np.flatnonzero(slid).tolist()}

    def _fuse(self, parts: list[dict[str, Any]]) -> None:
        if not parts:
            return
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        raised = self.alerts.update(self.fusion.update(observations_in(columns)).slots)
        now = self._now()
        for alert in raised:
            if alert.raised and self._is_new_ice(alert.latitude, alert.longitude):
                if not self.drive.alerts:
                    self.drive.alert_passes = float(len(self.drive.passed))
                self.drive.alerts += 1
            key = keys.alert_key(int(grid.tile_of(alert.cell)))
            self.received_map.store_alert(
                decode_alert_message(key, wire.encode_alert(alert), now), now
            )

    def _receive_map(self, second: int) -> None:
        """Pass the active alerts to the listening cars. Every ASKED_S seconds, also pass all map
        tiles. `second` is the time since the start of the drive [s].
        """
        now = self._now()
        for alert in self.alerts.standing_alerts:
            self.received_map.store_alert(alert, now)
        if second - self._last_query < ASKED_S:
            return
        self._last_query = second
        slots = np.arange(self.fusion.size)
        tiles = grid.tile_of(self.fusion.live.key[: self.fusion.size] // grid.SECTORS)
        for tile in np.unique(tiles).tolist():
            payload = arrow_stream(
                batch_of(view_cells(self.fusion, slots[tiles == tile], now), now)
            )
            self.received_map.store_cells(*decode_cells(keys.map_key(tile), payload, now), now)

    def _warn_drivers(self) -> None:
        self.drivers.update_routes()
        seen = self.pipeline.seen
        assert seen is not None
        for k, row in enumerate(zip(*(column.tolist() for column in seen), strict=True)):
            pose = Pose(*row)
            route = self.drivers.route_of(k)
            path = route.ahead(pose, horizon_length(pose.speed)) if route is not None else None
            if path is None:
                continue
            self.active[k], issued = update_warnings(
                self.active[k],
                [look_ahead(path, self.received_map, pose.time)],
                pose,
                self.received_map,
            )
            self.drive.warnings += sum(one.state == "raised" for one in issued)
            for warning in issued:
                self.drivers.store_warning(self.fleet.names[k], warning)
        self.drivers.deliver_warnings()

    def _compare_estimates(self) -> None:
        beliefs = self.bank.beliefs()
        seen = self.pipeline.seen
        if beliefs is None or seen is None:
            return
        key: IntArray = self.pipeline.places
        map_beliefs: dict[int, FloatArray | None] = {
            k: self.received_map.belief_at(int(key[k]), self._now()) if key[k] >= 0 else None
            for k in self.prior.entered_vehicles(key)
        }
        informed = self.prior.step(key, *beliefs, map_beliefs)
        alone = np.exp(beliefs[0])
        truth = self.fleet.truth.mu_wheel[-1].mean(axis=1)
        for k, belief in map_beliefs.items():
            if belief is not None:
                errors = [
                    abs(float(mugrid.quantiles(p[k], 0.5)) - truth[k]) for p in (informed, alone)
                ]
                self.drive.known_error.append((errors[0], errors[1]))

    def _is_new_ice(self, latitude: float, longitude: float) -> bool:
        x, y = self.fleet.scenario.from_latlon(np.array([latitude]), np.array([longitude]))
        near = 12.0
        return bool(
            abs(x[0] - self.ice.x) <= self.ice.length / 2 + near
            and abs(y[0] - self.ice.y) <= self.ice.width / 2 + near
        )

    def _now(self) -> int:
        seen = self.pipeline.seen
        return int(seen.time.max()) if seen is not None else START_NS


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line: simulate the drive of each seed with and without cars that receive the
    map, and write the figures.
    """
    parser = argparse.ArgumentParser(
        prog="tests.benchmarks.ahead.listening", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=FIGURES, help="seed")
    parser.add_argument("--vehicles", type=int, default=36)
    parser.add_argument("--duration", type=float, default=150.0, help="duration of the drive [s]")
    parser.add_argument(
        "--scenario", default="hills-SEED", help="scenarios (default: hills-SEED of each seed)"
    )
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    with_: list[Drive] = []
    without: list[Drive] = []
    for seed in range(args.first, args.first + args.seeds):
        for listening, out in ((True, with_), (False, without)):
            drive = ListeningTown(
                args.scenario.replace("SEED", str(seed)), args.vehicles, seed, listening=listening
            ).run(args.duration)
            out.append(drive)
            passes = (
                f"{len(drive.slid)} of {len(drive.passed)} passes lost grip, alert after "
                f"{drive.alert_passes:.0f}"
            )
            notes = f"{drive.alerts} alerts on the ice, {drive.warnings} warnings"
            print(
                f"  seed {seed} {'listening' if listening else 'not listening'}: {passes}; {notes}",
                flush=True,
            )
    found = measure(with_, without)
    campaign = "tests.benchmarks.ahead.listening" + (
        f" --seeds {args.seeds}" if args.seeds < SEEDS else ""
    )
    figures.write_figures(
        args.out / "figures.json", campaign, [args.first, args.first + args.seeds - 1], found
    )
    print(figures.format_table(found))
    return 0 if all(figure.holds for figure in found if figure.bar is not None) else 1


def measure(with_: list[Drive], without: list[Drive]) -> list[Figure]:
    """Return the figures of the comparison between two groups of simulated drives with the same
    seeds. In the drives `with_`, the cars receive the map and its alerts. In the drives `without`,
    they receive nothing.
    """
    slid, before = (
        sum(len({k for k, _ in drive.slid}) for drive in drives) for drives in (with_, without)
    )
    laps, laps_before = (sum(len(drive.slid) for drive in drives) for drives in (with_, without))
    errors = np.array([pair for drive in with_ for pair in drive.known_error]).reshape(-1, 2)
    inside = [[row for drive in drives for row in drive.inside] for drives in (with_, without)]
    covered = [float(np.mean(rows)) if rows else float("nan") for rows in inside]
    alert_passes = [drive.alert_passes for drive in without if np.isfinite(drive.alert_passes)]
    with_map, alone = errors.mean(axis=0) if len(errors) else (float("nan"), float("nan"))
    return [
        Figure("ahead.lost_grip_ratio", slid / before if before else float("nan"), "", 0.5),
        Figure("ahead.lost_grip.with", laps, "passes"),
        Figure("ahead.lost_grip.without", laps_before, "passes"),
        Figure(
            "ahead.lost_grip.passes",
            sum(len(drive.passed) for drive in with_),
            "over new ice, with",
        ),
        Figure(
            "ahead.alert_passes",
            float(np.median(alert_passes)) if alert_passes else float("nan"),
            "median",
        ),
        Figure("prior.map_loop", abs(covered[0] - covered[1]), "", 0.02),
        Figure("prior.map_loop.coverage90", covered[0], "of cells, all listen"),
        Figure("prior.map_loop.coverage90.deaf", covered[1], "of cells, none does"),
        Figure(
            "prior.map_loop.visits",
            float(sum(drive.visits for drive in with_)),
            "fused, all listen",
        ),
        Figure("prior.entry_error_ratio.town", float(with_map / alone), "", None),
    ]


if __name__ == "__main__":
    sys.exit(main())
