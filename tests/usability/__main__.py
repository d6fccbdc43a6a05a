"""`make usability`: measure how easily a new user can use GripMap in the first hour, and write the
figures to `.usability/figures.json`.

--only NAME ... measures only these parts. A figure that is missing in the file counts as a failure.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import pytest

import fleet_service.cli
from deploy.router import open_router
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.doctor.report import report_page as doctors_page
from fleet_service.analytics import synthetic
from fleet_service.archive.maintenance.compaction import compact
from schemas.config import ZenohSettings
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.runtime.palette import ESTIMATORS, GRIP_RANGE, SURFACES, TRUTH, shade
from tests import reference_pages, results
from tests.benchmarks.inputs.planted import drives
from tests.browser import open_page
from tests.colour_vision import SIGHTS, colour_difference, to_lab
from tests.faults.processes import Part
from tests.first_drive import map_first_drive, read_commands
from tests.fleet_service.conftest import running
from tests.fleet_service.page import street
from tests.fleet_service.page.conftest import page_of
from tests.structure import ROOT
from tests.usability import listed_bugs, mistakes, waiting
from tests.usability.known_ice import KnownIce, find_hidden
from tests.usability.wrong_logs import WRONG, find_unnoticed
from tests.waiting import until

FOLDER: Final = ROOT / ".usability"
PAGES: Final = ("grip", "worst", "spells", "replay", "replay --step 10800")
SEED: Final = 9000
WORLD: Final = synthetic.SyntheticFleet(rows=6000, days=1, vehicles=20, roads=4, length=30, icy=2)
DAY: Final = ("--from", "2026-01-27", "--to", "2026-01-28")


class House:
    """Working folder that all measurements share. It contains a synthetic archive, and the files
    to which the wrong command lines in `mistakes` refer.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._readme: dict[str, Any] | None = None
        self.archive = folder / "archive"
        synthetic.write_archive(self.archive, WORLD, 2000)
        compact(self.archive)
        mistakes.prepare_files(folder)

    def follow_readme(self) -> dict[str, Any]:
        """Run the commands of the README and of the tutorials in a separate network namespace.
        Later calls return the result of the first. Return the failed commands, and for each map
        whether it was populated, or an empty result if the run itself failed.
        """
        if self._readme is None:
            folder = self.folder / "readme"
            folder.mkdir()
            line = f"ip link set lo up && exec {sys.executable} -m tests.usability.readme {folder}"
            command = ["unshare", "-n", "bash", "-c", line]
            done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
            if done.returncode:
                self.print_measured("readme", done.stderr[-400:])
            self._readme = {} if done.returncode else json.loads(done.stdout.splitlines()[-1])
            self.print_measured("readme", self._readme)
        return self._readme

    def print_measured(self, what: str, found: object) -> None:
        """Print `what`, the name of a measurement, and `found`, the details from which its figure
        is computed.
        """
        print(f"{what}: {found}", flush=True)


def readme_commands_failed(house: House) -> float:
    """Return the number of commands of the tutorials that fail, run in a separate network
    namespace.
    """
    found = house.follow_readme()
    return float(len(found["failed"])) if found else float("nan")


def readme_order(house: House) -> float:
    """Return the number of maps, out of five, that a browser shows populated when a reader follows
    the README and the tutorials from top to bottom.
    """
    found = house.follow_readme()
    return float(sum(not reason for reason in found["maps"].values())) if found else float("nan")


def pages_with_errors(house: House) -> float:
    """Return the number of HTML pages that report an error, request an external file, or stay empty
    in Chromium.
    """
    pages = []
    for words in PAGES:
        out = house.folder / f"{words.replace(' ', '')}.html"
        command = [
            "analyze",
            *words.split(),
            "--archive",
            str(house.archive),
            *DAY,
            "--out",
            str(out),
        ]
        assert fleet_service.cli.main(command) == 0, command
        pages.append(out)
    drive = drives(1, SEED, rough=False)[0]
    diagnosis = diagnose(drive.t, drive.signals, drive.vehicle)
    pages.append(house.folder / "check.html")
    pages[-1].write_text(doctors_page(diagnosis, "a drive"))
    if (ROOT / ".demo" / "map.html").exists():
        pages.append(ROOT / ".demo" / "map.html")
    bad = [live] if (live := live_page(house)) else []
    for path in pages:
        with open_page(path) as found:
            drawn = found.drawn_count or found.page.locator("svg").count()
            if found.errors or len(found.requests) > 1 or not drawn:
                bad.append((path.name, found.errors, found.requests))
    house.print_measured("pages", f"{len(pages)} and the live one opened, bad: {bad}")
    return float(len(bad))


def live_page(house: House) -> tuple[str, list[str], list[str]] | None:
    """Open the live page with a service and cars on ice. Return None if the page reports no errors
    and requests nothing from other hosts. Otherwise return an entry for the list of faulty pages:
    ("live", errors, requests to other hosts).
    """
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    connection = ZenohSettings(connect=endpoints)
    with router, running(connection, house.folder / "live"), page_of(connection) as address:
        street.put(router, ("ice", "dry"), time.time_ns(), 1)
        with open_page(address) as found:
            until(lambda: found.drawn_count)
            foreign = [
                url for url in found.requests if not url.startswith((address, "blob:", "data:"))
            ]
            return ("live", found.errors, foreign) if found.errors or foreign else None


def service_ready_s(house: House) -> float:
    """Return the time [s] from the command to `ready:` of a service on an empty archive, with the
    functions that `make setup` has compiled.
    """
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    (house.folder / "ready.json").write_text(json.dumps({"zenoh": {"connect": endpoints}}))
    words = [
        "run",
        "--config",
        str(house.folder / "ready.json"),
        "--archive",
        str(house.folder / "ready"),
    ]
    part = Part("ready", [str(Path(sys.executable).parent / "fleet-service"), *words], house.folder)
    with router:
        began = time.monotonic()
        part.start()
        try:
            part.line_with("ready: ")
            return time.monotonic() - began
        finally:
            part.stop()


def bound_painted(house: House) -> float:
    """Return the number of map outputs with this error: they give a value of friction, which could
    be shown as a colour, for a cell of which only a lower bound is known.
    """
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "tests/test_bounds_unpainted.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    counts = {
        word: int(count)
        for count, word in re.findall(r"(\d+) (passed|failed|skipped|error)", done.stdout)
    }
    house.print_measured("bounds", counts)
    # A count is only valid if no test was skipped.
    whole = counts.get("passed") and not counts.keys() & {
        "skipped",
        "error",
    }
    return float(counts.get("failed", 0)) if whole else float("nan")


def known_ice_hidden(house: House) -> float:
    """Return the number of places known to be slippery that any output draws as unknown."""
    ice = KnownIce(house.folder)
    found = find_hidden(ice)
    hidden = {name: len(places) for name, places in found.items() if places}
    house.print_measured(
        "known ice", f"{len(ice.places)} cells in {len(found)} outputs, hidden: {hidden}"
    )
    return float(len(set().union(*found.values()))) if len(ice.places) > 100 else float("nan")


def colour_distance(house: House) -> float:
    """Return the smallest CIEDE2000 difference between the colours of surfaces, and between those
    of lines, for four kinds of colour vision.
    """
    surfaces = [shade(mu, *GRIP_RANGE) for mu in SURFACES.values()]
    lines = [style.colour for style in (*ESTIMATORS.values(), TRUTH)]
    least = {
        sight: min(
            colour_difference(to_lab(a, sight), to_lab(b, sight))
            for alike in (surfaces, lines)
            for a, b in combinations(alike, 2)
        )
        for sight in SIGHTS
    }
    house.print_measured("colours", least)
    return min(least.values())


def wrong_logs_unnoticed(house: House) -> float:
    """Return the number of deliberate faults in a recording that `replay` does not mention."""
    found = find_unnoticed(house.folder, WRONG, SEED)
    house.print_measured("wrong logs", f"{len(WRONG)} planted, unnoticed: {found}")
    return float(len(found))


def count_tracebacks(house: House) -> float:
    """Return the number of mistakes at the command line that the program answers with a traceback
    or with success.
    """
    count, bad = mistakes.find_tracebacks(house.folder, house.archive)
    house.print_measured("mistakes", f"{count} made, bad: {bad}")
    return float(len(bad)) if count >= 60 else float("nan")


def silent_seconds(house: House) -> float:
    """Return the longest time [s] in which a command prints nothing on a terminal."""
    found = waiting.silent_seconds(house.folder, house.archive)
    house.print_measured("silence", found)
    return max(found.values())


def build_wheel(house: House) -> Path:
    """Build the wheel of this source tree unless it exists, and return its path."""
    built = house.folder / "dist"
    if not list(built.glob("*.whl")):
        build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(built), str(ROOT)]
        subprocess.run(build, check=True, capture_output=True)
    (wheel,) = built.glob("*.whl")
    return wheel


def install_demo(house: House) -> Path:
    """Create an environment with all packages that `gripmap demo` needs, unless it exists, and
    return its folder.
    """
    place = house.folder / "demo-venv"
    if not place.exists():
        install_wheel(build_wheel(house), "demo,page", place)
    return place


def install_wheel(wheel: Path, extras: str, place: Path) -> None:
    """Create a new Python environment in the folder `place`. Install into it only the wheel, its
    optional dependencies `extras`, and pip.
    """
    venv.create(place, with_pip=True)
    pip = [str(place / "bin" / "python"), "-I", "-m", "pip", "install", "--quiet", "--constraint"]
    command = [*pip, str(ROOT / "constraints.txt"), f"{wheel}[{extras}]"]
    subprocess.run(command, check=True, capture_output=True)


def install_mb(house: House) -> float:
    """Return the size [MB] of an environment that runs the demo, without pip."""
    site = next(install_demo(house).glob("lib/*/site-packages"))
    ignored = ("pip", "pip-", "setuptools", "_distutils_hack", "pkg_resources")
    files = (
        file
        for folder in site.iterdir()
        if not folder.name.startswith(ignored)
        for file in (folder.rglob("*") if folder.is_dir() else [folder])
    )
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def install_packages(house: House) -> float:
    """Return the number of packages in the demo's environment, including this one, without pip and
    setuptools.
    """
    site = next(install_demo(house).glob("lib/*/site-packages"))
    names = {path.name.partition("-")[0].lower() for path in site.glob("*.dist-info")}
    house.print_measured("packages", sorted(names))
    return float(len(names - {"pip", "setuptools"}))


def silent_reasons(house: House) -> float:
    """Return the number of causes of missing data that an agent reports in time. A test creates
    each cause in turn, for example a silent sensor or a missing position, so that the agent
    publishes nothing. The agent must print the cause within five seconds.
    """
    path = "tests/edge_agent/app/test_publishing_reasons.py"
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "-k", "planted_cause", path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    house.print_measured("reasons", done.stdout[-200:])
    passed = re.search(r"(\d+) passed", done.stdout)
    return float(passed[1]) if passed else float("nan")


def bugs_of_the_list(house: House) -> float:
    """Return the number of listed bugs (bugs that new users found) that occur again or have no
    test.
    """
    found = listed_bugs.find_open()
    house.print_measured("bugs", f"{len(listed_bugs.TESTS)} listed, open: {found}")
    return float(len(found))


def install_to_first_map_s(house: House) -> float:
    """Return the time [s] from the installation of the wheel in an empty environment until a
    browser shows a map.
    """
    wheel = build_wheel(house)
    began = time.monotonic()
    place = house.folder / "venv"
    install_wheel(wheel, "analytics", place)
    out = house.folder / "first.html"
    program = [str(place / "bin" / "python"), "-I", str(place / "bin" / "fleet-service")]
    words = ["analyze", "grip", "--archive", str(house.archive), *DAY, "--out", str(out)]
    subprocess.run([*program, *words], check=True, capture_output=True, cwd=house.folder)
    with open_page(out) as found:
        assert found.drawn_count > 0
    return time.monotonic() - began


def options_undocumented(house: House) -> float:
    """Return the number of command-line options without a help text."""
    found = reference_pages.undocumented_options()
    house.print_measured("undocumented", found)
    return float(len(found))


def figures_stale(house: House) -> float:
    """Return the number of pages that do not agree with the figures in deploy/figures."""
    found = results.find_stale()
    house.print_measured("stale", found)
    return float(len(found))


def alerts_per_stretch(house: House) -> float:
    """Return the number of alerts per slippery road section in the last run of the demo."""
    path = ROOT / ".demo" / "figures.json"
    rows = json.loads(path.read_text()) if path.exists() else []
    values = {row["name"]: row["value"] for row in rows if "name" in row}
    house.print_measured("demo", path if path.exists() else "make demo first")
    value = values.get("demo.alerts.per_stretch")
    return float("nan") if value is None else float(value)


def first_drive_commands(_: House) -> float:
    """Return the number of commands of the tutorial's first drive, from the installation to the
    map.
    """
    return float(len(read_commands()))


def first_drive_alerts(house: House) -> float:
    """Return the number of alerts that a recorded minute on a dry motorway raises when published
    under three names.
    """
    folder = house.folder / "minute"
    folder.mkdir()
    cells, alerts = map_first_drive(folder)
    house.print_measured("first drive", f"{len(cells)} cells, alerts {alerts}")
    return float(len(set(alerts))) if len(cells) > 30 else float("nan")


PARTS: Final[dict[str, tuple[Callable[[House], float], str, float, str]]] = {
    "readme_commands_failed": (readme_commands_failed, "", 0, "less"),
    "readme_order": (readme_order, "populated maps of 5", 5, "more"),
    "pages_with_errors": (pages_with_errors, "", 0, "less"),
    "bound_painted": (bound_painted, "outputs", 0, "less"),
    "known_ice_hidden": (known_ice_hidden, "cells with P(slippery) > 0.5", 0, "less"),
    "colour_distance": (colour_distance, "CIEDE2000", 10, "more"),
    "wrong_logs_unnoticed": (wrong_logs_unnoticed, "of 12", 0, "less"),
    "tracebacks": (count_tracebacks, "", 0, "less"),
    "silent_seconds": (silent_seconds, "s", 2, "less"),
    "service_ready_s": (service_ready_s, "s", 8, "less"),
    "install_to_first_map_s": (install_to_first_map_s, "s", 90, "less"),
    "install_mb": (install_mb, "MB", 600, "less"),
    "install_packages": (install_packages, "", 45, "less"),
    "silent_reasons": (silent_reasons, "planted causes", 8, "more"),
    "bugs_of_the_list": (bugs_of_the_list, f"of {len(listed_bugs.TESTS)}", 0, "less"),
    "options_undocumented": (options_undocumented, "", 0, "less"),
    "figures_stale": (figures_stale, "", 0, "less"),
    "first_drive_commands": (first_drive_commands, "", 5, "less"),
    "first_drive_alerts": (
        first_drive_alerts,
        "of a real minute on a dry motorway, under three names",
        0,
        "less",
    ),
    "alerts_per_stretch": (
        alerts_per_stretch,
        "per icy stretch and direction, of the last demo",
        2,
        "less",
    ),
}


def main() -> int:
    """Measure how easily a new user can use GripMap. Return 1 if a figure misses its target or is
    missing, otherwise 0.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.usability", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--only", nargs="*", choices=PARTS, default=list(PARTS), help="parts (default: all)"
    )
    args = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    place = Path(tempfile.mkdtemp())
    try:
        house = House(place)
        found = []
        for name in args.only:
            measure, unit, bar, better = PARTS[name]
            print(f"-- {name}", flush=True)
            # Without a browser the figure is not measured, and its target counts as missed.
            try:
                value = measure(house)
            except pytest.skip.Exception as missing:
                house.print_measured(name, missing)
                value = float("nan")
            found.append(
                Figure(
                    f"usability.{name}",
                    value,
                    unit,
                    bar,
                    better,  # type: ignore[arg-type]
                )
            )
    finally:
        shutil.rmtree(place, ignore_errors=True)
    figures.write_figures(FOLDER / "figures.json", "usability", [SEED], found)
    print(figures.format_table(found))
    return 0 if len(found) == len(PARTS) and all(figure.holds for figure in found) else 1


if __name__ == "__main__":
    sys.exit(main())
