"""Processes of the demo: the parts of the system, each with a log file in the demo's folder."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from deploy.demo import town
from edge_agent.lab.simulation.fleet import vehicle_names
from edge_agent.lab.simulation.scenarios import scenario_named

START_S = 300.0  # time for the first start after a change, which compiles the kernels
STOP_S = 10.0
SCENARIO = "frost"
# Settings for the page: a historical map after minutes, and the service's metrics.
SHOWN = {
    "snapshot_s": 10.0,
    "metrics_port": 0,
}


class DemoError(RuntimeError):
    """Error: a process of the demo did not start, or ended early. The message names its log
    file.
    """


@contextmanager
def _hold_signals() -> Iterator[list[int]]:
    """Collect the numbers of arriving SIGINT and SIGTERM in the yielded list, instead of raising
    KeyboardInterrupt. Raised within `subprocess.Popen`, it would leave behind a process that
    `ManagedProcess` does not know.
    """
    arrived: list[int] = []
    usual = {
        number: signal.signal(number, lambda number, _: arrived.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield arrived
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


class ManagedProcess:
    """One process of the demo; its output is written to `folder/NAME.log`."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        self.name = name
        self.log = folder / f"{name}.log"
        with self.log.open("w") as out, _hold_signals() as arrived:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        if arrived:
            self.stop()
            raise KeyboardInterrupt

    def lines(self) -> list[str]:
        """Return the lines that this process of the demo has printed so far."""
        return self.log.read_text().splitlines()

    def line_with(self, start: str) -> str:
        """Wait for the first line of the process's output that begins with `start`, and return this
        line.

        Raises:
            DemoError: the process ended, or did not print such a line within START_S seconds.
        """
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            for line in self.lines():
                if line.startswith(start):
                    return line
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        last = next(reversed(self.lines()), "no output")
        raise DemoError(f"{self.name} did not print {start!r}; {self.log} ends with: {last}")

    def wait(self, every_s: float, tick: Callable[[], None]) -> int:
        """Wait for the end of the process and return its exit code; call `tick` every `every_s`
        seconds.
        """
        while True:
            try:
                return self.process.wait(every_s)
            except subprocess.TimeoutExpired:
                tick()

    def stop(self) -> None:
        """Send SIGTERM to this process of the demo; kill it if it does not end in time."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def report(self) -> dict[str, float]:
        """Return the counts, by name, that this process of the demo printed as JSON in its last
        line.

        Raises:
            DemoError: the last line is not JSON.
        """
        try:
            counts: dict[str, float] = json.loads(self.lines()[-1])
        except (IndexError, json.JSONDecodeError) as error:
            raise DemoError(
                f"{self.name} ended without printing its counts; see {self.log}"
            ) from error
        return counts


def write_enrolment(folder: Path, vehicles: int) -> Path:
    """Write the operator's list of the demo's vehicles, and return its path. The service accepts
    only these, so it trusts them from their first report on.
    """
    path = folder / "enrolled.json"
    path.write_text(json.dumps({"routers": {"demo": {}}, "vehicles": vehicle_names(vehicles)}))
    return path


@contextmanager
def run_system(folder: Path, vehicles: int) -> Iterator[tuple[str, ManagedProcess]]:
    """Run a router and a fleet service on a free port of the loopback interface, until the `with`
    block ends. Yield the endpoint of the router and the process of the service.

    The service accepts only the simulated `vehicles` (their number). The configuration for the
    agents is written to `folder/agent.json`.
    """
    scripts = Path(sys.executable).parent
    router = ManagedProcess(
        "router", [sys.executable, "-m", "deploy.router", "--listen", "tcp/127.0.0.1:0"], folder
    )
    try:
        endpoint = router.line_with("router: ").removeprefix("router: ").split()[0]
        zenoh = {"connect": [endpoint]}
        enrolled = str(write_enrolment(folder, vehicles))
        (folder / "service.json").write_text(
            json.dumps({"zenoh": zenoh, "name": "demo", "fleet": enrolled, **SHOWN})
        )
        (folder / "agent.json").write_text(
            json.dumps({"zenoh": zenoh, "spool": str(folder / "spool.sqlite")})
        )
        command = [
            "run",
            "--config",
            str(folder / "service.json"),
            "--archive",
            str(folder / "archive"),
        ]
        service = ManagedProcess("service", [str(scripts / "fleet-service"), *command], folder)
        try:
            service.line_with("ready")
            yield endpoint, service
        finally:
            service.stop()
    finally:
        router.stop()


@contextmanager
def run_page(folder: Path, endpoint: str, service: ManagedProcess, port: int) -> Iterator[str]:
    """Run the live page with the streets of the simulated town until the `with` block ends; yield
    the page's address. The page can draw the true friction over the map.
    """
    metrics = service.line_with("ready").rpartition(", ")[2]
    tiles, roads = town.write_files(scenario_named(SCENARIO), folder)
    options = {
        "--connect": endpoint,
        "--archive": folder / "archive",
        "--port": port,
        "--metrics": metrics,
        "--overlay": folder / "overlay.parquet",
        "--base-map": tiles,
        "--roads": roads,
    }
    words = [str(word) for option in options.items() for word in option]
    shown = ManagedProcess(
        "page", [str(Path(sys.executable).parent / "fleet-service"), "page", *words], folder
    )
    try:
        yield shown.line_with("page: ").removeprefix("page: ")
    finally:
        shown.stop()


def start_fleet(
    folder: Path, vehicles: int, duration_s: float, seed: int, warned: float
) -> ManagedProcess:
    """Start the process that simulates all vehicles, each with its own network session and name;
    return this process. The share `warned` of the drivers receives warnings of ice.
    """
    scripts = Path(sys.executable).parent
    options = {
        "--vehicles": vehicles,
        "--scenario": SCENARIO,
        "--rough": 0.5,  # half of the vehicles have sensors and drivers like real cars
        # Half of the vehicles, also half of the rough ones, have slip controllers and tyres for
        # winter.
        "--winter": 0.5,
        "--warned": warned,
        "--duration": duration_s,
        "--seed": seed,
        "--config": folder / "agent.json",
        "--truth": folder / "truth.parquet",
    }
    words = [str(word) for option in options.items() for word in option]
    return ManagedProcess("fleet", [str(scripts / "edge-agent"), "fleet", *words], folder)
