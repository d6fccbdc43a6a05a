"""Tests of the map as OGC API Features: GDAL's own client can open it, answers contain the right
cells, and wrong requests are refused with the reason.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest

from fleet_service.page.features import CONFORMANCE
from schemas import grid
from tests.fleet_service.page import street
from tests.fleet_service.page.conftest import Drive, RunningPage
from tests.fleet_service.page.test_server import ask
from tests.waiting import until

ITEMS = "/collections/grip/items"
# Each reader runs in a process of its own. GDAL blocks the interpreter while it waits for the page,
# which this process serves.
READERS = {
    "GDAL": "import pyogrio; found = pyogrio.read_dataframe('OAPIF:{address}', layer='grip')",
    "geopandas": (
        "import geopandas; "
        "found = geopandas.read_file('{address}collections/grip/items?limit=10000')"
    ),
}


def opened_by(reader: str, address: str, folder: Path) -> Any:  # noqa: ANN401 geopandas lacks types
    """Return the map's features as the program `reader` reads them from the page at `address`."""
    out = folder / f"{reader}.parquet"
    script = f"{READERS[reader].format(address=address)}; found.to_parquet({str(out)!r})"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
    return geopandas.read_parquet(out)


def fetch_document(page: RunningPage, path: str) -> dict[str, Any]:
    """Return the JSON document at the path `path` of the page; fail if the page does not have
    it.
    """
    status, headers, body = ask(page.address, path)
    assert status == 200, body
    assert "json" in headers["content-type"]
    found: dict[str, Any] = json.loads(body)
    return found


def drive_parts(page: RunningPage, drive: Drive, *parts: str) -> None:
    """Let cars drive over parts of the street, and wait until the page shows these parts."""
    before = count(page)
    drive(*parts)
    until(lambda: count(page) >= before + street.count_known(*parts))


def count(page: RunningPage) -> int:
    """Return the number of features (map cells with heading) that the page offers. Return 0 while
    the page knows no service.
    """
    status, _, body = ask(page.address, ITEMS)
    assert status in (200, 503), body
    return int(json.loads(body)["numberReturned"]) if status == 200 else 0


@pytest.mark.parametrize("reader", READERS)
def test_readers_of_others_open_it_and_see_bounds_without_a_value(
    page: RunningPage, drive: Drive, reader: str, tmp_path: Path
) -> None:
    drive_parts(page, drive, "passed", "ice")
    found = opened_by(reader, page.address, tmp_path)
    assert len(found) == street.count_known("passed", "ice")
    assert found.crs.to_epsg() == 4326
    measured = found[found["basis"] == "measured"]
    bound = found[found["basis"] == "bound"]
    assert (len(measured), len(bound)) == (street.count_known("ice"), street.count_known("passed"))
    assert bound["mu"].isna().all()
    assert measured["mu"].astype(float).between(0.1, 0.25).all()
    assert measured.geometry.is_valid.all()
    south, north = (grid.bounds(street.cells(street.PARTS["ice"]))[k] for k in (1, 3))
    assert measured.total_bounds[1] == pytest.approx(south.min())
    assert measured.total_bounds[3] == pytest.approx(north.max())


def test_mu_is_a_number_column_even_if_all_cells_are_bounds(
    page: RunningPage, drive: Drive, tmp_path: Path
) -> None:
    drive_parts(page, drive, "passed")
    found = opened_by("GDAL", page.address, tmp_path)
    assert found["mu"].dtype == np.float64
    assert found["vehicles"].dtype.kind == "i"


def test_pages_of_an_answer_are_complete_without_duplicates(
    page: RunningPage, drive: Drive
) -> None:
    drive_parts(page, drive, "ice", "wet")
    found = []
    path = f"{ITEMS}?limit=7"
    pages = 0
    while path:
        answer = fetch_document(page, path)
        assert answer["numberReturned"] == len(answer["features"]) <= 7
        found += [one["id"] for one in answer["features"]]
        path = next(
            (link["href"] for link in answer["links"] if link["rel"] == "next"), ""
        ).removeprefix(page.address[:-1])
        pages += 1
    assert pages == -(-street.count_known("ice", "wet") // 7)
    assert len(set(found)) == len(found) == street.count_known("ice", "wet")
    one = fetch_document(page, f"{ITEMS}/{found[3]}")
    assert one["id"] == found[3]
    assert one["properties"]["vehicles"] == len(street.CARS)


def test_bbox_returns_every_cell_that_touches_it(page: RunningPage, drive: Drive) -> None:
    drive_parts(page, drive, "ice", "avenue")
    west, south, east, north = (
        float(v) for v in grid.bounds(int(street.cells(street.PARTS["ice"])[2]))
    )
    inside = fetch_document(
        page, f"{ITEMS}?bbox={west + 1e-7},{south + 1e-7},{east - 1e-7},{north - 1e-7}"
    )
    assert {one["properties"]["cell"] for one in inside["features"]} == {
        int(street.cells(street.PARTS["ice"])[2])
    }
    with_heights = f"{west + 1e-7},{south + 1e-7},-10,{east - 1e-7},{north - 1e-7},10"
    again = fetch_document(page, f"{ITEMS}?bbox={with_heights}")
    assert again["features"] == inside["features"]
    assert (
        fetch_document(page, f"{ITEMS}?bbox={west + 9},{south},{east + 9},{north}")["features"]
        == []
    )


def test_a_box_across_the_180_degree_meridian_has_both_sides(
    page: RunningPage, drive: Drive
) -> None:
    drive_parts(page, drive, "ice", "avenue")
    chosen = int(street.cells(street.PARTS["ice"])[2])
    west, south, east, north = (float(v) for v in grid.bounds(chosen))

    def fetch_cells(box: str, more: str = "") -> set[int]:
        found = fetch_document(page, f"{ITEMS}?limit=10000&bbox={box}{more}")["features"]
        return {one["properties"]["cell"] for one in found}

    assert fetch_cells(f"{west + 1e-7},{south + 1e-7},-179,{north - 1e-7}") >= {chosen}
    assert fetch_cells(f"{east + 9},-80,-179,80") == set()
    everything = fetch_cells("-180,-80,180,80")
    (_, _, easts, _) = grid.bounds(np.array(sorted(everything)))
    elsewhere = {cell for cell, one in zip(sorted(everything), easts, strict=True) if one != east}
    both_sides = f"{east + 1e-9},-80,{west - 1e-9},80"
    assert fetch_cells(both_sides) == elsewhere
    then = f"&datetime={_text(time.time())}"
    assert fetch_cells(both_sides, then) == elsewhere


def test_time_gives_the_map_then_and_an_interval_its_observations(
    page: RunningPage, drive: Drive
) -> None:
    drive_parts(page, drive, "ice")
    time.time_ns()
    now = _text(time.time())
    later = _text(time.time() + 3600)
    drive_parts(page, drive, "wet")
    everything = fetch_document(page, ITEMS)["features"]
    assert len(fetch_document(page, f"{ITEMS}?datetime=../..")["features"]) == len(everything)
    assert len(fetch_document(page, f"{ITEMS}?datetime={later}")["features"]) == len(everything)
    newest = {one["properties"]["last_time"] for one in everything}
    middle = sorted(newest)[len(newest) // 2]
    since = fetch_document(page, f"{ITEMS}?datetime={middle}/..")["features"]
    assert {one["properties"]["last_time"] for one in since} == {t for t in newest if t >= middle}
    then = {one["id"] for one in fetch_document(page, f"{ITEMS}?datetime={now}")["features"]}
    assert then < {one["id"] for one in everything}


def _text(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%dT%H:%M:%S.%fZ}"


def test_programs_get_the_landing_page_and_people_the_map(page: RunningPage) -> None:
    assert b"<html" in ask(page.address, "/", Accept="text/html,application/json;q=.9")[2]
    assert b"<html" in ask(page.address, "/")[2]
    found = json.loads(ask(page.address, "/", Accept="application/json")[2])
    assert {"service-desc", "conformance", "data", "self"} <= {
        link["rel"] for link in found["links"]
    }
    for link in found["links"]:
        assert ask(page.address, link["href"].removeprefix(page.address[:-1]))[0] == 200
    assert fetch_document(page, "/conformance")["conformsTo"] == list(CONFORMANCE)
    (one,) = fetch_document(page, "/collections")["collections"]
    assert one["id"] == fetch_document(page, "/collections/grip")["id"] == "grip"
    paths = fetch_document(page, "/api")["paths"]
    assert set(paths) >= {
        "/",
        "/conformance",
        "/collections",
        "/collections/grip",
        ITEMS,
        f"{ITEMS}/{{featureId}}",
    }


@pytest.mark.parametrize(
    "asked",
    [
        "?bbox=1,2",
        "?bbox=1,2,x,3,4",
        "?bbox=9,2,9,3",
        "?bbox=9,2,1,x",
        "?bbox=190,2,1,3",
        "?limit=0",
        "?limit=x",
        "?datetime=yesterday",
        "?datetime=2026-01-02T00:00Z/2026-01-01T00:00Z",
        "?colour=red",
        "?after=7",
        "/x",
        "/1-9",
    ],
)
def test_invalid_request_is_answered_with_problem_and_fix(bare: str, asked: str) -> None:
    status, _, body = ask(bare, ITEMS + asked)
    assert status == 400
    assert b"; " in body


def test_no_service_is_no_empty_map(bare: str) -> None:
    # The module's page may still receive the service of an earlier test.
    until(lambda: ask(bare, ITEMS)[0] == 503)
    assert ask(bare, ITEMS)[2].startswith(b"no service")


def test_no_visit_is_no_feature(page: RunningPage, drive: Drive) -> None:
    drive_parts(page, drive, "ice")
    nobody = int(street.cells(street.PARTS["dry"])[0])
    assert ask(page.address, f"{ITEMS}/{nobody}-0")[0] == 404
