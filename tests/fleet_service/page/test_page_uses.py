"""Tests of further uses of the page: replay of a night, sound, print, wall display, a dropped route
file, and screen readers.
"""

from __future__ import annotations

import dataclasses
import json
import re
import time
from pathlib import Path
from typing import Final

import numpy as np
import pytest
import zenoh

from schemas import grid, keys
from schemas.config import ZenohSettings
from schemas.tables import MAP_SCHEMA
from tests.browser import Opened, open_page
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import batch, send
from tests.fleet_service.page import scan, street
from tests.fleet_service.page.conftest import Drive, RunningPage, page_of
from tests.fleet_service.page.test_page import (
    ICE,
    ICE_DRAWN,
    cell_of,
    kinds,
    list_snapshots,
    look,
    near,
    open_map,
    waits,
)
from tests.waiting import until

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

WALL: Final = {"width": 3840, "height": 2160}
_HEARD: Final = """() => {
  globalThis.beeps = 0;
  const Real = AudioContext;
  globalThis.AudioContext = class extends Real {
    createOscillator() { globalThis.beeps++; return super.createOscillator(); }
  };
}"""
_DROP: Final = """text => {
  const carried = new DataTransfer();
  carried.items.add(new File([text], "way.gpx", { type: "application/gpx+xml" }));
  const drop = new DragEvent("drop", { dataTransfer: carried, bubbles: true, cancelable: true });
  document.getElementById("map").dispatchEvent(drop);
  return drop.defaultPrevented;
}"""

# Two requests for the same tiles, first of squares, then of cells; `slow` delays one answer.
_ZOOM: Final = """async slow => {
  const { Cells } = await import("/static/cells.js");
  const cells = new Cells(null), world = { west: 0, north: 0, east: 1, south: 1 }, real = fetch;
  await cells.list();
  globalThis.fetch = async asked => {
    const answer = await real(asked);
    if (asked.endsWith(`level=${slow}`)) await new Promise(resolve => setTimeout(resolve, 300));
    return answer;
  };
  await Promise.all([cells.show(world, 18), cells.show(world, 21)]);
  return Array.from(cells.tiles.values(), ({ block }) => block.level);
}"""


@pytest.mark.campaign
def test_a_night_is_played_moment_by_moment_and_ends_now(page: RunningPage, drive: Drive) -> None:
    drive("snow")
    until(lambda: list_snapshots(page.archive))
    first = list_snapshots(page.archive)[0]
    drive("ice")
    until(lambda: list_snapshots(page.archive)[-1] > first + 2)
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, ICE_DRAWN)
        seen.page.evaluate(
            "() => { globalThis.played = []; new MutationObserver(() => "
            "played.push([document.body.dataset.at, "
            "document.body.dataset.kinds])).observe(document.body, { attributeFilter: ['data-at'] "
            "}) }"
        )
        assert page.service is not None
        page.service.end()  # so that no new moment is added during the playback
        seen.page.evaluate("gripmap.timeline.load()")
        seen.page.locator("#play").click()
        assert seen.page.locator("#play").inner_text() != "play"
        # The playback shows a new moment every 0.7 s.
        until(lambda: seen.page.evaluate("document.body.dataset.at === 'now'"), 120.0)
        played: list[list[str]] = seen.page.evaluate("played")
        moments = [int(at) for at, _ in played[:-1]]
        assert moments == sorted(moments)
        assert len(set(moments)) >= 2
        assert abs(moments[0] - first) <= 10, (
            "a moment from memory may come before the first snapshot"
        )
        ice = [int(drawn.split(",")[ICE]) for _, drawn in played]
        assert (ice[0], ice[-1]) == (0, street.count_known("ice"))
        waits(seen, "gripmap.timeline.timer === null")


def test_new_alert_plays_a_sound_only_if_enabled(page: RunningPage, drive: Drive) -> None:
    with open_map(page) as seen:
        silent = seen.page.context.new_page()
        silent.goto(page.address)
        silent.wait_for_selector("body[data-ready]", state="attached")
        for one in (seen.page, silent):
            one.evaluate(_HEARD)
            # The lambda runs within this iteration, so the loop variable is safe (B023).
            until(lambda: one.evaluate("gripmap.state.hasAlerts"))  # noqa: B023
        seen.page.locator("#tab-alerts").click()
        assert not seen.page.locator("#sound").is_checked()
        seen.page.locator("#sound").check()
        assert seen.page.evaluate("beeps") == 1, "who asks for it hears how it will be"
        drive("ice")
        waits(seen, "document.body.dataset.alerts === '1'")
        assert seen.page.evaluate("beeps") == 2
        until(lambda: silent.evaluate("document.body.dataset.alerts === '1'"))
        assert silent.evaluate("beeps") == 0


def test_printed_page_has_map_and_text_but_no_controls(page: RunningPage, drive: Drive) -> None:
    drive("ice", "dry")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 17)
        waits(seen, ICE_DRAWN)
        seen.page.emulate_media(media="print")
        seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
        assert re.fullmatch(
            r"as of \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC.*", seen.page.locator("#moment").inner_text()
        )
        assert "as of 20" in seen.page.locator("#paper h2").inner_text()
        assert seen.page.locator("#paper .ladder li").count() == 8
        for selector in ("#tabs", "#controls", "#play", "#slider", "#panel button", "#searching"):
            assert not any(one.is_visible() for one in seen.page.locator(selector).all()), selector
        for selector in ("#map", "#panel", "#scale", "#moment", "#paper"):
            assert seen.page.locator(selector).is_visible(), selector
        panel = seen.page.evaluate(
            "(p => [p.scrollHeight, p.clientHeight])(document.getElementById('panel'))"
        )
        assert panel[0] <= panel[1] + 1, "no word is cut off"
        assert seen.page.pdf()[:5] == b"%PDF-"
        look(seen, "print")
        seen.page.evaluate("dispatchEvent(new Event('afterprint'))")
        assert seen.page.locator("#moment").inner_text() == "now"


def test_a_dropped_gpx_is_a_route(page: RunningPage, drive: Drive) -> None:
    drive("ice", "wet")
    west, east = (
        grid.centre(street.cells(street.PARTS[name])[k]) for name, k in (("ice", 0), ("passed", 3))
    )
    points = "".join(
        f'<rtept lat="{float(lat):.7f}" lon="{float(lon):.7f}"/>' for lat, lon in (west, east)
    )
    with open_map(page) as seen:
        gpx = f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><rte>{points}</rte></gpx>'
        assert seen.page.evaluate(_DROP, gpx), "the browser does not open it instead"
        waits(seen, "document.getElementById('route-share')")
        assert seen.page.evaluate("gripmap.state.tab") == "route"
        assert "km/h with 50 m of sight" in seen.page.locator("#route-worst").inner_text()


def test_on_a_wall_screen_everything_is_larger_and_the_map_fills_it(
    page: RunningPage, drive: Drive
) -> None:
    drive()
    with open_map(page) as seen:
        seen.page.set_viewport_size(WALL)  # type: ignore[arg-type]
        near(seen, cell_of("ice"), 18.5)
        waits(seen, ICE_DRAWN)
        waits(seen, f"document.getElementById('map').width > {WALL['width'] // 2}")
        size = seen.page.evaluate(
            "[document.documentElement.scrollWidth, document.documentElement.scrollHeight, "
            "gripmap.map.view.width,"
            " gripmap.map.view.height, parseFloat(getComputedStyle(document.body).fontSize)]"
        )
        assert size[0] <= WALL["width"]
        assert size[1] <= WALL["height"]
        assert size[2] > 0.75 * WALL["width"]
        assert size[3] > 0.85 * WALL["height"]
        assert size[4] >= 20
        assert sum(kinds(seen)) > 0
        look(seen, "wall")


@pytest.mark.parametrize("phone", [False, True], ids=["desk", "phone"])
def test_axe_finds_nothing_serious_in_any_panel(
    page: RunningPage, drive: Drive, phone: bool
) -> None:
    drive("ice", "passed", "dry")
    with open_map(page, phone=phone) as seen:
        near(seen, cell_of("ice"))
        waits(seen, "document.body.dataset.alerts === '1'")
        _choose(seen, cell_of("ice"))
        found = scan.findings(seen)
        if found is None:
            pytest.skip(scan.MISSING)
        assert found == []


def test_axe_would_see_a_button_without_a_name(page: RunningPage) -> None:
    with open_map(page) as seen:
        seen.page.evaluate(
            "document.getElementById('controls').append(document.createElement('button'))"
        )
        found = scan.findings(seen, ("legend",))
        if found is None:
            pytest.skip(scan.MISSING)
        assert any("button-name" in one for one in found)


def _choose(seen: Opened, cell: int) -> None:
    seen.page.evaluate(
        "([tile, local]) => gripmap.choose(tile, local)", [cell >> 14, cell & 0x3FFF]
    )


def test_map_of_two_continents_opens_on_one_of_them(
    page: RunningPage, drive: Drive, session: zenoh.Session
) -> None:
    """A map with cells on two continents must open on one of them, so that cells are visible at
    once. The page must list the other area.
    """
    drive("ice", "dry")
    cell = grid.cell_of(np.array([37.77]), np.array([-122.42]))
    region = int(grid.region_of(cell)[0])
    far = batch(
        "car-far",
        1,
        time.time_ns(),
        [0.8],
        latitude=np.array([37.77]),
        longitude=np.array([-122.42]),
        cell=cell,
    )
    far = dataclasses.replace(far, region=region)
    assert page.service is not None
    before = page.service.service.engine.counts.observations
    send(session, far, keys.observation_key(region, "car-far"))
    until(lambda: page.service and page.service.service.engine.counts.observations > before)
    with open_map(page) as seen:
        waits(seen, "document.querySelectorAll('#panel .area').length === 2")
        assert seen.page.evaluate("gripmap.map.view.zoom") > 14
        assert sum(kinds(seen)) == street.count_known("ice", "dry")
        seen.page.locator("#panel .area").nth(1).click()
        waits(seen, "Math.abs(gripmap.map.view.x * 360 - 180 + 122.42) < .1")


def test_page_opened_on_an_empty_map_shows_the_first_cells_large(
    page: RunningPage, drive: Drive
) -> None:
    with open_map(page) as seen:
        waits(seen, "document.getElementById('card').dataset.state === 'empty'")
        assert seen.page.evaluate("gripmap.map.view.zoom") < 5
        drive("ice", "dry")
        waits(seen, f"document.body.dataset.drawn === '{street.count_known('ice', 'dry')}'")
        assert seen.page.evaluate("gripmap.map.view.zoom") > 14


def test_page_exports_triangles_with_columns_of_the_service(
    page: RunningPage, drive: Drive
) -> None:
    drive("ice")
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, ICE_DRAWN)
        seen.page.locator("#tab-share").click()
        with seen.page.expect_download() as waiting:
            seen.page.locator("#geojson").click()
        features = json.loads(Path(waiting.value.path()).read_text())["features"]
    rings = [tuple(map(tuple, one["geometry"]["coordinates"][0])) for one in features]
    assert all(len(ring) == 4 for ring in rings)
    assert len(set(rings)) == len(features) == street.count_known("ice")
    columns = set(features[0]["properties"])
    assert {"cell", "sector", "mu", "mu_lower", "mu_upper", "p_slippery", "basis"} <= columns
    assert columns - {field.name for field in MAP_SCHEMA} == {"heading", "zoom", "unknown_share"}


def test_page_starts_before_the_archive_of_its_service(
    router: ZenohSettings, tmp_path: Path
) -> None:
    archive = tmp_path / "archive"
    with page_of(router, archive=archive) as address, open_page(address) as seen:
        seen.page.wait_for_selector("body[data-ready]", state="attached")
        assert not archive.exists()
        with running(router, archive):
            waits(seen, "document.getElementById('card').dataset.state === 'empty'")


def test_unvisited_place_has_words_without_a_bar(page: RunningPage) -> None:
    with open_map(page) as seen:
        seen.page.evaluate("gripmap.choose(0, 0); gripmap.panels.open('cell')")
        waits(seen, "document.querySelector('#panel .nobody')")
        ground = seen.page.evaluate(
            "getComputedStyle(document.querySelector('#panel .nobody')).backgroundColor"
        )
        assert ground == "rgba(0, 0, 0, 0)"


def test_whole_map_twice_is_the_same_view(page: RunningPage, drive: Drive) -> None:
    drive()
    with open_map(page) as seen:
        seen.page.evaluate("for (let k = 0; k < 4; k++) gripmap.map.view.turn(.5)")
        view = "[gripmap.map.view.zoom, gripmap.map.view.x, gripmap.map.view.y]"
        views = seen.page.evaluate(
            "async () => { const { showAll } = await import('/static/navigation.js'); "
            # The view also depends on the size of the map and on the cells that are loaded.
            "const given = () => JSON.stringify([gripmap.map.view.width, gripmap.map.view.height, "
            "gripmap.map.view.covered, gripmap.state.cells.extent]); "
            "for (;;) { const before = given(); "
            f"await showAll(gripmap); const one = {view}; "
            f"await showAll(gripmap); const two = {view}; "
            "if (given() === before) return [one, two]; } }"
        )
        assert views[0] == pytest.approx(views[1], abs=1e-9)


@pytest.mark.parametrize("slow", [18, grid.CELL_ZOOM])
def test_zooming_during_a_request_loads_the_level_of_the_last_view(
    page: RunningPage, drive: Drive, slow: int
) -> None:
    drive()
    with open_map(page) as seen:
        levels = seen.page.evaluate(_ZOOM, slow)
        assert levels
        assert set(levels) == {grid.CELL_ZOOM}
