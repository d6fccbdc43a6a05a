"""Tests of the whole system in one process: recorded drives, agent, router and service. Drives on
slippery roads must become a slippery map, also for a client that uses only Zenoh.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from deploy.router import open_router
from edge_agent.cli import main as edge_agent
from fleet_service.app.service import Service
from fleet_service.archive.format import reading
from schemas import mugrid
from schemas.config import ServiceConfig, ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Kind
from tests.event_lines import logger_into
from tests.waiting import PATIENCE_S, matched, until

VEHICLES = ("anna", "bert", "cleo")
ICE = 0.25


class System:
    """Router and service in this process, with the folder for the files of the service and the
    agents.
    """

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.folder = folder
        self.endpoint = endpoint
        self.events: list[str] = []
        self.agent = folder / "agent.json"
        zenoh_settings = {"connect": [endpoint]}
        self.agent.write_text(
            json.dumps({"zenoh": zenoh_settings, "spool": str(folder / "spool.sqlite")})
        )
        self.config = ServiceConfig(
            zenoh=ZenohSettings(connect=[endpoint]), segment_s=0.1, put_s=0.1
        )
        self.start()

    def start(self) -> None:
        """Start a service on the archive, also after `stop`, and wait until it is ready."""
        self._stop = threading.Event()
        service = Service(self.config, self.folder / "archive", logger_into(self.events))
        self._thread = threading.Thread(target=service.run, args=(self._stop,))
        before = len(self.events)
        self._thread.start()
        until(lambda: any(line.startswith("ready") for line in self.events[before:]))

    def stop(self) -> None:
        """Stop the service. Before it ends, it stores and acknowledges the received reports."""
        self._stop.set()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def publish_drive(self, vehicle: str, manoeuvre: str, mu: float, seed: int) -> None:
        """Simulate and record a drive on a road with friction `mu`, and publish it under the
        vehicle name `vehicle`.
        """
        self.record_drive(vehicle, manoeuvre, mu, seed)
        assert edge_agent(self.replay_words(vehicle)) == 0

    def record_drive(self, vehicle: str, manoeuvre: str, mu: float, seed: int) -> None:
        """Simulate and record a drive on a road with friction `mu`."""
        log = self.folder / f"{vehicle}-log.parquet"
        file = self.folder / f"{vehicle}-vehicle.json"
        words = [
            "simulate",
            manoeuvre,
            "--mu",
            str(mu),
            "--seed",
            str(seed),
            "--out",
            str(log),
            "--vehicle-out",
            str(file),
        ]
        assert edge_agent(words) == 0

    def replay_words(self, vehicle: str) -> list[str]:
        """Return the command that publishes the recorded drive under the vehicle's name."""
        return [
            "replay",
            str(self.folder / f"{vehicle}-log.parquet"),
            "--vehicle",
            str(self.folder / f"{vehicle}-vehicle.json"),
            "--out",
            str(self.folder / f"{vehicle}-estimates.parquet"),
            "--publish",
            "--name",
            vehicle,
            "--trust",
            "--config",
            str(self.agent),
        ]

    def query_cells(self, parameters: str = "format=json") -> list[dict[str, object]]:
        """Return the map's cells as a client that has no GripMap code receives them."""
        session = open_session(ZenohSettings(connect=[self.endpoint]))
        assert session is not None
        with session:
            replies = list(session.get(f"gripmap/v1/map/**?{parameters}", timeout=PATIENCE_S))
        cells: list[dict[str, object]] = []
        for reply in replies:
            assert reply.ok is not None, reply.err and reply.err.payload.to_string()
            answer = json.loads(reply.ok.payload.to_string())
            cells += answer["cells"] if isinstance(answer, dict) else answer
        return cells


@contextmanager
def run_system(folder: Path) -> Iterator[System]:
    """Run a new router and service, with their files in `folder`, until the context ends."""
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    with router:
        running = System(folder, endpoints[0])
        try:
            yield running
        finally:
            running.stop()


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    with run_system(tmp_path) as running:
        yield running


def slippery_cells(system: System) -> list[dict[str, object]]:
    """Return the measured cells after three cars braked on a road with friction ICE."""
    for seed, vehicle in enumerate(VEHICLES):
        system.publish_drive(vehicle, "braking", ICE, seed)
    return [
        cell
        for cell in system.query_cells("format=json;min_vehicles=2")
        if cell["basis"] == "measured"
    ]


def test_three_braking_cars_measure_ice_within_six_hundredths(system: System) -> None:
    excited = slippery_cells(system)
    assert excited
    assert max(abs(float(str(cell["mu"])) - ICE) for cell in excited) <= 0.06


def test_three_braking_cars_are_sure_of_ice_where_they_braked(system: System) -> None:
    cells = slippery_cells(system)
    braked = count_values(system.folder)
    sure = [float(str(cell["p_slippery"])) for cell in cells if braked[cell["cell"]] >= 2]
    assert len(sure) >= 9
    assert min(sure) >= 0.95
    # The cars began to brake behind the first cells, where only the ice ahead is known.
    before = [float(str(cell["mu_upper"])) for cell in cells if not braked[cell["cell"]]]
    assert before
    assert min(before) > 0.9


def test_slippery_drives_become_a_slippery_map_that_survives_a_restart(system: System) -> None:
    excited = slippery_cells(system)
    assert len(excited) > 5
    below = [float(str(cell["mu_lower"])) for cell in excited]
    # In the cells where the vehicles stop, the drift of the median also moves the lower bound.
    assert max(below) <= ICE + 0.02
    # A bin of the friction grid is .036 wide.
    assert sum(lower <= ICE + 0.01 for lower in below) >= 0.9 * len(below)
    for cell in excited:
        assert float(str(cell["mu_upper"])) >= ICE
        assert float(str(cell["p_slippery"])) >= 0.5  # an unknown road has .3
        assert float(str(cell["mu"])) < 0.4
    cells = system.query_cells("format=json;min_vehicles=2")
    rows = list_archived(system.folder)
    assert len(set(rows)) == len(rows)
    system.stop()
    system.start()
    again = {(c["cell"], c["sector"]): c for c in system.query_cells("format=json;min_vehicles=2")}
    for cell in cells:
        found = again[cell["cell"], cell["sector"]]
        assert found["vehicles"] == cell["vehicles"]
        # The belief fades towards the prior.
        assert found["mu"] == (None if cell["mu"] is None else pytest.approx(cell["mu"], abs=0.01))


def count_values(folder: Path) -> Counter[object]:
    """Return the number of vehicles that measured friction, by cell."""
    columns = ("cell", "vehicle", "value")
    rows = {
        row
        for table in reading.read_tables(folder / "archive", Kind.OBSERVATION, columns)
        for row in zip(*(table[name].to_pylist() for name in columns), strict=True)
        if row[2]
    }
    return Counter(cell for cell, *_ in rows)


def list_archived(folder: Path) -> list[tuple[object, ...]]:
    """Return the identity of each archived observation: vehicle, boot (start of the agent), region,
    seq (number of the batch), and row in the batch.
    """
    columns = ("vehicle", "boot", "region", "seq", "row")
    tables = reading.read_tables(folder / "archive", Kind.OBSERVATION, columns)
    return [
        row
        for table in tables
        for row in zip(*(table[name].to_pylist() for name in columns), strict=True)
    ]


def test_straight_drive_keeps_the_upper_end_of_the_prior(system: System) -> None:
    system.publish_drive("anna", "straight", 0.8, 0)
    cells = system.query_cells()
    assert cells
    assert {cell["basis"] for cell in cells} == {"bound"}
    widths = [float(str(cell["mu_upper"])) - float(str(cell["mu_lower"])) for cell in cells]
    assert min(widths) >= 0.8 * float(
        mugrid.quantiles(mugrid.PRIOR, 0.95) - mugrid.quantiles(mugrid.PRIOR, 0.05)
    )


def test_garbage_is_refused_and_the_service_continues(system: System) -> None:
    session = open_session(ZenohSettings(connect=[system.endpoint]))
    assert session is not None
    with session:
        publisher = session.declare_publisher("gripmap/v1/obs/1200/320/230/mallory")
        matched(publisher)
        publisher.put(b"\xff\x00garbage", encoding=zenoh.Encoding("application/protobuf"))
        errors = [
            r.err.payload.to_string()
            for r in session.get("gripmap/v1/map/**?bbox=1,2,3", timeout=PATIENCE_S)
            if r.err is not None
        ]
        assert errors
        assert all(error.startswith("bbox: ") for error in errors)
    system.publish_drive("anna", "braking", 0.8, 0)
    assert system.query_cells()
