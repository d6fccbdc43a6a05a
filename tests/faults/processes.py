"""Router, service and load generators as separate processes, which a campaign starts, kills,
freezes and stops.

The output of a process goes through a pipe to `folder/NAME.log`, one file for all starts. Lines
printed before a kill are therefore in the file, and a limit on the process's files does not limit
its log. A router keeps its port over restarts.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.ports import free_ports
from tests.waiting import freeze, until

START_S = 120.0  # time for a start; the first one compiles the kernels
STOP_S = 30.0  # a stopped process needs 3 s on an idle machine


class Part:
    """Process under test, given by its command. It can be started any number of times."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        self.name = name
        self.command = list(command)
        self.log = folder / f"{name}.log"
        self.starts = 0
        self._since = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._writer: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process, after its previous run (if any) has ended. Return without waiting
        until the process is ready.
        """
        if self._process is not None:
            self.wait(STOP_S)
        self._since = self.log.stat().st_size if self.log.exists() else 0
        with self.log.open("ab") as log:
            self._writer = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=log)
        assert self._writer.stdin is not None
        with self._writer.stdin as pipe:
            self._process = subprocess.Popen(self.command, stdout=pipe, stderr=subprocess.STDOUT)
        self.starts += 1

    @property
    def pid(self) -> int:
        """Return the process id of the present run of this process."""
        assert self._process is not None, f"{self.name} was never started"
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Return True if the process runs."""
        return self._process is not None and self._process.poll() is None

    def read_lines(self) -> list[str]:
        """Return the lines that the process has printed since its last start."""
        return self.log.read_bytes()[self._since :].decode(errors="replace").splitlines()

    def line_with(self, start: str) -> str:
        """Wait for the first line of the process's output that begins with `start`, and return this
        line.
        """

        def find_lines() -> list[str]:
            started = [line for line in self.read_lines() if line.startswith(start)]
            assert started or self.is_alive, (
                f"{self.name} ended before it said {start!r}; see {self.log}"
            )
            return started

        until(find_lines, START_S)
        return find_lines()[0]

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to the process if it is alive."""
        if self.is_alive:
            os.kill(self.pid, number)

    def freeze(self) -> None:
        """Freeze the process, if it is alive, until it receives SIGCONT."""
        if self._process is not None and self.is_alive:
            freeze(self._process)

    def kill(self) -> None:
        """Kill the process with SIGKILL, and wait until it has ended."""
        self.send_signal(signal.SIGKILL)
        if self._process is not None:
            self.wait(STOP_S)

    def wait(self, patience_s: float) -> int:
        """Wait until the process has ended and its log is complete, and return the exit code. Raise
        subprocess.TimeoutExpired if this takes longer than `patience_s`.
        """
        assert self._process is not None
        assert self._writer is not None
        code = self._process.wait(patience_s)
        self._writer.wait(patience_s)
        return code

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send SIGTERM or another signal, wait for the end of the process, and return its exit
        code.
        """
        self.send_signal(number)
        return self.wait(STOP_S)

    def limit_files(self, size: int) -> None:
        """Limit each file that the process writes to `size` bytes, which acts like a full disk; -1
        removes the limit.
        """
        _, hard = resource.prlimit(self.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.pid, resource.RLIMIT_FSIZE, (hard if size < 0 else size, hard))


class Stage:
    """Test system of a campaign: router and service, and the load generators that are added to
    them, as processes.
    """

    def __init__(self, folder: Path, **service: object) -> None:
        self.folder = folder
        self.archive = folder / "archive"
        folder.mkdir(parents=True, exist_ok=True)
        self.endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        command = [sys.executable, "-m", "deploy.router", "--listen", self.endpoint]
        self.router = Part("router", command, folder)
        self.router.start()
        self.router.line_with("router: ")
        config = folder / "service.json"
        config.write_text(json.dumps({"zenoh": {"connect": [self.endpoint]}, **service}))
        words = ["run", "--config", str(config), "--archive", str(self.archive)]
        self.service = Part("service", [sys.executable, "-m", "fleet_service.cli", *words], folder)
        self.service.start()
        self.loads: list[Part] = []

    def make_load(self, names: Sequence[str], rate: float, **more: object) -> Part:
        """Return a load generator, not yet started, that sends `rate` observations per second for
        each vehicle.
        """
        name = f"load-{len(self.loads):02}"
        config = self.folder / f"{name}.json"
        outbox = str(self.folder / f"{name}.sqlite")
        config.write_text(
            json.dumps(
                {
                    "endpoint": self.endpoint,
                    "names": list(names),
                    "rate": rate,
                    "outbox": outbox,
                    **more,
                }
            )
        )
        self.loads.append(
            Part(name, [sys.executable, "-m", "tests.faults.load", str(config)], self.folder)
        )
        return self.loads[-1]

    @property
    def parts(self) -> list[Part]:
        """Return all processes of the test system: router, service and load generators."""
        return [self.router, self.service, *self.loads]

    @property
    def journals(self) -> list[Path]:
        """Return the paths of the load generators' journals, which list stored and settled
        (acknowledged or refused by the service) batches.
        """
        return [part.log for part in self.loads]

    def drain(self, patience_s: float) -> None:
        """Stop new observations, and wait until every batch of every load generator is settled
        (acknowledged or refused by the service).

        The wait ends early if no batch is settled for `patience_s`. Batches left in an outbox are
        then missing in the archive; the comparison with the archive counts them.
        """
        for part in self.loads:
            part.line_with("ready: ")  # before this line the signal would end the process
            part.send_signal(signal.SIGUSR1)
        with suppress(TimeoutError):
            while any(part.is_alive for part in self.loads):
                self._await_news(patience_s)

    def _await_news(self, patience_s: float) -> None:
        """Wait until a load generator has printed a new line, or all load generators have ended.
        Raise TimeoutError if neither happens within `patience_s` seconds.
        """
        size = sum(journal.stat().st_size for journal in self.journals)

        def has_news() -> bool:
            more = sum(journal.stat().st_size for journal in self.journals) > size
            return more or not any(part.is_alive for part in self.loads)

        until(has_news, patience_s)


@contextmanager
def open_stage(folder: Path, **service: object) -> Iterator[Stage]:
    """Start a router and a service as processes; the keywords `service` are settings of the
    service. Yield both as a `Stage` when the service is ready. All processes are ended after the
    `with` block.
    """
    stage = Stage(folder, **service)
    try:
        stage.service.line_with("ready: ")
        yield stage
    finally:
        for part in stage.parts:
            part.send_signal(signal.SIGCONT)
            part.kill()
