"""Two real routers with mutual TLS and the generated access list, and Zenoh sessions under any
enrolled name.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import zenoh

from fleet_service.enrolment.enrol import Registry, ValidityPeriods
from fleet_service.enrolment.fleet import Enrolment, Router
from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import configuration
from tests.ports import free_ports
from tests.waiting import until

SERVICE = "shard-0"
READER = "reader-0"
WEATHER = "weather-0"
VEHICLES = ("sim-000", "sim-001")
ROUTERS = ("router-a", "router-b")
ROOT = Path(__file__).resolve().parents[1]
PROBE = f"{keys.ROOT}/shard/probe"
TRIES = 3  # attempts to open a session
RETRY = {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1.0}


def free_endpoint(protocol: str) -> str:
    """Return an endpoint with a free port. The port stays free while a router restarts, so that the
    router can use it again.
    """
    return f"{protocol}/127.0.0.1:{free_ports(1)[0]}"


def make_enrolment(**changed: object) -> Enrolment:
    """Return an enrolment of two routers, a service, a reader and two vehicles; `changed` replaces
    fields of it.
    """
    names = {
        "services": [SERVICE],
        "readers": [READER],
        "weather": [WEATHER],
        "vehicles": list(VEHICLES),
    }
    return Enrolment.model_validate(
        {"routers": dict.fromkeys(ROUTERS, Router()), **names, **changed}
    )


def open_registry(folder: Path) -> Registry:
    """Open a certificate registry with a new certificate authority in a folder, valid from now
    on.
    """
    return Registry(folder, ValidityPeriods(), datetime.now(UTC))


def settings(endpoint: str, folder: Path, **changed: object) -> ZenohSettings:
    """Return the Zenoh settings of a session with the router at `endpoint`. The session uses the
    certificates in `folder`; `changed` replaces entries of the TLS section.
    """
    tls = {
        "root_ca_certificate": str(folder / "trust.pem"),
        "connect_certificate": str(folder / "{name}.pem"),
        "connect_private_key": str(folder / "{name}.key"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    return ZenohSettings(
        connect=[endpoint],
        config={"transport/link/tls": {**tls, **changed}, "connect/retry": RETRY},
    )


@dataclass
class Network:
    """Two routers, each in a separate process; the second one connects to the first over TLS. In
    one process, Zenoh may abort when one of two connected routers is closed.

    Attributes:
        guarded: False if the routers check neither certificates nor the access list. Tests use
            such routers as a control: there the attacks must succeed.
        protocol: transport of sessions.
        capped: True if the routers limit message rates. Tests of several attacks use routers
            without limits. With limits, a router could drop the messages of an attack because they
            follow too soon after those of another attack. The access list would then seem to have
            refused them.
    """

    folder: Path
    guarded: bool = True
    protocol: str = "tls"
    capped: bool = False
    routers: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    endpoints: dict[str, str] = field(default_factory=dict)
    between: dict[str, str] = field(default_factory=dict)

    def open_session(self, name: str, router: str = ROUTERS[0], **changed: object) -> zenoh.Session:
        """Open a session under an enrolled name. On a busy machine a handshake may fail, so only
        several failures count as a refusal.

        Raises:
            zenoh.ZError: the router refuses the session.
        """
        where = settings(self.endpoints[router], self.folder, **changed)
        for _ in range(TRIES - 1):
            with suppress(zenoh.ZError):
                return zenoh.open(configuration(where, name))
        return zenoh.open(configuration(where, name))

    def session_at(self, name: str, endpoints: Sequence[str]) -> zenoh.Session:
        """Return a session under an enrolled name that tries several endpoints in turn."""
        where = settings(endpoints[0], self.folder).model_copy(update={"connect": list(endpoints)})
        return zenoh.open(configuration(where, name))

    def start(self, router: str) -> None:
        """Start a router from its configuration file, on its previous port if it had one."""
        file = self.folder / f"{router}.json5"
        config = json.loads(file.read_text())
        if router != ROUTERS[0]:  # the file has fixed ports; this test uses free ones
            config["connect"] = {"endpoints": [self.between[ROUTERS[0]]], "retry": RETRY}
        if not self.capped:
            del config["downsampling"]
        if not self.guarded:
            config["transport"]["link"]["tls"]["enable_mtls"] = False
            del config["access_control"], config["low_pass_filter"]
        running = file.with_suffix(".running.json5")
        running.write_text(json.dumps(config))
        protocols = dict.fromkeys((self.protocol, "tls"))
        places = {"tls": self.between.get(router), self.protocol: self.endpoints.get(router)}
        listen = [places[protocol] or free_endpoint(protocol) for protocol in protocols]
        command = ["--config", str(running), "--listen", *listen]
        process = subprocess.Popen(
            [sys.executable, "-m", "deploy.router", *command],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        self.routers[router] = process
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("router: "), f"{router} does not start"
        endpoints = {place.partition("/")[0]: place for place in line.split()[1:]}
        self.endpoints[router] = endpoints[self.protocol]
        self.between[router] = endpoints["tls"]

    def stop(self, router: str) -> None:
        """Stop one of the two routers."""
        with self.routers.pop(router) as process:
            process.terminate()

    def await_link(self) -> None:
        """Wait until a message of each of the two routers reaches the other."""
        for first, second in (ROUTERS, ROUTERS[::-1]):
            with (
                self.open_session(SERVICE, first) as receiver,
                self.open_session(SERVICE, second) as sender,
            ):
                arrived = threading.Event()
                subscriber = receiver.declare_subscriber(PROBE, partial(_set_arrived, arrived))
                # Repeat a put. A publisher that is older than the link may never learn of its
                # subscriber.
                until(partial(_has_arrived, sender, arrived))
                subscriber.undeclare()

    def close(self) -> None:
        """Stop all running routers."""
        for router in list(self.routers):
            self.stop(router)


def _set_arrived(arrived: threading.Event, _: zenoh.Sample) -> None:
    arrived.set()


def _has_arrived(sender: zenoh.Session, arrived: threading.Event) -> bool:
    sender.put(PROBE, b"")
    return arrived.is_set()


@contextmanager
def open_network(
    folder: Path,
    *,
    guarded: bool = True,
    fleet: Enrolment | None = None,
    protocol: str = "tls",
    capped: bool = False,
) -> Iterator[Network]:
    """Create certificates in a folder, start two routers that check them, and yield the network."""
    open_registry(folder).enrol(fleet or make_enrolment())
    running = Network(folder, guarded, protocol, capped)
    with ExitStack() as stack:
        stack.callback(running.close)
        for router in ROUTERS:
            running.start(router)
        running.await_link()
        yield running
