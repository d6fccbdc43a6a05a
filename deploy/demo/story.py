"""Sequence of the demo: start the parts, let the fleet drive, compare the map with the true road,
and report.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import time
import webbrowser
from importlib.util import find_spec
from pathlib import Path

import pyarrow.parquet as pq

from deploy.demo import compare, page, processes, screenshot
from deploy.demo.ice import new_ice
from deploy.demo.listener import Listener
from edge_agent.lab.simulation.scenarios import Scenario, scenario_named
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli.common import stop_on_signals
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime import commandline, figures
from schemas.runtime.zenoh_session import open_session

FOLDER = Path(".demo")
REPORT_S = 5.0  # [s] time between two progress lines


def drive_fleet(
    folder: Path, endpoint: str, args: argparse.Namespace
) -> tuple[Listener, dict[str, float]]:
    """Let the simulated fleet drive. Return two results: the listener, which holds the received map
    and alerts, and the counts that the fleet's process printed.
    """
    session = open_session(ZenohSettings(connect=[endpoint]))
    if session is None:
        raise processes.DemoError(f"no session to {endpoint}")
    listener = Listener(session)
    fleet = processes.start_fleet(folder, args.vehicles, args.duration, args.seed, args.warned)
    began = time.monotonic()

    def print_progress() -> None:
        print(f"  {time.monotonic() - began:4.0f} s  {listener.progress()}", flush=True)

    try:
        code = fleet.wait(REPORT_S, print_progress)
    finally:
        fleet.stop()
    # Records without acknowledgement, for which the exit code is 1, are a figure of the demo.
    if code not in (0, commandline.FAILED):
        raise processes.DemoError(f"the simulated fleet failed; see {fleet.log}")
    return listener, fleet.report()


def show_clients(folder: Path, endpoint: str, comparison: compare.MapComparison) -> None:
    """Run a client that uses no GripMap code and sends one map query; then print how to read the
    archive's Parquet files.
    """
    sides = [comparison.cells[side].to_numpy() for side in ("west", "south", "east", "north")]
    bbox = ",".join(
        f"{value:.6f}" for value in (sides[0].min(), sides[1].min(), sides[2].max(), sides[3].max())
    )
    print("\nA client with only a Zenoh library queries the map:", flush=True)
    subprocess.run([sys.executable, "-m", "deploy.demo.plain_client", endpoint, bbox], check=True)
    compact(folder / "archive")
    print(f"""
The observations are Parquet files; for example, with DuckDB:
  import duckdb
  print(duckdb.sql("select sector, count(*), median(mu), count(distinct vehicle)
                    from '{folder}/archive/observations/*/*/*.parquet'
                    where value group by sector"))""")


def report_figures(
    folder: Path,
    comparison: compare.MapComparison,
    measured: list[figures.Figure],
    grip: compare.LostGrip,
    seed: int,
) -> list[figures.Figure]:
    """Write and print all figures of the demo, and draw the map with marks where cars lost grip on
    the new ice; return the figures.
    """
    found = [*measured, *grip.figures()]
    figures.write_figures(folder / "figures.json", "demo", [seed], found)
    image = ""
    # A picture in addition to the page, if matplotlib is installed.
    if find_spec("matplotlib") is not None:
        from deploy.demo import picture

        picture.draw_maps(comparison, folder / "map.png", grip)
        image = f"picture {folder}/map.png, "
    page.write_page(comparison, found, folder / "map.html")
    table = figures.format_table(found)
    print(f"\n{grip.line()}\n\n{table}\n", flush=True)
    print(f"{image}page {folder}/map.html, figures {folder}/figures.json", flush=True)
    return found


def _make_folder() -> None:
    """Make the empty folder of the demo. Raise an InputError if this is not possible."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    try:
        FOLDER.mkdir()
    except OSError as error:
        problem = f"cannot make the folder {FOLDER} ({error.strerror})"
        raise InputError("demo", problem, "start it in a folder that you may write to") from error


def _drive_and_judge(
    args: argparse.Namespace, scenario: Scenario, endpoint: str, began: float
) -> list[figures.Figure]:
    """Let the fleet drive, compare the map with the true road, and return the figures of the demo.
    `began` is the monotonic time at which the demo started [s].
    """
    listener, counts = drive_fleet(FOLDER, endpoint, args)
    visits = pq.read_table(FOLDER / "truth.parquet")
    ice = new_ice(scenario, compare.start_time(visits))
    comparison = compare.compare(listener.whole_map(), visits, ice.since_ns)
    compare.write_truth(visits, ice.since_ns, FOLDER / "overlay.parquet")
    show_clients(FOLDER, endpoint, comparison)
    listener.close()
    wall_s = time.monotonic() - began
    demo = compare.DemoRun(visits, listener.alerts, ice, counts)
    measured = compare.demo_figures(comparison, demo, FOLDER / "archive", wall_s)
    grip = compare.lost_grip(visits, listener.alerts, ice, args.warned)
    return report_figures(FOLDER, comparison, measured, grip, args.seed)


def run(args: argparse.Namespace) -> int:
    """Run the whole demo; return 1 if a figure misses a target that the demo must meet.

    Missed targets for the delay of the first alert, the number of passes and the duration are
    reported, but do not make the demo fail.

    Raises:
        InputError: the folder of the demo cannot be made.
        DemoError: a process of the demo failed.
    """
    # End by SIGTERM as by Ctrl-C: an exception, so that the processes of the demo are stopped.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    began = time.monotonic()
    _make_folder()
    scenario = scenario_named(processes.SCENARIO)
    appears_s = scenario.events[0].start
    print(
        f"{args.vehicles} vehicles drive for {args.duration:.0f} s; after {appears_s:.0f} s black "
        "ice appears."
    )
    with (
        processes.run_system(FOLDER, args.vehicles) as (endpoint, service),
        processes.run_page(FOLDER, endpoint, service, args.page_port) as address,
    ):
        print(f"\n  Live map: {address}\n", flush=True)
        if args.open:
            webbrowser.open(address)
        found = _drive_and_judge(args, scenario, endpoint, began)
        if args.screenshot is not None:
            screenshot.take_screenshot(address, args.screenshot)
        if args.stay:
            print(
                f"\n{address} runs until Ctrl-C; the page can show the true friction on top.",
                flush=True,
            )
            stop_on_signals().wait()
    return 0 if compare.demo_works(found) else 1
