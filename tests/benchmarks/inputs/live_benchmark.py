"""Benchmark of live sources: number of samples lost at 100 Hz in a minute, and behaviour of the
agent when a source is killed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import numpy as np

from edge_agent.inputs.live.rows import LiveRows
from edge_agent.inputs.live.sources import open_sources
from edge_agent.lab.simulation.presets import PRESETS
from schemas.runtime.figures import Figure
from schemas.signals import CHANNELS as ALL
from schemas.vehicle import Vehicle
from tests.benchmarks.inputs.peers import CHANNELS, DBC, profile_of
from tests.ports import free_ports

RATE_HZ: Final = 100.0
MULTICAST: Final = "239.74.163.2"
COUNTED: Final = ("can", "ros2", "vss")
PATIENCE_S: Final = 60.0
START_S: Final = 300.0  # time for a start, including the compilation of kernels
SETTLED_S: Final = 2.0  # wait after the last sample: rows are delayed by design
KILLS: Final = 3  # kills of each source while an agent runs


@dataclass
class Peer:
    """Test sender ("peer") that runs in a process of its own."""

    process: subprocess.Popen[str]

    def wait_for(self, word: str) -> None:
        """Wait until the test sender prints the line `word`."""
        for line in _read_lines(self.process.stdout):
            if line == word:
                return
        code = self.process.wait()
        raise RuntimeError(f"the peer ended with code {code} before it printed {word!r}")

    def send_go(self) -> None:
        """Write a line to the test sender's input; the first line makes it begin to send, the
        second makes it end.
        """
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        """Kill the test sender's process immediately, like a device that loses its power."""
        self.process.kill()
        self.process.wait()


def _read_lines(stream: IO[str] | None) -> Iterator[str]:
    assert stream is not None
    for line in stream:
        yield line.strip()


@contextmanager
def run_peer(kind: str, address: str, samples: int, rate: float = RATE_HZ) -> Iterator[Peer]:
    """Run a test sender in a separate process for the duration of the `with` block."""
    words = [
        sys.executable,
        "-m",
        "tests.benchmarks.inputs.peers",
        kind,
        address,
        str(samples),
        str(rate),
    ]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    running = Peer(process)
    try:
        yield running
    finally:
        running.kill()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


def peer_addresses(kind: str) -> tuple[str, str]:
    """Return two addresses of a test sender: the one at which it sends, and the command-line
    argument with which the agent opens it as a source.
    """
    (port,) = free_ports(1)
    if kind == "can":
        return f"udp_multicast/{MULTICAST}/{port}", f"can:udp_multicast/{MULTICAST}?port={port}"
    if kind == "ros2":
        return f"tcp/127.0.0.1:{port}", f"ros2:tcp/127.0.0.1:{port}"
    return f"127.0.0.1:{port}", f"{kind}:127.0.0.1:{port}"


def write_profile(kind: str, folder: Path) -> tuple[str, Path | None]:
    """Write the profile (assignment of signals to channels) and the CAN database for a kind of test
    sender, and return their paths. For "vss", return the name of the shipped profile and None.
    """
    if kind == "vss":
        return "vss", None
    profile = folder / f"{kind}.json"
    dbc = folder / "peer.dbc"
    profile.write_text(profile_of(kind).to_json(), encoding="utf-8")
    dbc.write_text(DBC, encoding="utf-8")
    return str(profile), dbc


def count_lost(kind: str, folder: Path, seconds: float) -> tuple[int, int]:
    """Return two numbers: samples lost between a source and the rows (samples of all channels) that
    the agent builds, and samples sent.

    A sample is lost if its message was not received, or if its reading arrived after its row had
    been built.
    """
    samples = round(seconds * RATE_HZ)
    place, source = peer_addresses(kind)
    name, dbc = write_profile(kind, folder)
    vehicle = PRESETS["sedan"].vehicle
    feeds, profile, clock = open_sources([source], name, dbc)
    rows = LiveRows(feeds, profile, vehicle, clock)
    parts = []
    sent = 0
    quiet_since = float("inf")
    with run_peer(kind, place, samples) as running:
        running.wait_for("ready")
        blocks = rows.blocks()
        while not feeds[0].openings:
            next(blocks)
        running.send_go()
        began = time.monotonic()
        received_count = 0
        for block in blocks:
            parts.append(block.signals[:, 0])
            if feeds[0].received_count > received_count:
                received_count = feeds[0].received_count
                quiet_since = time.monotonic()
            if (
                time.monotonic() > quiet_since + SETTLED_S
                or time.monotonic() > began + seconds + PATIENCE_S
            ):
                break
        blocks.close()
        running.send_go()
        for line in _read_lines(running.process.stdout):
            if line.startswith("{"):
                sent = json.loads(line)["sent"]
                break
    table = np.concatenate(parts)[:, [ALL.index(channel) for channel in CHANNELS]]
    if np.isfinite(table).all(axis=1).sum() < samples // 2:
        # Messages were received, but no signal row was built: count all samples as missing.
        return samples, samples
    missing = -(-(sent - received_count) * samples // max(sent, 1))
    return max(missing, 0) + feeds[0].lost + rows.late, samples


def count_crashes(folder: Path, kills: int = KILLS) -> tuple[list[str], int]:
    """Kill the signal source of running agents, `kills` times for each kind of source. Return one
    message per failure of an agent, and the number of kills.

    An agent fails if it does not report the loss or the return of its source, or does not end
    correctly.
    """
    vehicle = Vehicle.model_validate(PRESETS["sedan"].vehicle)
    (folder / "car.json").write_text(vehicle.model_dump_json(exclude_none=True))
    kinds = (*COUNTED, "gpsd")
    failures = [_kill_source(kind, folder, kills) for kind in kinds]
    return [failure for failure in failures if failure is not None], kills * len(kinds)


def _kill_source(kind: str, folder: Path, kills: int) -> str | None:
    """Start an agent that reads a source of the given kind, and kill this source `kills` times.
    Return a message if the agent failed, else None.
    """
    place, source = peer_addresses(kind)
    (port,) = free_ports(1)
    agent = subprocess.Popen(
        [sys.executable, "-m", "edge_agent.cli", *_agent_arguments(kind, source, port, folder)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    missed = []
    if not _shows_silence(agent, port, source, silent=True, patience_s=START_S):
        missed.append("no source at the start")
    for kill in range(kills):
        with run_peer(kind, place, 100_000) as running:
            running.send_go()
            running.wait_for("ready")
            running.send_go()
            if not _shows_silence(agent, port, source, silent=False):
                missed.append(f"return {kill + 1}")
        if not _shows_silence(agent, port, source, silent=True):
            missed.append(f"loss {kill + 1}")
    agent.terminate()
    output, _ = agent.communicate(timeout=PATIENCE_S)
    if not missed and not agent.returncode and output.strip().endswith("}"):
        return None
    unseen = f"did not notice {', '.join(missed)}" if missed else "noticed every change"
    return (
        f"{kind}: the agent {unseen}, exited with code {agent.returncode}, and printed "
        f"{output[-200:]!r}"
    )


def _agent_arguments(kind: str, source: str, port: int, folder: Path) -> list[str]:
    """Write the configuration of an agent that reads `source` and shows its metrics at `port`.
    Return the arguments of its command.
    """
    profile, dbc = write_profile("can" if kind == "gpsd" else kind, folder)
    config = folder / f"{kind}.agent.json"
    settings = {
        "zenoh": {"connect": ["tcp/127.0.0.1:9"]},
        "spool": str(folder / f"{kind}.sqlite"),
        "estimator": "ckf",
        "metrics_port": port,
    }
    config.write_text(json.dumps(settings), encoding="utf-8")
    words = ["run", "--source", source, "--profile", profile, "--name", "car-one", "--trust"]
    words += ["--vehicle", str(folder / "car.json"), "--config", str(config)]
    if dbc:
        words += ["--dbc", str(dbc)]
    if kind == "gpsd":  # gpsd sends only positions, so a CAN source is added
        words += ["--source", peer_addresses("can")[1]]
    return words


def _shows_silence(
    agent: subprocess.Popen[str],
    port: int,
    source: str,
    *,
    silent: bool,
    patience_s: float = PATIENCE_S,
) -> bool:
    """Wait until the health page of a running agent reports `source` as silent. If `silent` is
    False, wait until the page no longer reports this. Return False if it does not happen within
    `patience_s` seconds.
    """
    deadline = time.monotonic() + patience_s
    while agent.poll() is None and time.monotonic() < deadline:
        troubles = _health_problems(port)
        if (
            "the agent is starting" not in troubles
            and troubles
            and silent == any(source in line for line in troubles)
        ):
            return True  # the router is absent, so the agent always reports a problem
        time.sleep(0.1)
    return False


def _health_problems(port: int) -> list[str]:
    """Return the problems in an agent's `/healthz`; an empty list while the agent does
    not answer.
    """
    try:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{port}/healthz", timeout=PATIENCE_S
        ) as answer:
            return list(json.load(answer)["troubles"])
    except urllib.error.HTTPError as answer:
        return list(json.load(answer)["troubles"])
    except OSError:
        return []


def figures(folder: Path, seconds: float, kills: int = KILLS) -> list[Figure]:
    """Run the benchmark: count the samples that are lost from each kind of live source in
    `seconds`, and the agents that fail when their source is killed `kills` times. Return these
    counts as figures.
    """
    found = []
    for kind in COUNTED:
        missing, sent = count_lost(kind, folder, seconds)
        found += [
            Figure(f"live.{kind}.samples_lost", float(missing), "samples", 0.0),
            Figure(f"live.{kind}.samples", float(sent), "samples", 6_000.0, "more"),
        ]
    bad, tries = count_crashes(folder, kills)
    for reason in bad:
        print(reason, file=sys.stderr)
    return [
        *found,
        Figure("live.source_loss.crashes", float(len(bad)), "crashes", 0.0),
        Figure("live.source_loss.losses", float(tries), "losses", 12.0, "more"),
    ]
