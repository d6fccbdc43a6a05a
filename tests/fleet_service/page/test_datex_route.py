"""Tests of the page's DATEX II publication (road traffic data in XML). It must be valid, follow the
alerts, and continue after a restart of the page.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from fleet_service.client.datex import Supplier
from fleet_service.client.datex_feed import DatexFile
from fleet_service.fusion import Fusion
from fleet_service.page.server import PageSettings
from fleet_service.serve.encode import arrow_stream, batch_of
from fleet_service.serve.view import view_cells
from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from schemas.thresholds import NS
from schemas.wire import Alert
from tests.fleet_service.client.test_datex import records, schema, text
from tests.fleet_service.examples import START, TILE, observations, value
from tests.fleet_service.page.conftest import page_of
from tests.fleet_service.page.test_server import ask
from tests.waiting import until

ROUTE = "/datex2/situation.xml"
OURS = Supplier("se", "GripMap test")
NOTHING = b"<nothing/>"
CELLS = [(TILE << 14) + k for k in range(3)]


@contextmanager
def made_up_service(session: zenoh.Session) -> Iterator[None]:
    """Act as a fleet service during the `with` block. Map queries for one cell of the region get an
    answer, so that the page regards the region as served.
    """
    fusion = Fusion(120.0)
    fusion.update(observations([0.0], [1], value([0.3])))
    payload = arrow_stream(batch_of(view_cells(fusion, np.arange(1), START), START))

    def answer(asked: zenoh.Query) -> None:
        with asked:
            asked.reply(keys.map_key(TILE), payload)

    queryable = session.declare_queryable(
        keys.map_key(TILE).rpartition("/")[0] + "/*", answer, complete=True
    )
    try:
        yield
    finally:
        queryable.undeclare()


def put(session: zenoh.Session, cells: list[int], *, raised: bool, at: int = START) -> None:
    for cell in cells:
        latitude, longitude = (float(v) for v in grid.centre(cell))
        warning = Alert(
            cell,
            0,
            raised,
            at,
            0.2,
            0.1,
            0.3,
            0.95,
            3,
            latitude,
            longitude,
            "P(mu < 0.4) = 0.95 > 0.9",
        )
        session.put(keys.alert_key(TILE), wire.encode_alert(warning))


def test_pulled_publication_follows_alerts_and_continues_after_restart(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    out = tmp_path / "situations.xml"
    with made_up_service(session):
        with page_of(router, datex=DatexFile(OURS, out, print)) as address:
            pulled = pull(address)
            until(lambda: pulled() != NOTHING)
            assert not records(pulled())
            put(session, CELLS, raised=True)
            until(lambda: records(pulled()))
            begun = pulled()
            (record,) = records(begun)
            assert record.get("version") == "1"
            until(lambda: out.read_bytes() == begun)
        with page_of(router, datex=DatexFile(OURS, out, print)) as address:
            pulled = pull(address)
            # No alert is active any more.
            until(lambda: text(records(pulled())[0], ".//com:overallEndTime"))
            put(session, CELLS, raised=True, at=START + NS)
            until(lambda: len(records(pulled())) == 2)
            put(session, CELLS, raised=False, at=START + 2 * NS)
            until(lambda: all(text(one, ".//com:overallEndTime") for one in records(pulled())))
            over = pulled()
    assert {record.get("id")} < {one.get("id") for one in records(over)}
    for document in (begun, over):
        schema().validate(document.decode())


def pull(address: str) -> Callable[[], bytes]:
    """Return a function that fetches the DATEX II publication of the page at `address`. The
    function returns NOTHING while the page has no publication yet.
    """

    def fetch_publication() -> bytes:
        status, headers, body = ask(address, ROUTE)
        assert status in (200, 503)
        assert status == 503 or headers["content-type"].startswith("application/xml")
        return body if status == 200 else NOTHING

    return fetch_publication


@pytest.mark.campaign
def test_situation_does_not_end_when_its_service_disappears(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    file = DatexFile(OURS, tmp_path / "situations.xml", print)
    with page_of(router, datex=file) as address:
        pulled = pull(address)
        with made_up_service(session):
            until(lambda: pulled() != NOTHING)  # the service was asked and has no active alert yet
            put(session, CELLS, raised=True)
            until(lambda: records(pulled()))
        until(lambda: not json.loads(ask(address, "/health")[2])["regions"][0]["served"])
        put(session, CELLS, raised=False)
        assert not text(records(pulled())[0], ".//com:overallEndTime")


def test_page_without_datex_explains_how_to_enable_it(bare: str) -> None:
    status, _, body = ask(bare, ROUTE)
    assert (status, b"--datex" in body) == (404, True)


def test_before_any_service_spoke_there_is_no_publication(
    router: ZenohSettings, tmp_path: Path
) -> None:
    with page_of(router, datex=DatexFile(OURS, tmp_path / "situations.xml", print)) as address:
        assert ask(address, ROUTE)[0] == 503
    assert PageSettings(router).datex is None
