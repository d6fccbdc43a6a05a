"""A Zenoh session as the contract wants it: a client of routers, no scouting, no gossip, no shared memory.

Why these settings: scouting finds strangers and costs half a second at start; shared memory drops samples silently when
a receiver stalls; the lease says after how long a silent peer counts as gone.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from typing import Any, Final

import zenoh

from schemas.config import ZenohSettings
from schemas.errors import InputError

CLIENT: Final[Mapping[str, Any]] = {
    "mode": "client",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 3000,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 1.5},
}
RETRY_S: Final = 0.5


def configuration(settings: ZenohSettings) -> zenoh.Config:
    """Zenoh configuration: the defaults above, the endpoints, then the pass-through section.

    Raises:
        InputError: Zenoh refuses a setting.
    """
    config = zenoh.Config()
    chosen = {**CLIENT, "connect/endpoints": settings.connect, **settings.config}
    for key, value in chosen.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            problem = f"Zenoh refuses {json.dumps(value)[:60]}"
            raise InputError(f"zenoh.config.{key}", problem, "see Zenoh's configuration reference") from error
    return config


def open_session(settings: ZenohSettings, stop: threading.Event | None = None) -> zenoh.Session | None:
    """Open a session; wait for the router as long as it takes, until `stop` is set (then None).

    A session that lost its router reconnects by itself.
    """
    stop = stop or threading.Event()
    while not stop.is_set():
        try:
            return zenoh.open(configuration(settings))
        except zenoh.ZError:
            stop.wait(RETRY_S)
    return None
