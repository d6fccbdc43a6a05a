"""Detection campaign: evaluate the detection of slippery road in simulated towns, on short and on
long drives. "rough" cars have large sensor errors, as real cars have; "plain" cars have small
errors.

Half of the towns are winter towns, in which all cars have winter equipment. To evaluate chosen
towns and print a table:

    python -m edge_agent.lab.evaluation.detection_campaign 50001:rough 50002:plain:900

Each town is SEED, SEED:KIND, SEED:KIND:SECONDS or SEED:KIND:SECONDS:winter. KIND is the kind of
cars, rough or plain.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.evaluation.detection import KINDS, DetectionResults, TownTally, judge_drive
from edge_agent.lab.evaluation.detection_bars import detection_figures
from edge_agent.lab.evaluation.detection_drives import (
    RATE_HZ,
    BankMaker,
    DetectionDrive,
    drive_fleet,
)
from edge_agent.lab.evaluation.real_world import in_winter
from edge_agent.lab.evaluation.report import detection_table
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.scenarios import drawn_town, winter
from schemas.errors import InputError
from schemas.runtime.figures import Figure

SHORT_S: Final = 120.0
LONG_S: Final = 900.0
LONGER_THAN_SHORT_S: Final = 300.0  # [s] minimum duration of a town that counts as long
CARS: Final = 16
SHORT_TOWNS: Final = 10
LONG_TOWNS: Final = 4
QUICK_CARS: Final = 4
QUICK_S: Final = 45.0
DEFAULT: Final = "aco-fckf"


class DetectionTown(NamedTuple):
    """A simulated town to evaluate. The seed determines its random friction and hills. The other
    fields are the kind of cars, the duration of the drives [s], the number of cars, and `winter`.

    The kind of cars is "rough" (large sensor errors, as in real cars) or "plain" (small sensor
    errors). `winter` is True for a winter town.
    """

    seed: int
    kind: str
    seconds: float
    cars: int = CARS
    winter: bool = False

    @property
    def length(self) -> str:
        """Return "short" or "long", the class of the town's duration."""
        return "long" if self.seconds >= LONGER_THAN_SHORT_S else "short"


def simulate_towns(seeds: Sequence[int], *, quick: bool) -> list[DetectionTown]:
    """Return the simulated towns of the campaign, whose friction and hills are drawn by seed. Towns
    with an odd seed are winter towns.

    Each seed is used once with "rough" cars (large sensor errors, as in real cars) and once with
    "plain" cars (small sensor errors). Short and long drives use different seeds if there are
    enough. With `quick`, return only one small town per kind of cars.
    """
    if quick:
        return [
            DetectionTown(seeds[0], kind, QUICK_S, QUICK_CARS, winter=kind == "plain")
            for kind in KINDS
        ]
    short = seeds[:SHORT_TOWNS]
    long = seeds[SHORT_TOWNS:][:LONG_TOWNS] or seeds[:LONG_TOWNS]
    lengths = [(seed, SHORT_S) for seed in short] + [(seed, LONG_S) for seed in long]
    return [
        DetectionTown(seed, kind, s, winter=in_winter(seed))
        for kind in KINDS
        for seed, s in lengths
    ]


def drive_town(town: DetectionTown, make_bank: BankMaker) -> DetectionDrive:
    """Simulate the drives of the cars of a town, and estimate their motion and friction."""
    scenario = winter(town.seed) if town.winter else drawn_town(town.seed)
    rough = float(town.kind == "rough")
    fleet = SimulatedFleet(
        scenario, town.cars, town.seed, RATE_HZ, rough=rough, winter=float(town.winter)
    )
    return drive_fleet(fleet, make_bank(fleet.vehicles), town.seconds)


def judge_towns(
    chosen: Sequence[DetectionTown],
    make_bank: BankMaker,
    log_line: Callable[[str], None],
    *,
    oracle: bool = True,
) -> DetectionResults:
    """Simulate the drives in some towns, and evaluate the detection of slippery road. With
    `oracle`, also run the oracle (an observer that knows motion and tyre forces) in towns with
    short drives. `log_line` receives one line per town.
    """
    results = DetectionResults()
    for town in chosen:
        tally = judge_drive(drive_town(town, make_bank), oracle=oracle and town.length == "short")
        results.add(town.length, town.kind, TownTally(town.winter, tally))
        log_line(
            f"town {town.seed}{' in winter' if town.winter else ''}, {town.kind}, "
            f"{town.seconds:.0f} s: "
            f"ice visits with a value {tally.mean('ice.yield'):.2f}, passes found "
            f"{tally.mean('passes.ice'):.2f}, false ice {tally.mean('false_ice'):.5f}"
        )
    return results


def run_detection_campaign(
    seeds: Sequence[int], log_line: Callable[[str], None], *, quick: bool, estimator: str = DEFAULT
) -> DetectionResults:
    """Evaluate how well an estimator detects slippery road in all towns of the campaign. `seeds`
    are the seeds of the towns; `log_line` receives one line of progress per town.
    """
    return judge_towns(
        simulate_towns(seeds, quick=quick), lambda vehicles: bank_of(estimator, vehicles), log_line
    )


def town_named(text: str) -> DetectionTown:
    """Return the town described by SEED[:KIND[:SECONDS[:winter]]].

    Raises:
        InputError: the text does not have this form.
    """
    usual = ("", "rough", "120", "")
    parts = text.split(":")
    seed, kind, seconds, season = [*parts, *usual[len(parts) :]][:4]
    is_valid = (
        seed.isdecimal()
        and kind in KINDS
        and seconds.replace(".", "", 1).isdecimal()
        and season in ("", "winter")
    )
    if len(parts) > len(usual) or not is_valid:
        raise InputError(
            "town", f"{text!r} is not a town", "give SEED, SEED:plain:900 or SEED:plain:900:winter"
        )
    return DetectionTown(int(seed), kind, float(seconds), winter=season == "winter")


def main(arguments: Sequence[str] | None = None) -> None:
    """Evaluate the detection of slippery road in the towns given on the command line, and print a
    table.
    """
    parse = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parse.add_argument(
        "towns", nargs="+", type=town_named, help="SEED, SEED:KIND, SEED:KIND:SECONDS[:winter]"
    )
    parse.add_argument(
        "--estimator", default=DEFAULT, help="name of the estimator (default %(default)s)"
    )
    parse.add_argument(
        "--cars", type=int, default=CARS, help="vehicles in each town (default %(default)s)"
    )
    parse.add_argument("--no-oracle", action="store_true", help="omit the figures of the oracle")
    parse.add_argument(
        "--json", type=Path, help="file for the figures, a JSON object of name and value"
    )
    args = parse.parse_args(arguments)
    began = time.monotonic()
    results = judge_towns(
        [town._replace(cars=args.cars) for town in args.towns],
        lambda vehicles: bank_of(args.estimator, vehicles),
        lambda line: print(
            f"{time.monotonic() - began:6.1f} s  {line}", file=sys.stderr, flush=True
        ),
        oracle=not args.no_oracle,
    )
    figures: list[Figure] = detection_figures(results)
    print(detection_table(figures))
    if args.json:
        args.json.write_text(
            json.dumps({figure.name: figure.value for figure in figures}, indent=1)
        )


if __name__ == "__main__":
    main()
