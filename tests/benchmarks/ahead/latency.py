"""Latency from the publication of an alert to the warning, for VEHICLES simulated cars in one
process, each with its own session on a real Zenoh router.

Every car stands on its own road and looks ahead each second; a simulated service answers the cars'
queries. Alerts are published one after the other on the roads of randomly chosen cars, and the time
until the warning is measured.
"""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

import numpy as np
import zenoh

from edge_agent.ahead.lookout import Lookout
from edge_agent.ahead.path import Pose, to_degrees
from schemas import grid
from schemas.config import ZenohSettings
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import NS
from schemas.wire import Alert
from schemas.wire.ahead import GripWarning
from tests.benchmarks.ahead.made_up_service import MadeUpService

VEHICLES: Final = 200
APART_M: Final = 60.0  # distance of neighbouring roads; each lies north of the previous one
AHEAD_M: Final = 45.0
SPEED: Final = 14.0
PATIENCE_S: Final = 10.0
SETTLE_S: Final = 3.0
ORIGIN: Final = Pose(57.70, 11.97, 0.0, SPEED, 0)


@contextmanager
def open_router() -> Iterator[ZenohSettings]:
    """Open a Zenoh router in this process, on a free port of the loopback interface; yield the
    settings of its clients.
    """
    config = zenoh.Config()
    chosen = {
        "mode": "router",
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": True,
        "transport/shared_memory/enabled": False,
    }
    for key, value in chosen.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        answer = next(iter(session.get(f"@/{session.zid()}/router"))).ok
        if answer is None:
            raise RuntimeError("the router does not report its endpoints")
        yield ZenohSettings(connect=[json.loads(answer.payload.to_string())["locators"][0]])


def latency_figures(seed: int, alerts: int, vehicles: int = VEHICLES) -> list[Figure]:
    """Return the quantiles of the time from the publication of an alert to the warning, and the
    share of processor time that looking ahead takes, as figures of the evaluation.
    """
    waited, share, lost = measure_alerts(np.random.default_rng(seed), alerts, vehicles)
    return [
        Figure(
            "ahead.latency_p99_ms",
            float(np.quantile(waited, 0.99)) * 1e3 if len(waited) else float("nan"),
            "ms",
            250,
        ),
        Figure(
            "ahead.latency_p50_ms",
            float(np.median(waited)) * 1e3 if len(waited) else float("nan"),
            "ms",
        ),
        Figure("ahead.latency.unwarned", lost, f"of {alerts} alerts", 0),
        Figure("ahead.core_share.live", share, "of a core and car, questions included", 0.01),
    ]


def measure_alerts(
    rng: np.random.Generator, alerts: int, vehicles: int
) -> tuple[list[float], float, int]:
    """Publish `alerts` alerts on the roads of random cars. Return the latency of each warning [s],
    the share of a processor core that each car takes, and the number of alerts without a warning.
    """
    names = [f"car-{k:04d}" for k in range(vehicles)]
    warned: dict[str, queue.Queue[float]] = {name: queue.Queue() for name in names}

    def receive_warning(name: str, _: GripWarning) -> None:
        warned[name].put(time.perf_counter())

    places = [to_degrees(np.zeros(1), np.array([APART_M * k]), ORIGIN) for k in range(vehicles)]

    def current_poses() -> list[Pose]:
        now = time.time_ns()
        return [Pose(float(a[0]), float(o[0]), 0.0, SPEED, now) for a, o in places]

    waited: list[float] = []
    lost = 0
    with (
        open_router() as settings,
        MadeUpService(settings, time.time_ns()) as service,
        ExitStack() as stack,
    ):
        lookout = Lookout(names, receive_warning)
        for name in names:
            session = open_session(settings)
            assert session is not None
            stack.callback(session.close)
            lookout.attach(name, session)
        lookout.set_poses(current_poses())
        lookout.start()
        stack.callback(lookout.close)
        while lookout.counts.looks < 2 * vehicles:  # wait until all have subscribed
            time.sleep(0.05)
            lookout.set_poses(current_poses())
        time.sleep(SETTLE_S)
        began = time.perf_counter()
        busy = lookout.counts.busy_s
        looks = lookout.counts.looks
        for k in rng.integers(0, vehicles, alerts).tolist():
            lookout.set_poses(current_poses())
            put = time.perf_counter()
            service.put(_ice_alert(places[k], raised=True))
            if (at := _await_warning(warned[names[k]])) is not None:
                waited.append(at - put)
            service.put(_ice_alert(places[k], raised=False))
            has_ended = _await_warning(warned[names[k]]) is not None
            lost += (at is None) + (not has_ended)
        seconds = time.perf_counter() - began
        share = (lookout.counts.busy_s - busy) / max(seconds * vehicles, 1e-9)
        if lookout.counts.looks == looks:
            lost += 1
    return waited, share, lost


def _await_warning(warned: queue.Queue[float]) -> float | None:
    """Return the time of the next warning [s]; None if there is none within PATIENCE_S."""
    try:
        return warned.get(timeout=PATIENCE_S)
    except queue.Empty:
        return None


def _ice_alert(place: tuple[FloatArray, FloatArray], *, raised: bool) -> Alert:
    pose = ORIGIN._replace(latitude=float(place[0][0]), longitude=float(place[1][0]))
    latitude, longitude = to_degrees(np.array([AHEAD_M]), np.zeros(1), pose)
    cell = int(grid.cell_of(latitude, longitude)[0])
    middle = grid.centre(cell)
    return Alert(
        cell,
        0,
        raised,
        time.time_ns() - NS,
        0.15,
        0.1,
        0.22,
        0.98,
        3,
        float(middle[0]),
        float(middle[1]),
        "made up",
    )
