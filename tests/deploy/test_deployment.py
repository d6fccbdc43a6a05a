"""Tests of the shipped systemd units, compose file and configurations. The tests check the files
with standard tools such as systemd-analyze, and start the commands of the units.

The files' texts are used without change, except for folders and ports.
"""

from __future__ import annotations

import configparser
import json
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from fleet_service.client.map_client import query_map
from fleet_service.enrolment.fleet import Enrolment
from schemas.config import AgentConfig, ServiceConfig, load_config
from schemas.runtime.zenoh_session import configuration
from tests.ports import free_ports
from tests.schemas.runtime.test_metrics import fetch_page
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
BIN = Path(sys.executable).parent
PORTS = ("7447", "7448", "9464", "8080")
INSTANCES = {
    "gripmap-router@": ["router-a", "router-b"],
    "gripmap-service": [""],
    "gripmap-page": [""],
    "gripmap-agent@": ["car-001"],
}
MOST_EXPOSED = 3.0  # highest accepted exposure level of systemd, whose scale ends at 10
START_S = 300.0  # time for the first start on a busy machine, which compiles the kernels


class Site:
    """Test deployment ("site"): the folders of a deployment, moved below another root folder, and
    its ports, replaced by free ones.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._ports = [str(port) for port in free_ports(len(PORTS))]
        for name in ("etc", "lib", "cache"):
            (root / name).mkdir()
        for file in (DEPLOY / "secure").glob("*.json"):
            (root / "etc" / file.name).write_text(self.localize_paths(file.read_text()))
        alone = {"service": {"public_vehicles": 1}, "agent": {"trip_end_m": 0.0, "trip_end_s": 0.0}}
        for name, changed in alone.items():  # a single car would stay private for ever
            path = root / "etc" / f"{name}.json"
            path.write_text(json.dumps(json.loads(path.read_text()) | changed))

    def localize_paths(self, text: str) -> str:
        """Return a text with folders and ports replaced by those of this site (test deployment)."""
        places = {"/etc/gripmap": "etc", "/var/lib/gripmap": "lib", "/var/cache/gripmap": "cache"}
        for place, folder in places.items():
            text = text.replace(place, str(self.root / folder))
        text = text.replace("%S/gripmap", str(self.root / "lib")).replace(
            "%C/gripmap", str(self.root / "cache")
        )
        for port, other in zip(PORTS, self._ports, strict=True):
            text = text.replace(port, other)
        # Values that EnvironmentFile would set.
        text = text.replace("${SOURCE}", "simulated").replace("$MORE", "")
        return text.replace("/opt/gripmap/bin", str(BIN))

    def read_unit(self, unit: Path, instance: str) -> configparser.SectionProxy:
        """Return the [Service] section of a systemd unit."""
        parser = configparser.ConfigParser(strict=False, interpolation=None)
        parser.optionxform = str  # type: ignore[assignment,method-assign]
        parser.read_string(self.localize_paths(unit.read_text()).replace("%i", instance))
        return parser["Service"]

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self._ports[2]}"

    @property
    def page_address(self) -> str:
        return f"http://127.0.0.1:{self._ports[3]}"


def list_instances() -> Iterator[tuple[Path, str]]:
    for unit in UNITS:
        for instance in INSTANCES[unit.stem]:
            yield unit, instance


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd on this machine")
def test_systemd_accepts_the_units(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "units"
    folder.mkdir()
    for unit in UNITS:
        (folder / unit.name).write_text(site.localize_paths(unit.read_text()))
    names = [
        str(folder / unit.name.replace("@.", f"@{instance}."))
        for unit, instance in list_instances()
    ]
    done = subprocess.run(
        [
            "systemd-analyze",
            "verify",
            "--man=no",
            "--generators=no",
            "--recursive-errors=no",
            *names,
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    ours = [line for line in done.stderr.splitlines() if "gripmap" in line]
    assert not ours, done.stderr
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd on this machine")
def test_systemd_accepts_a_standby_with_one_more_word(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "units"
    (folder / "gripmap-service.service.d").mkdir(parents=True)
    unit = DEPLOY / "systemd" / "gripmap-service.service"
    (folder / unit.name).write_text(site.localize_paths(unit.read_text()))
    standby = folder / "gripmap-service.service.d" / "standby.conf"
    standby.write_text(site.localize_paths((DEPLOY / "systemd" / "standby.conf").read_text()))
    done = subprocess.run(
        [
            "systemd-analyze",
            "verify",
            "--man=no",
            "--generators=no",
            "--recursive-errors=no",
            str(folder / unit.name),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert not [
        line for line in done.stderr.splitlines() if "gripmap" in line or "standby" in line
    ], done.stderr
    *emptied, started = [
        line for line in standby.read_text().splitlines() if line.startswith("ExecStart=")
    ]
    assert emptied == ["ExecStart="]
    assert (
        started.removeprefix("ExecStart=") == f"{site.read_unit(unit, '')['ExecStart']} --standby"
    )


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd on this machine")
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_each_unit_is_shut_in(unit: Path, tmp_path: Path) -> None:
    """The exposure of each unit (how much of the system its process can reach), which systemd
    scores from 0 (isolated) to 10 (unprotected), must be at most MOST_EXPOSED.
    """
    instance = INSTANCES[unit.stem][0]
    file = tmp_path / unit.name.replace("@.", f"@{instance}.")
    file.write_text(unit.read_text())
    done = subprocess.run(
        [
            "systemd-analyze",
            "security",
            "--offline=true",
            "--no-pager",
            f"--threshold={MOST_EXPOSED * 10:.0f}",
            file,
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_systemd_units_restart_without_limit_under_their_own_user() -> None:
    users = set()
    for unit in UNITS:
        plain = configparser.ConfigParser(strict=False, interpolation=None)
        plain.optionxform = str  # type: ignore[assignment,method-assign]
        plain.read_string(unit.read_text())
        service = plain["Service"]
        users.add(service["User"])
        assert plain["Unit"]["StartLimitIntervalSec"] == "0"
        assert service["Restart"] == "always"
        assert {"MemoryMax", "UMask", "TasksMax"} <= set(service)
        assert "simulated" not in unit.read_text()
        assert (
            "edge-agent" not in service["ExecStart"] or "--source ${SOURCE}" in service["ExecStart"]
        )
    assert len(users) == len(UNITS)


def test_shipped_secure_settings_protect_privacy() -> None:
    secure = DEPLOY / "secure"
    agent = load_config(secure / "agent.json", AgentConfig)
    service = load_config(secure / "service.json", ServiceConfig)
    assert agent.trip_end_m > 0.0
    assert agent.trip_end_s > 0.0
    assert service.public_vehicles > 1
    assert service.fleet is not None


def test_compose_file_starts_the_same_processes_as_the_units() -> None:
    file = DEPLOY / "compose.yaml"
    subprocess.run(
        [BIN / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", file], check=True
    )
    services = YAML(typ="safe").load(file)["services"]
    started = sorted(part["command"] for name, part in services.items() if name != "certs")
    plain = configparser.ConfigParser(strict=False, interpolation=None)
    commands = []
    for unit, instance in list_instances():
        plain.read_string(unit.read_text().replace("%i", instance))
        started_by = (
            plain["Service"]["ExecStart"].replace("${SOURCE}", "simulated").replace("$MORE", "")
        )
        program, *rest = shlex.split(started_by)
        commands.append([Path(program).name, *rest])
    assert started == sorted(commands)
    for part in services.values():
        for volume in part["volumes"]:
            source = volume.split(":")[0]
            assert not source.startswith(".") or (file.parent / source).is_file(), source


def test_the_image_copies_only_what_there_is() -> None:
    words = [
        line.split()
        for line in (DEPLOY / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY ")
    ]
    sources = [source for line in words for source in line[1:-1]]
    assert sources
    assert [source for source in sources if not (ROOT / source).exists()] == []


def test_every_configuration_is_for_a_name_on_the_list() -> None:
    secure = DEPLOY / "secure"
    fleet = load_config(secure / "fleet.json", Enrolment)
    service = load_config(secure / "service.json", ServiceConfig)
    endpoints = [endpoint for router in fleet.routers.values() for endpoint in router.endpoints]
    assert service.name in fleet.services
    for config in (
        service,
        load_config(secure / "agent.json", AgentConfig),
        load_config(secure / "reader.json", ServiceConfig),
    ):
        assert config.zenoh.connect == endpoints
    assert f"certs/{fleet.readers[0]}.pem" in json.dumps(
        load_config(secure / "reader.json", ServiceConfig).zenoh.config
    )


@contextmanager
def running_units(site: Site) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Yield the processes that the commands of the systemd units start, in the order of their
    start. Those that run after the `with` block are killed.
    """
    running: list[subprocess.Popen[bytes]] = []
    with ExitStack() as stack:
        for unit, instance in sorted(
            list_instances(), key=lambda one: list(INSTANCES).index(one[0].stem)
        ):
            section = site.read_unit(unit, instance)
            Path(section["WorkingDirectory"]).mkdir(parents=True)
            log = stack.enter_context((site.root / f"{unit.stem}{instance}.log").open("wb"))
            process = subprocess.Popen(
                shlex.split(section["ExecStart"]),
                cwd=section["WorkingDirectory"],
                stdout=log,
                stderr=log,
            )
            running.append(stack.enter_context(process))
            stack.callback(process.kill)
        yield running


@pytest.mark.campaign
def test_processes_of_the_systemd_units_work_together_and_end_in_time(site: Site) -> None:
    """Two routers, a service, the live page and an agent must work together, and a client must be
    able to read the map. They have new certificates.

    At the end each process receives SIGTERM, as from systemd, and must end within ten seconds.
    """
    etc = site.root / "etc"
    options = ["--fleet", str(etc / "fleet.json"), "--out", str(etc / "certs")]
    subprocess.run(
        [str(BIN / "fleet-service"), "certs", *options], check=True, stdout=subprocess.DEVNULL
    )
    with running_units(site) as running:

        def count_rows() -> float:
            lines = fetch_page(f"{site.address}/metrics")[2].splitlines() if is_listening() else []
            return sum(
                float(line.split()[-1]) for line in lines if line.startswith("gripmap_rows_total")
            )

        def count_cells() -> int:
            shown = query_map(
                load_config(etc / "reader.json", ServiceConfig).zenoh, {"format": "arrow"}
            ).table
            return shown.num_rows if shown else 0

        def is_listening() -> bool:
            assert all(process.poll() is None for process in running), (
                "a part ended before its time"
            )
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", int(site.address.rsplit(":", 1)[1]))) == 0

        until(count_rows, START_S)
        assert fetch_page(f"{site.address}/healthz")[0] == 200
        until(count_cells, START_S)
        page_log = site.root / "gripmap-page.log"
        until(lambda: "page: http" in page_log.read_text(), START_S)
        until(lambda: json.loads(fetch_page(f"{site.page_address}/tiles")[2]), START_S)
        for process in reversed(running):
            began = time.monotonic()
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10.0) == 0, (
                f"{process.args!r} after {time.monotonic() - began:.1f} s"
            )
    events = [
        json.loads(line) for line in (site.root / "gripmap-service.log").read_text().splitlines()
    ]
    assert events[0]["event"] == "ready"
    # On a busy machine the service may reach its time limit before the last step. Then it reports
    # that.
    assert events[-1]["event"] in ("status", "shutdown incomplete")
    assert events[-1]["service"] == "shard-0"


def test_deployment_without_certificates_names_the_missing_one(site: Site) -> None:
    config = load_config(site.root / "etc" / "agent.json", AgentConfig)
    with pytest.raises(
        ValueError, match=r"there is no file .*trust.pem; make it with `fleet-service certs`"
    ):
        configuration(config.zenoh, "car-001")
