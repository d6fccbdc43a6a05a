"""Zenoh session for GripMap: a client of routers, without scouting, gossip and shared memory.

Reasons for the settings:

- Scouting finds foreign routers and costs half a second at start.
- Shared memory drops samples silently when a receiver stalls.
- The lease is the time for which the link to a silent peer stays open; here it is 3 s.
- An endpoint that does not answer is abandoned after `open_timeout`. Therefore, where UDP is
  blocked, TLS (listed after QUIC) is tried soon.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import zenoh

from schemas import keys
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime.certificates import TLS, find_certificate_faults

CLIENT: Final[Mapping[str, Any]] = {
    "mode": "client",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 3000,
    "transport/unicast/open_timeout": 2000,  # [ms] several round trips of a mobile network
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 1.5},
}
RETRY_S: Final = 0.5
LONGEST_OPEN_MS: Final = 10_000  # Zenoh's own limit for opening a link
_TIMEOUT: Final = "connect/timeout_ms"
_OPEN: Final = "transport/unicast/open_timeout"
NAME: Final = "{name}"
ENDPOINTS: Final = "connect/endpoints"
# Zenoh tries an endpoint without a port, or of another protocol, again and again without success.
_ENDPOINT: Final = re.compile(
    r"(tcp|udp|tls|quic|quic_datagram|ws)/\S+:\d{1,5}([?#].*)?"
    r"|(unixsock-stream|unixpipe|serial|vsock)/.+"
)
_FIX: Final = "write PROTOCOL/HOST:PORT, such as tcp/127.0.0.1:7447 or tls/HOST:7447"

log = logging.getLogger(__name__)


def configuration(settings: ZenohSettings, name: str = "") -> zenoh.Config:
    """Return the Zenoh configuration of a session. It combines this module's defaults, the
    endpoints in `settings`, and the section `config` in `settings`. A later source overrides the
    earlier ones.

    Args:
        settings: Zenoh section of the configuration file.
        name: name of the session; replaces `{name}` in the settings, so that one file serves many
            vehicles, each with its own certificate.

    Raises:
        InputError: an endpoint is malformed, Zenoh refuses a setting, a certificate that it names
            does not exist, or a connection time limit would prevent the session from trying its
            second endpoint.
    """
    if len(settings.connect) > 1 and settings.config.get(_TIMEOUT, 0) != 0:
        problem = "with a limit Zenoh tries the first endpoint only"
        raise InputError(
            f"zenoh.config.{_TIMEOUT}", problem, "leave it out; open_session waits for a router"
        )
    if settings.config.get("mode", CLIENT["mode"]) == CLIENT["mode"]:
        _check_endpoints(settings.connect)
    config = zenoh.Config()
    chosen = {**CLIENT, ENDPOINTS: settings.connect, **settings.config}
    for key, value in chosen.items():
        text = json.dumps(value)
        try:
            config.insert_json5(key, text.replace(NAME, name))
        except zenoh.ZError as error:
            problem = f"Zenoh refuses {text[:60]}"
            raise InputError(
                f"zenoh.config.{key}", problem, "see Zenoh's configuration reference"
            ) from error
    check_certificates(config, "zenoh.config.")
    return config


def check_certificates(config: zenoh.Config, section: str = "") -> None:
    """Raise InputError if a certificate or private key in a configuration does not exist. `section`
    stands before the name of the setting in the message.
    """
    for key, value in json.loads(config.get_json(TLS)).items():
        if (
            key.endswith(("certificate", "private_key"))
            and value is not None
            and not Path(value).is_file()
        ):
            fix = "make it with `fleet-service certs`, or correct the path"
            raise InputError(f"{section}{TLS}/{key}", f"there is no file {value}", fix)


def explain_faults(config: zenoh.Config) -> str:
    """Return the faults of the certificates of a session as one line; "" if none is visible."""
    return "; ".join(find_certificate_faults(config, time.time()))


def _check_endpoints(endpoints: Sequence[str]) -> None:
    """Raise InputError if a client could never connect: no endpoint, or one that is malformed."""
    if not endpoints:
        raise InputError("connect", "names no router", _FIX)
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise InputError("connect", f"{endpoint[:60]} is not an endpoint", _FIX)


def quality_of(topic: keys.Topic) -> dict[str, Any]:
    """Return the quality of service of a topic (kind of Zenoh key) as keyword arguments for Zenoh's
    methods `put` and `declare_publisher`.
    """
    congestion = zenoh.CongestionControl.BLOCK if topic.block else zenoh.CongestionControl.DROP
    priority = getattr(zenoh.Priority, topic.priority)
    return {"priority": priority, "congestion_control": congestion, "express": topic.express}


def error_reason(error: zenoh.ZError) -> str:
    """Return the message of an error of Zenoh as one line, without its end, which is a path of the
    machine that built Zenoh.
    """
    return " ".join(str(error).partition(" at /")[0].split())


def connected_routers(session: zenoh.Session) -> frozenset[str]:
    """Return the ids of the routers to which a session is connected. The result is empty if the
    session is closed, or if another thread is closing it.
    """
    try:
        return frozenset(str(zid) for zid in session.info.routers_zid())
    # While a thread closes the session, Zenoh lends it to no other: "Already mutably borrowed".
    except (RuntimeError, zenoh.ZError):
        return frozenset()


class ReasonLog:
    """Log of the reasons why no session could be opened. Each reason is logged once, even if
    several threads that open sessions share the object.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._logged = set[str]()

    def log_once(self, settings: ZenohSettings, reason: str) -> None:
        """Log a reason with the endpoints that were tried, unless it was logged before."""
        with self._lock:
            if reason in self._logged:
                return
            self._logged.add(reason)
        log.warning("no session at %s yet: %s", ", ".join(settings.connect), reason)


def open_session(
    settings: ZenohSettings,
    stop: threading.Event | None = None,
    name: str = "",
    reasons: ReasonLog | None = None,
) -> zenoh.Session | None:
    """Open a Zenoh session and return it as soon as a router answers. Return None if the event
    `stop` is set before.

    A session that loses its router reconnects by itself. Each reason why no session could be opened
    is logged once, by `reasons` if it is given. If no router answers in time, the next attempt
    waits twice as long, so that a slow network is not mistaken for a blocked one.
    """
    stop = stop or threading.Event()
    reasons = reasons or ReasonLog()
    open_ms = settings.config.get(_OPEN, CLIENT[_OPEN])
    while not stop.is_set():
        patient = settings.model_copy(update={"config": {**settings.config, _OPEN: open_ms}})
        config = configuration(patient, name)
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            reasons.log_once(settings, explain_faults(config) or error_reason(error))
            open_ms = max(open_ms, min(2 * open_ms, LONGEST_OPEN_MS))
            stop.wait(RETRY_S)
    return None
