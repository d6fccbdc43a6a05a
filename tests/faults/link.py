"""Campaign on the link between a car and its router: packet loss, a new address, blocked UDP, a
router that returns, and a flood.

Router and service run in one network namespace, cars in others. `link_relay.py` simulates the links
between them. An endpoint is a process with one Zenoh session to the router, which plays a car, a
reader or the service (`link_ends.py`). The same traffic runs over QUIC and over TLS for comparison.
Creating namespaces and TUN devices needs root.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from fleet_service.enrolment.fleet import Enrolment, Router
from schemas import grid, keys
from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.link_relay import DEVICE, LinkTerms
from tests.fleet_service.examples import LATITUDE, LONGITUDE, key
from tests.secured import READER, SERVICE, open_registry

ROUTER_ADDRESS: Final = "10.77.0.1"
FLOOD_NET: Final = "10.78.0"
PORTS: Final = (7447, 7448)
HONEST: Final = tuple(f"car-{number:03}" for number in range(5))
FLOODER: Final = "flood-001"
SAMPLES_PER_S: Final = 48.0
LOSSY: Final = LinkTerms(loss=0.02, delay_s=0.04, bytes_per_s=500_000.0)
MOBILE: Final = LinkTerms(delay_s=0.04)
UPLINK: Final = LinkTerms(delay_s=0.04, bytes_per_s=2_000_000.0)
TILE_BYTES: Final = 40_000
TILES_PER_S: Final = 10.0
ALERTS_PER_S: Final = (
    7.3  # not a divisor of the tiles' rate, so that alerts and tiles meet in all phases
)
QUIET_S: Final = 0.5  # wait after the last message, for messages in transit
START_S: Final = 30.0
TILE: Final = int(grid.tile_of(int(grid.cell_of(LATITUDE, LONGITUDE))))


class Namespaces:
    """Network namespaces of one run: the routers are in the namespace `road`, and simulated links
    connect the cars' namespaces to it.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self._stack = stack
        self._tag = f"gm{os.getpid()}"
        self.certificates = folder / "certificates"
        routers = {
            f"router-{letter}": Router(
                hosts=[ROUTER_ADDRESS, "127.0.0.1"], listen="0.0.0.0", port=port
            )
            for letter, port in zip("ab", PORTS, strict=True)
        }
        names = {"services": [SERVICE], "readers": [READER], "vehicles": [*HONEST, FLOODER]}
        open_registry(self.certificates).enrol(
            Enrolment.model_validate({"routers": routers, **names})
        )
        self.road = self._add_namespace("road")

    def _add_namespace(self, name: str) -> str:
        namespace = f"{self._tag}-{name}"
        run_command("ip", "netns", "add", namespace)
        self._stack.callback(run_command, "ip", "netns", "delete", namespace)
        run_command("ip", "-n", namespace, "link", "set", "lo", "up")
        return namespace

    def connect_cars(
        self, name: str, terms: LinkTerms, net: str = "10.77.0"
    ) -> tuple[str, subprocess.Popen[str]]:
        """Create a network namespace for cars, linked to the namespace `road` of the routers.
        Return its name, and the process that simulates the link.
        """
        car = self._add_namespace(name)
        device = f"{DEVICE}{net[3:5]}"
        given = {"left": car, "right": self.road, "device": device, "terms": asdict(terms)}
        link = self.start_process("", "tests.faults.link_relay", given)
        read_line(link)
        for namespace, number in ((car, 2), (self.road, 1)):
            run_command(
                "ip", "-n", namespace, "address", "add", f"{net}.{number}/24", "dev", device
            )
            run_command("ip", "-n", namespace, "link", "set", device, "up")
        if net != "10.77.0":
            run_command("ip", "-n", car, "route", "add", "10.77.0.0/24", "dev", device)
        return car, link

    def move_car(self, car: str, number: int) -> None:
        """Give the simulated car a new network address and remove the old one, as a mobile network
        does.
        """
        device = f"{DEVICE}77"
        run_command("ip", "-n", car, "address", "flush", "dev", device)
        run_command("ip", "-n", car, "address", "add", f"10.77.0.{number}/24", "dev", device)

    def start_process(
        self, namespace: str, module: str, given: dict[str, Any]
    ) -> subprocess.Popen[str]:
        """Start a process of the campaign in a network namespace. If it still runs at the end of
        the campaign, it is ended then.
        """
        inside = ["ip", "netns", "exec", namespace] if namespace else []
        return self._open_process([*inside, sys.executable, "-m", module, json.dumps(given)])

    def start_router(
        self, letter: str = "a", protocols: Sequence[str] = ("quic", "tls"), *, capped: bool = True
    ) -> subprocess.Popen[str]:
        """Start a router in `road` as `fleet-service certs` configures it, but only with the
        transports `protocols`.
        """
        file = self.certificates / f"router-{letter}.json5"
        config = json.loads(file.read_text())
        listen = config["listen"]
        listen["endpoints"] = [
            one for one in listen["endpoints"] if one.partition("/")[0] in protocols
        ]
        if not capped:
            del config["downsampling"]
        used = file.with_suffix(".running.json5")
        used.write_text(json.dumps(config))
        command = [
            "ip",
            "netns",
            "exec",
            self.road,
            sys.executable,
            "-m",
            "deploy.router",
            "--config",
            str(used),
        ]
        process = self._open_process(command)
        read_line(process)
        return process

    def start_end(
        self, role: str, namespace: str, name: str, protocols: Sequence[str], **given: object
    ) -> subprocess.Popen[str]:
        """Start an endpoint: a process that connects to the router over the transports
        `protocols`.

        Args:
            role: task of the process, see `link_ends.py`: "receive", "send", "open" or "watch".
            namespace: network namespace in which the process runs.
            name: name in the certificate with which it connects.
            protocols: transports that it tries: "quic", "tls".
            given: options of the role; `ports` are those of the routers.
        """
        inside = "127.0.0.1" if namespace == self.road else ROUTER_ADDRESS
        ports = given.pop("ports", PORTS[:1])
        assert isinstance(ports, Sequence)
        connect = [f"{protocol}/{inside}:{port}" for port in ports for protocol in protocols]
        whole = {
            "role": role,
            "name": name,
            "connect": connect,
            "certificates": str(self.certificates),
            **given,
        }
        return self.start_process(namespace, "tests.faults.link_ends", whole)

    def _open_process(self, command: list[str]) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._stack.callback(stop_process, process)
        return process


def run_command(*command: str) -> None:
    """Run a command of iproute2, which configures network namespaces and devices."""
    subprocess.run(command, check=True, capture_output=True)


def stop_process(process: subprocess.Popen[str]) -> None:
    """Kill a process of the link campaign and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # unwritten data is not needed
                pipe.close()


def read_line(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process of the link campaign prints."""
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, f"{process.args!r} ended early"
    return line


def finish_end(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Close the stdin of an endpoint's process, which ends it, and return the result that it then
    prints.
    """
    assert process.stdin is not None
    process.stdin.close()
    found: dict[str, Any] = json.loads(read_line(process))
    return found


def write_line(process: subprocess.Popen[str], line: str) -> None:
    """Write a line to the stdin of a process of the link campaign."""
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


@contextmanager
def open_namespaces(folder: Path) -> Iterator[Namespaces]:
    """Yield network namespaces, which are removed after the `with` block."""
    folder.mkdir(parents=True)
    with ExitStack() as stack:
        yield Namespaces(folder, stack)


def change_address(
    site: Site, protocol: str, seconds: float, *, capped: bool = False
) -> tuple[int, int, float]:
    """Return how many messages a car sent and how many were lost while its address changed twice,
    and the longest gap [s] between received messages.

    If `capped` is True, the router limits the message rate: it drops a message that arrives within
    10 ms of the previous one. By default the router has no limit, so that every loss is a loss of
    the link. With a limit, a busy test machine also causes losses. It delays messages, so they
    arrive close together.
    """
    with open_namespaces(site.folder / f"address-{protocol}-{capped}") as network:
        network.start_router(capped=capped)
        car, _ = network.connect_cars("car", MOBILE)
        place = key(HONEST[0])
        service = network.start_end("receive", network.road, SERVICE, ("tls",), keys=[place])
        read_line(service)
        streams = [{"key": place, "size": 300, "rate": SAMPLES_PER_S}]
        vehicle = network.start_end(
            "send", car, HONEST[0], (protocol,), streams=streams, drain_s=QUIET_S
        )
        read_line(vehicle)
        write_line(vehicle, "go")
        for number in (3, 4):
            time.sleep(seconds / 3)
            network.move_car(car, number)
        time.sleep(seconds / 3)
        put = finish_end(vehicle)[place]
        arrived = finish_end(service).get(place, [])
    numbers = {number for number, _, _ in arrived}
    times = np.sort([at for _, _, at in arrived])
    return put, put - len(numbers), float(np.diff(times).max())


def delay_alerts(site: Site, protocol: str, seconds: float) -> dict[str, float]:
    """Send alerts and map tiles to a car over a lossy link. Return the p50 and p99 delay of the
    alerts [ms], the numbers of alerts that arrived and that were lost, and the share of tiles that
    arrived.
    """
    with open_namespaces(site.folder / f"lossy-{protocol}") as network:
        network.start_router()
        car, _ = network.connect_cars("car", LOSSY)
        alert = keys.alert_key(TILE)
        tile = keys.map_key(TILE)
        reader = network.start_end("receive", car, READER, (protocol,), keys=[alert, tile])
        used = json.loads(read_line(reader))["protocols"]
        assert used == [protocol], used
        streams = [
            {"key": alert, "size": 150, "rate": ALERTS_PER_S},
            {"key": tile, "size": TILE_BYTES, "rate": TILES_PER_S},
        ]
        service = network.start_end("send", network.road, SERVICE, ("tls",), streams=streams)
        read_line(service)
        write_line(service, "go")
        time.sleep(seconds)
        put = finish_end(service)
        time.sleep(QUIET_S)
        arrived = finish_end(reader)
    delays = 1e3 * np.array([delay for _, delay, _ in arrived[alert]])
    return {
        "p50": float(np.quantile(delays, 0.5)),
        "p99": float(np.quantile(delays, 0.99)),
        "alerts": float(len(delays)),
        "alerts_lost": float(put[alert] - len(delays)),
        "tiles_share": len(arrived.get(tile, [])) / put[tile],
    }


def block_udp(site: Site) -> float:
    """Return the time [s] until a car's Zenoh session is open over TLS on a link that blocks UDP
    and therefore QUIC.
    """
    with open_namespaces(site.folder / "udp") as network:
        for letter in "ab":
            network.start_router(letter)
        car, _ = network.connect_cars("car", LinkTerms(delay_s=0.04, drop_udp=True))
        found = json.loads(
            read_line(network.start_end("open", car, HONEST[0], ("quic", "tls"), ports=PORTS))
        )
        assert found["protocols"] == ["tls"], found
        return float(found["seconds"])


def return_with_tls(site: Site, outages_s: Sequence[float]) -> float:
    """Return the longest time [s] until a car is connected again after an outage of its router.
    There is one outage for each length in `outages_s` [s]. The router served QUIC and TLS before,
    and serves only TLS afterwards.
    """
    longest = 0.0
    with open_namespaces(site.folder / "back") as network:
        router = network.start_router()
        car, _ = network.connect_cars("car", MOBILE)
        watched = network.start_end("watch", car, HONEST[0], ("quic", "tls"), ports=PORTS)
        assert json.loads(read_line(watched))["protocols"] == ["quic"]
        for outage_s in outages_s:
            stop_process(router)
            while json.loads(read_line(watched))["connected"]:
                pass
            time.sleep(outage_s)
            router = network.start_router(protocols=("tls",))
            back = time.monotonic()
            while not (state := json.loads(read_line(watched)))["connected"]:
                pass
            longest = max(longest, state["time"] - back)
            site.say(f"back after {state['time'] - back:.2f} s over {state['protocols']}")
    return longest


def measure_flood(site: Site, seconds: float, *, capped: bool) -> tuple[float, float]:
    """Let one car send as many messages as it can. Return the p99 delay of the other cars' messages
    during this flood divided by their delay before it, and the rate at which messages of the
    flooding car passed the router [1/s]. `capped` is True if the router limits message rates.
    """
    with open_namespaces(site.folder / f"flood-{capped}") as network:
        network.start_router(capped=capped)
        cars, _ = network.connect_cars("car", MOBILE)
        flooding, _ = network.connect_cars("flood", UPLINK, FLOOD_NET)
        streams = [{"name": name, "key": key(name), "size": 1000, "rate": 4.0} for name in HONEST]
        place = key(FLOODER)
        service = network.start_end(
            "receive", network.road, SERVICE, ("tls",), keys=["gripmap/v1/obs/**"]
        )
        read_line(service)
        honest = network.start_end(
            "send", cars, HONEST[0], ("quic",), streams=streams, drain_s=QUIET_S
        )
        attacker = network.start_end(
            "send", flooding, FLOODER, ("quic",), streams=[{"key": place, "size": 1000, "rate": 0}]
        )
        read_line(honest)
        read_line(attacker)
        write_line(honest, "go")
        time.sleep(seconds)
        began = time.monotonic()
        write_line(attacker, "go")
        time.sleep(seconds)
        ended = time.monotonic()
        stop_process(attacker)
        finish_end(honest)
        arrived = finish_end(service)
    delays: dict[bool, list[float]] = {False: [], True: []}
    for name in HONEST:
        for _, delay, at in arrived[key(name)]:
            if at - delay < ended:
                delays[at >= began].append(delay)
    passed = len(arrived.get(place, [])) / (ended - began)
    with_flood, without = (float(np.quantile(delays[during], 0.99)) for during in (True, False))
    return with_flood / without, passed


def measure(site: Site) -> list[Figure]:
    """Run all parts of the campaign on the link between car and router, and return its figures."""
    address_s = site.choose_amount(15, 6)
    lossy_s = site.choose_amount(60, 12)
    flood_s = site.choose_amount(20, 5)
    put, lost, gap = change_address(site, "quic", address_s)
    _, tls_lost, tls_gap = change_address(site, "tls", address_s)
    _, capped_lost, _ = change_address(site, "quic", address_s, capped=True)
    site.say(
        f"new addresses: QUIC lost {lost} of {put}, gap {gap:.2f} s; TLS lost {tls_lost}, gap "
        f"{tls_gap:.2f} s; QUIC with the router's cap lost {capped_lost}"
    )
    quic, tls = (delay_alerts(site, protocol, lossy_s) for protocol in ("quic", "tls"))
    site.say(f"lossy link: QUIC {quic}; TLS {tls}")
    ready_s = block_udp(site)
    back_s = return_with_tls(site, (1.0, 4.0, 7.0) if not site.quick else (2.0,))
    ratio, passed = measure_flood(site, flood_s, capped=True)
    free_ratio, free = measure_flood(site, flood_s, capped=False)
    site.say(
        f"flood: {passed:.0f} of {free:.0f} messages/s pass; honest p99 {ratio:.2f} "
        f"{free_ratio:.2f} uncapped"
    )
    return [
        make_figure("link.address_change.lost", lost),
        make_figure("link.address_change.gap_s", gap),
        make_figure("link.address_change.samples", put),
        Figure("link.address_change.capped_lost", capped_lost, "samples, dropped by the cap"),
        Figure("link.address_change.tls_lost", tls_lost, "samples, the same over TLS"),
        Figure("link.address_change.tls_gap_s", tls_gap, "s, the same over TLS"),
        make_figure("link.lossy.alert_p99_ms", quic["p99"]),
        make_figure("link.lossy.alert_p99_ratio", quic["p99"] / tls["p99"]),
        make_figure("link.lossy.alerts_lost", quic["alerts_lost"]),
        Figure("link.lossy.alert_p50_ms", quic["p50"], "ms"),
        Figure("link.lossy.tls_p50_ms", tls["p50"], "ms, over TLS"),
        Figure("link.lossy.tls_p99_ms", tls["p99"], "ms, over TLS"),
        Figure("link.lossy.tiles_share", quic["tiles_share"], "of tiles that arrived"),
        Figure("link.lossy.tls_tiles_share", tls["tiles_share"], "of tiles that arrived over TLS"),
        make_figure("link.udp_blocked.ready_s", ready_s),
        make_figure("link.router_back_tls_only_s", back_s),
        make_figure("link.flood.honest_p99_ratio", ratio),
        make_figure("link.flood.sent_per_s", free),
        Figure("link.flood.passed_per_s", passed, "messages/s of the flooding car"),
        Figure("link.flood.uncapped_p99_ratio", free_ratio, "with a flood over without, no caps"),
    ]


OWES: Final = (
    *("link.address_change.lost", "link.address_change.gap_s", "link.address_change.samples"),
    *("link.lossy.alert_p99_ms", "link.lossy.alert_p99_ratio", "link.lossy.alerts_lost"),
    *("link.udp_blocked.ready_s", "link.router_back_tls_only_s"),
    *("link.flood.honest_p99_ratio", "link.flood.sent_per_s"),
)
