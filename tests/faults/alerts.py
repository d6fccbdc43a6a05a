"""Campaign on a restarted router: a client that watches alerts through this router (the watcher)
must receive every active alert soon after its session is back.

The service is connected to the first router, the watcher to the second. The second router is
killed, alerts are raised, and the router is started again. The watcher must then receive these
alerts, but none before.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final

import zenoh

from deploy.router import CONFIG
from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Batch
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.processes import Part, Stage, open_stage
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.examples import LATITUDE, LONGITUDE, REGION, batch
from tests.ports import free_ports
from tests.waiting import until

SOON_S: Final = 5.0
WITNESSES: Final = 3
APART: Final = 4e-4  # [deg] distance of two places: more than two cells
NS: Final = 10**9
Place = tuple[int, int]  # cell and heading sector


def run(site: Site) -> list[Figure]:
    """Restart the watcher's router eight times, and raise twenty more alerts during each outage (in
    a quick run: one outage, ten alerts).

    Return three figures over all outages: the number of active alerts that the watcher did not
    receive within SOON_S after it was connected again, the number that it should have received, and
    the longest time [s] from the new connection to a received alert.
    """
    each = site.choose_amount(20, 10)
    missing = 0
    waits = []
    with open_stage(site.folder) as stage:
        beside = _make_second_router(stage)
        with _open_session(stage.endpoint) as driver, _open_session(beside.command[-1]) as watcher:
            fleet = Fleet(driver).await_services()
            received = dict[Place, float]()
            watched = watcher.declare_subscriber(
                f"{keys.ROOT}/alert/**", lambda sample: _record_alert(received, sample)
            )
            for turn in range(site.choose_amount(8, 1)):
                beside.kill()
                until(lambda: not list(watcher.info.routers_zid()))
                received.clear()
                fleet.settle(*_make_ice_batches(turn, each))
                until(partial(_has_alerts, driver, each * (turn + 1)))
                standing = _list_alerts(driver)
                assert not received, "the watcher was not away"
                beside.start()
                until(lambda: list(watcher.info.routers_zid()))
                back = time.monotonic()
                while standing - received.keys() and time.monotonic() < back + SOON_S:
                    time.sleep(0.02)
                missing += len(standing - received.keys())
                waits += [received[place] - back for place in standing & received.keys()]
            watched.undeclare()
        beside.kill()
    site.say(
        f"{len(waits)} alerts heard again, the last after {max(waits, default=0.0):.1f} s; "
        f"{missing} missing"
    )
    return [
        make_figure("faults.alerts.missing_after_reconnect", missing),
        make_figure("faults.alerts.standing", len(waits) + missing),
        Figure("faults.alerts.longest_s", max(waits, default=float("nan")), "s"),
    ]


def _make_second_router(stage: Stage) -> Part:
    """Start and return a second router, which is connected to the first and keeps its port over
    restarts. Clients of the first router do not learn this port, so they cannot connect to the
    second.
    """
    config = Path(stage.folder) / "router-b.json"
    settings = zenoh.Config.from_file(str(CONFIG))
    settings.insert_json5("connect/endpoints", json.dumps([stage.endpoint]))
    config.write_text(str(settings))
    command = [sys.executable, "-m", "deploy.router", "--config", str(config), "--listen"]
    part = Part("router-b", [*command, f"tcp/127.0.0.1:{free_ports(1)[0]}"], stage.folder)
    part.start()
    part.line_with("router: ")
    return part


def _open_session(endpoint: str) -> zenoh.Session:
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None
    return session


def _record_alert(received: dict[Place, float], sample: zenoh.Sample) -> None:
    alert = wire.decode_alert(sample.payload.to_bytes())
    if alert.raised:
        received.setdefault((alert.cell, alert.sector), time.monotonic())


def _make_ice_batches(turn: int, places: int) -> list[Batch]:
    """Return batches of observations that report ice in `places` cells. Each cell is reported by as
    many vehicles as an alert needs. Another `turn` gives other cells.
    """
    latitude = LATITUDE + APART * turn
    longitudes = [LONGITUDE + APART * place for place in range(places)]
    cells = [int(grid.cell_of(latitude, longitude)) for longitude in longitudes]
    assert {int(grid.region_of(cell)) for cell in cells} == {REGION}
    return [
        batch(
            f"sim-{number:03}",
            1 + turn * places + place,
            time.time_ns() - NS,
            [0.2],
            latitude=[latitude],
            longitude=[longitudes[place]],
            cell=[cells[place]],
        )
        for place in range(places)
        for number in range(WITNESSES)
    ]


def _has_alerts(session: zenoh.Session, least: int) -> bool:
    """Query the service for its active alerts, and return True if there are at least `least`."""
    return len(_list_alerts(session)) >= least


def _list_alerts(session: zenoh.Session) -> set[Place]:
    """Query the service for its active alerts. Return the cell and the heading sector of each."""
    replies = [reply.ok for reply in session.get(f"{keys.ROOT}/alert/**")]
    return {
        (alert.cell, alert.sector)
        for reply in replies
        if reply is not None
        for alert in wire.decode_standing(reply.payload.to_bytes())
    }
