"""Tests of the hand-over of a running service's region to another service. The new service must
have the same map, alerts, trust in vehicles and known batches.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

from fleet_service.app.service import Service
from fleet_service.cli import main
from fleet_service.replication.bucket import ObjectBucket
from fleet_service.replication.lease import Lease
from fleet_service.replication.ownership import acquire_archive
from fleet_service.shards.serving import standby_signs
from schemas.config import ServiceConfig, ZenohSettings
from tests.buckets import BucketServer
from tests.event_lines import logger_into
from tests.fleet_service.app.test_copy import BATCHES, read_image, reports
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.replication.test_lease import make_driver
from tests.waiting import until

PATIENCE_S = 120.0
EVERYWHERE = "*/*/*"


class Machine:
    """Service with the option `--standby` (it waits for another to end), run in threads of the
    test's process.
    """

    def __init__(self, name: str, router: ZenohSettings, bucket: BucketServer, root: Path) -> None:
        archive = {"path": str(root), **bucket.settings}
        settings = {
            "name": name,
            "zenoh": router,
            "standby": True,
            "lease_s": 10.0,
            "archive": archive,
            "segment_s": 0.1,
        }
        self._config = ServiceConfig.model_validate(settings)
        self._root = root
        self.lines: list[str] = []
        self.stop = threading.Event()
        self.service: Service | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self, awaited: str) -> None:
        self._thread.start()
        until(lambda: self.has_said(awaited), PATIENCE_S)

    def has_said(self, start: str) -> bool:
        return any(line.startswith(start) for line in self.lines)

    def end(self) -> Service:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        assert self.service is not None
        return self.service

    def _run(self) -> None:
        with standby_signs(self._config, self.stop) as signs:
            holding = acquire_archive(self._config, self._root, self.stop, self.lines.append, signs)
        if holding is not None:
            self.service = Service(self._config, self._root, logger_into(self.lines), holding)
            self.service.run(self.stop)


@contextmanager
def machines(
    router: ZenohSettings, bucket: BucketServer, folder: Path, *names: str
) -> Iterator[list[Machine]]:
    with ExitStack() as stack:
        made = [Machine(name, router, bucket, folder / name) for name in names]
        for one in made:
            stack.callback(one.stop.set)
        yield made


def test_a_region_is_handed_over_with_all_that_was_known(
    router: ZenohSettings,
    session: zenoh.Session,
    bucket: BucketServer,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fleet = Fleet(session)
    sent = reports(0.15, 1, BATCHES)
    connect = ["--connect", router.connect[0]]
    with machines(router, bucket, tmp_path, "north-a", "north-b") as (one, two):
        one.start("ready: ")
        two.start("standby: north-a ")
        until(make_driver(fleet, sent), PATIENCE_S)
        assert main(["hand-over", EVERYWHERE, "--to", "north-b", *connect]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == f"north-a hands over: {EVERYWHERE}"
        assert lines[1].startswith(f"north-b serves {EVERYWHERE}; the handover took ")
        former = one.end()
        assert former.exit_code == 0
        until(lambda: two.has_said("ready: "), PATIENCE_S)
        assert two.service is not None
        engine = two.service.engine
        assert engine.alerts.count > 0
        expected = read_image(former.engine)
        found = read_image(engine)
        assert expected.keys() == found.keys()
        assert [name for name in expected if not found[name].equals(expected[name])] == []
        again = Fleet(session)  # the new owner recognises repeated batches
        until(make_driver(again, sent), PATIENCE_S)
        assert engine.counts.duplicates >= len(sent)
        config = tmp_path / "config.json"
        config.write_text(json.dumps({"zenoh": router.model_dump()}))
        assert main(["hand-over", EVERYWHERE, "--to", "north-b", "--config", str(config)]) == 0
        assert f"north-b already serves {EVERYWHERE}" in capsys.readouterr().out
        two.stop.set()
        assert two.end().exit_code == 0


def test_region_without_a_standby_is_not_handed_over(
    router: ZenohSettings, bucket: BucketServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["hand-over", EVERYWHERE, "--connect", router.connect[0], "--to"]
    assert main([*words, "north-b"]) == 2
    assert f"error: region: no service serves {EVERYWHERE}" in capsys.readouterr().err
    with machines(router, bucket, tmp_path, "north-a") as (one,):
        one.start("ready: ")
        assert main([*words, "north-b"]) == 2
        assert (
            "error: to: no 'north-b' stands by, not for */*/*; start it with --standby"
            in capsys.readouterr().err
        )
        assert not one.has_said("handing over: ")
        one.stop.set()
        one.end()


@pytest.mark.campaign
def test_lease_released_for_one_service_is_reserved_for_it_for_a_while(
    bucket: BucketServer,
) -> None:
    store = ObjectBucket(bucket.url, bucket.store, 5.0)
    lease_s = 3.0
    one, two, three = (Lease(name, store, name, lease_s) for name in ("one", "two", "three"))
    assert one._create_next(None, lambda: 0, threading.Event())
    one.release("two")
    stop = threading.Event()
    threading.Timer(lease_s / 3, stop.set).start()
    assert not three.wait(stop, print, lambda: 0, None)
    assert two.wait(threading.Event(), print, lambda: 0, None)
    assert two.former_holders == ("one",)
    two.release("one")
    # The release reserves the lease for "one" for some time. After that, any service may take it.
    assert three.wait(threading.Event(), print, lambda: 0, None)
    assert three.former_holders == ("one", "two")
