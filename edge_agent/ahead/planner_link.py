"""Zenoh session to the motion planner of a vehicle. It publishes the speed limit whenever the limit
changes, and repeats it every REPEAT_S seconds.
"""

from __future__ import annotations

import logging
import threading
from typing import Final

import zenoh

from edge_agent.ahead.horizon import Horizon
from edge_agent.ahead.path import Pose
from edge_agent.ahead.planner import PlannerKey, SteadyLimit, encode_limit, limit_of
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import NS

REPEAT_S: Final = 2.0  # [s] period of repetition, for a planner that starts later

log = logging.getLogger(__name__)


class PlannerLink:
    """Publisher of the speed limit ahead of one vehicle.

    Args:
        endpoint: Zenoh router of the planner; the session is opened on a separate thread.
        type_hash: hash of the type VelocityLimit in the installed version of the planner.
        domain: ROS domain.
    """

    def __init__(self, endpoint: str, type_hash: str, domain: int = 0) -> None:
        self._settings = ZenohSettings(connect=[endpoint])
        self._key = PlannerKey(domain, type_hash)
        self._limit = SteadyLimit()
        self._session: zenoh.Session | None = None
        self._sent = 0
        threading.Thread(target=self._open_session, name="planner", daemon=True).start()

    def _open_session(self) -> None:
        self._session = open_session(self._settings)

    def receive_horizons(self, _: str, horizons: list[Horizon], pose: Pose) -> None:
        """Compute the speed limit from `horizons`, the map's values for each metre ahead on each
        possible path. Publish the limit if it has changed, or if the last message was sent at least
        REPEAT_S seconds ago.
        """
        changed = self._limit.update(limit_of(horizons), pose.time)
        if self._session is None or not (changed or pose.time - self._sent >= REPEAT_S * NS):
            return
        self._sent = pose.time
        try:
            self._session.put(
                self._key.key,
                encode_limit(self._limit.value, pose.time),
                attachment=self._key.attachment(pose.time),
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
        except zenoh.ZError as error:
            log.warning("the planner is unreachable: %s", error)
