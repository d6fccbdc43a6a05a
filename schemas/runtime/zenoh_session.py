"""Zenoh session of the contract: a client of routers, without scouting, gossip and shared memory.

Reasons: scouting finds strangers and costs half a second at start; shared memory drops samples silently when a receiver
stalls; the lease states how long a silent peer is kept.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Mapping
from pathlib import Path
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
NAME: Final = "{name}"
_TLS: Final = "transport/link/tls"

log = logging.getLogger(__name__)


def configuration(settings: ZenohSettings, name: str = "") -> zenoh.Config:
    """Return the Zenoh configuration: the defaults above, the endpoints, then the pass-through section.

    Args:
        settings: of the configuration file.
        name: of the session; replaces `{name}` in the section, so that one file serves many vehicles with a certificate
            each.

    Raises:
        InputError: Zenoh refuses a setting, or a certificate that it names does not exist.
    """
    config = zenoh.Config()
    chosen = {**CLIENT, "connect/endpoints": settings.connect, **settings.config}
    for key, value in chosen.items():
        text = json.dumps(value)
        try:
            config.insert_json5(key, text.replace(NAME, name))
        except zenoh.ZError as error:
            problem = f"Zenoh refuses {text[:60]}"
            raise InputError(f"zenoh.config.{key}", problem, "see Zenoh's configuration reference") from error
    for key, value in json.loads(config.get_json(_TLS)).items():
        if key.endswith(("certificate", "private_key")) and value is not None and not Path(value).is_file():
            fix = "make it with `fleet-service certs`, or correct the path"
            raise InputError(f"zenoh.config.{_TLS}/{key}", f"there is no file {value}", fix)
    return config


def open_session(settings: ZenohSettings, stop: threading.Event | None = None, name: str = "") -> zenoh.Session | None:
    """Open a session; wait for the router until one answers or `stop` is set (then return None).

    A session that lost its router reconnects by itself. The reason for waiting is logged once.
    """
    stop, logged = stop or threading.Event(), set[str]()
    while not stop.is_set():
        try:
            return zenoh.open(configuration(settings, name))
        except zenoh.ZError as error:
            reason = str(error).partition(" at /")[0].strip()  # where Zenoh was built is nobody's business
            if reason not in logged:
                logged.add(reason)
                log.warning("no session at %s yet: %s", ", ".join(settings.connect), reason)
            stop.wait(RETRY_S)
    return None
