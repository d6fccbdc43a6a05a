"""Tests of the page in a real browser, with a real service. It must draw every cell in its class,
report alerts and missing services, and be usable by keyboard and on a phone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from fleet_service.archive.format import snapshots
from schemas import grid
from schemas.runtime import palette
from tests.browser import Opened, open_page
from tests.fleet_service.page import street
from tests.fleet_service.page.cell_colours import colour_of
from tests.fleet_service.page.conftest import Drive, RunningPage
from tests.structure import ROOT
from tests.waiting import until

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

PICTURES: Final = ROOT / ".page"
READY: Final = "body[data-ready]"
ICE, SNOW, WET, DRY, RATHER, RATHER_NOT, LITTLE, HOLLOW = range(8)
# JavaScript expression that is true when all ice is drawn. Before the first picture `kinds` is
# missing.
ICE_DRAWN: Final = f"document.body.dataset.kinds?.split(',')[0] == {street.count_known('ice')}"


def look(seen: Opened, name: str) -> None:
    """Store a screenshot of the page under the name `name`, so that a person can inspect it."""
    PICTURES.mkdir(exist_ok=True)
    seen.page.screenshot(path=PICTURES / f"{name}.png")


@contextmanager
def open_map(
    page: RunningPage, state: str = "", *, phone: bool = False, errors: bool = False
) -> Iterator[Opened]:
    """Open the page, and yield it when it is ready. At the end assert that the page requested
    nothing from another host and wrote nothing to the browser's console.
    """
    with open_page(page.address + state, phone=phone) as seen:
        seen.page.wait_for_selector(READY, state="attached")
        yield seen
        foreign = [
            url for url in seen.requests if not url.startswith((page.address, "blob:", "data:"))
        ]
        assert foreign == []
        assert errors or seen.errors == []


def data(seen: Opened, name: str) -> str:
    return str(seen.page.evaluate("name => document.body.dataset[name] ?? ''", name))


def kinds(seen: Opened) -> list[int]:
    """Return the number of map cells that the page has drawn, for each kind of record."""
    return [int(n) for n in data(seen, "kinds").split(",") if n] or [0] * 8


def near(seen: Opened, cell: int, zoom: float = 18.0) -> None:
    """Zoom the page's map in on a cell, until the page draws the cell's heading sectors
    separately.
    """
    latitude, longitude = (float(v) for v in grid.centre(cell))
    seen.page.evaluate(
        "async ([x, y, z]) => { const { view } = gripmap.map;"
        " const { goTo } = await import('/static/navigation.js');"
        " goTo(gripmap, x, y); view.go(view.x, view.y, z) }",
        [longitude, latitude, zoom],
    )


def waits(seen: Opened, script: str) -> None:
    """Wait until a JavaScript expression that is evaluated in the page is true."""
    # The page's content security policy does not allow Playwright to poll inside the page.
    until(lambda: seen.page.evaluate(script))


def cell_of(part: str, index: int = 1) -> int:
    return int(street.cells(street.PARTS[part])[index])


def read(seen: Opened, sector: int) -> dict[str, str]:
    """Return the texts that the page's panel shows for one heading sector of the selected cell, by
    the label of each text.
    """
    found: dict[str, str] = seen.page.evaluate(
        "s => Object.fromEntries([...document.querySelectorAll(`[data-sector='${s}'] dd`)]"
        ".map(one => [one.dataset.value, one.textContent]))",
        sector,
    )
    return found


def test_all_cells_are_drawn_in_their_class_and_bounds_are_hollow(
    page: RunningPage, drive: Drive
) -> None:
    drive("dry", "snow", "ice", "wet", "passed", "avenue")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 17.2)
        waits(seen, f"document.body.dataset.drawn === '{street.count_known()}'")
        found = kinds(seen)
        assert found[ICE] == street.count_known("ice")
        assert found[SNOW] + found[RATHER] == street.count_known("snow")
        assert found[HOLLOW] == street.count_known("passed")
        assert sum(found[WET : DRY + 1]) + found[RATHER_NOT] == street.count_known(
            "wet", "dry", "avenue"
        )
        look(seen, "near")
        ice = palette.FOUR[0]
        named = ",".join(str(int(ice[k : k + 2], 16)) for k in (1, 3, 5))
        painted: int = seen.page.evaluate(_POINTS, named)
        assert painted > 100
        near(seen, cell_of("passed", 3), 21)
        only = f"(all => all[{HOLLOW}] > 0 && all.slice(0, {HOLLOW}).every(n => n === '0'))"
        # The last picture shows all of these cells.
        waits(seen, f"{only}(document.body.dataset.kinds.split(','))")
        assert seen.page.evaluate(_COLOURED) == 0, "a bound has no colour"
        look(seen, "bounds")


_POINTS: Final = """colour => {
  const map = document.getElementById("map");
  const points = map.getContext("2d").getImageData(0, 0, map.width, map.height).data;
  let n = 0;
  for (let k = 0; k < points.length; k += 4)
    n += [points[k], points[k + 1], points[k + 2]].join() === colour;
  return n;
}"""
_COLOURED: Final = """() => {
  const map = document.getElementById("map");
  const points = map.getContext("2d").getImageData(0, 0, map.width, map.height).data;
  let n = 0;
  for (let k = 0; k < points.length; k += 4) {
    const point = [points[k], points[k + 1], points[k + 2]];
    n += Math.max(...point) - Math.min(...point) > 8;
  }
  return n;
}"""


def test_the_first_picture_that_is_painted_has_cells(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        seen.page.add_init_script(_PAINTED)
        seen.page.reload()
        seen.page.wait_for_selector(READY, state="attached")
        waits(seen, "painted.length > 0")
        assert int(seen.page.evaluate("painted[0]")) > 0


_PAINTED: Final = """
  globalThis.painted = [];
  document.addEventListener("DOMContentLoaded", () => new MutationObserver(
    () => painted.push(document.body.dataset.drawn)
  ).observe(document.body, { attributeFilter: ["data-drawn"] }));
"""


def test_ice_stays_visible_at_low_zoom(page: RunningPage, drive: Drive) -> None:
    drive()
    with open_map(page) as seen:
        for zoom, level in ((12.0, 18), (6.0, 14)):
            near(seen, cell_of("ice"), zoom)
            waits(
                seen,
                f"document.body.dataset.level === '{level}' && "
                "document.body.dataset.kinds?.split(',')[0] > 0",
            )
            waits(
                seen,
                f"[...gripmap.state.now.tiles.values()].every(one => one.block.level === {level})",
            )
        look(seen, "far")


def test_the_rule_of_colours_is_the_same_here_and_there(page: RunningPage) -> None:
    steps = range(10, 230, 9)
    triples = [
        (mu, max(mu - a, 0), mu + b) for mu in steps for a in (3, 30, 90) for b in (3, 30, 90)
    ]
    with open_map(page) as seen:
        page_kinds: list[int] = seen.page.evaluate(
            "async triples => { const { kindOf, setColours } = await import('/static/colours.js'); "
            "setColours(gripmap.settings); return triples.map(([m, l, u]) => kindOf(1, m, l, u)) }",
            triples,
        )
        hollow = seen.page.evaluate(
            "async () => { const { kindOf } = await import('/static/colours.js'); return kindOf(0, "
            "160, 150, 170) }"
        )
    names = [*palette.FOUR, *palette.TWO, palette.LITTLE]
    assert [names[k] for k in page_kinds] == [colour_of(*(v / 200 for v in one)) for one in triples]
    assert hollow == HOLLOW
    assert len(set(page_kinds)) == 7


def test_place_panel_shows_interval_basis_vehicles_and_safe_speed(
    page: RunningPage, drive: Drive
) -> None:
    drive("ice", "passed")
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, ICE_DRAWN)
        seen.page.locator("#map").click()
        waits(seen, "document.querySelectorAll('[data-value=observations]').length === 2")
        # The map may first show the reports of some of the cars only.
        waits(
            seen,
            f'[...document.querySelectorAll(\'[data-sector="{street.EAST}"] '
            "[data-value=observations]')]"
            f".some(one => one.textContent === '{len(street.CARS)}')",
        )
        panel = read(seen, street.EAST)
        assert panel["basis"] == "measured"
        assert panel["vehicles"] == str(len(street.CARS)) == panel["observations"]
        assert "km/h with 50 m of sight" in panel["speed"]
        alert = re.match(r"(\d+) vehicles found it slippery, (over )?\d+ % sure", panel["alert"])
        assert alert is not None, panel["alert"]
        assert 2 <= int(alert[1]) <= len(street.CARS), (
            "as many as had been heard when it was raised"
        )
        assert seen.page.locator(".chart .density").count() == 2
        look(seen, "place")
        near(seen, cell_of("passed"))
        waits(seen, f"gripmap.state.cells.at_place(...Object.values({_place('passed')})).length")
        seen.page.locator("#map").click()
        waits(
            seen,
            "document.querySelector('[data-value=basis]')?.textContent.startsWith('only passed')",
        )
        panel = read(seen, street.EAST)
        assert panel["speed"] == "unknown: no vehicle measured here"
        assert panel["grip"].startswith("at least 0.")
        assert "slippery" not in panel
        assert seen.page.locator(".chart .density").count() == 0
        seen.page.evaluate("gripmap.choose(0, 0); gripmap.panels.open('cell')")
        assert (
            seen.page.locator("#panel .nobody").inner_text()
            == "No vehicle was here: the grip is unknown."
        )


def _place(part: str) -> str:
    cell = cell_of(part)
    return json.dumps([cell >> 14, cell & 0x3FFF])


def test_page_receives_changes_and_shows_an_alert_with_its_reason(
    page: RunningPage, drive: Drive
) -> None:
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, "gripmap.live.state")
        drive("ice")
        waits(seen, "document.body.dataset.alerts === '1'")
        waits(seen, ICE_DRAWN)
        waits(seen, "document.getElementById('live').dataset.state === 'live'")
        seen.page.locator("#tab-alerts").click()
        text = seen.page.locator("[data-alert]").inner_text()
        assert re.search(r"Ice, eastbound and westbound, at [\d.]+° N", text)
        assert re.search(r"\d+ % sure that it is slippery", text)
        assert " vehicles" in text
        assert not seen.page.evaluate("gripmap.state.show.sound"), "off unless it was asked for"
        seen.page.evaluate("gripmap.map.view.go(.1, .1, 5)")
        seen.page.get_by_role("button", name="show on the map").click()
        waits(seen, ICE_DRAWN)
        look(seen, "alerts")


@pytest.mark.campaign
def test_region_of_a_missing_service_is_reported_and_not_empty(
    page: RunningPage, drive: Drive
) -> None:
    drive("ice")
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, "document.getElementById('live').dataset.state === 'live'")
        assert page.service is not None
        page.service.end()
        waits(seen, "!document.getElementById('away').hidden")
        waits(seen, "document.getElementById('live').dataset.state === 'late'")
        assert "No service for 1 region" in seen.page.locator("#away").inner_text()
        assert kinds(seen)[ICE] == street.count_known("ice")
        look(seen, "away")


@pytest.mark.campaign
def test_page_detects_a_silent_server_by_its_own_clock(page: RunningPage) -> None:
    with open_map(page) as seen:
        waits(seen, "gripmap.live.state")
        # Closing the source causes no error event.
        seen.page.evaluate("gripmap.live.source.close()")
        waits(seen, "document.getElementById('live').textContent.startsWith('○ last update')")


@pytest.mark.campaign
def test_slider_shows_a_past_cell_and_two_moments_side_by_side(
    page: RunningPage, drive: Drive
) -> None:
    drive("snow")
    until(lambda: list_snapshots(page.archive))
    before = list_snapshots(page.archive)[-1]
    drive("ice")
    until(lambda: list_snapshots(page.archive)[-1] > before + 1)
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, ICE_DRAWN)
        seen.page.evaluate("gripmap.timeline.load()")
        seen.page.evaluate(
            "at => { gripmap.timeline.put(at); return gripmap.timeline.chosen() }", before
        )
        waits(seen, f"document.body.dataset.at === '{before}'")
        assert kinds(seen)[ICE] == 0
        assert sum(kinds(seen)) == street.count_known("snow")
        assert seen.page.locator("#live").inner_text().startswith("▮▮ showing 20")
        seen.page.evaluate("gripmap.timeline.put(null); gripmap.timeline.chosen()")
        waits(seen, "document.body.dataset.at === 'now'")
        seen.page.locator("#compare").click()
        seen.page.evaluate("at => { gripmap.timeline.put(at); gripmap.timeline.chosen() }", before)
        waits(seen, f"document.body.dataset.at === '{before}'")
        waits(seen, "document.getElementById('moment-right').textContent === 'now'")
        assert seen.page.locator("#moment-left").inner_text().startswith("20")
        look(seen, "compare")


def list_snapshots(archive: Path) -> list[int]:
    """Return the times [s since 1970] of the archive's stored maps (snapshots), which the page must
    offer, in order.
    """
    return sorted(
        snapshots.time_of(path) // 10**9 for path in archive.glob(f"{snapshots.TABLE}/*/*.parquet")
    )


def test_clicked_or_dropped_route_shows_unknown_parts(
    page: RunningPage, drive: Drive, tmp_path: Path
) -> None:
    drive("ice", "wet")
    west, east = (
        grid.centre(street.cells(street.PARTS[name])[k]) for name, k in (("ice", 0), ("passed", 3))
    )
    points = "".join(
        f'<trkpt lat="{float(lat):.7f}" lon="{float(lon):.7f}"/>' for lat, lon in (west, east)
    )
    gpx = tmp_path / "way.gpx"
    gpx.write_text(
        f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'
    )
    with open_map(page) as seen:
        seen.page.locator("#tab-route").click()
        seen.page.locator("#gpx").set_input_files(gpx)
        waits(seen, "document.getElementById('route-share')")
        share = seen.page.locator("#route-share").inner_text()
        assert "% unknown" in share
        assert " 0 % unknown" not in share
        assert "km/h with 50 m of sight" in seen.page.locator("#route-worst").inner_text()
        assert seen.page.locator(".chart .unknown").count() >= 1
        look(seen, "route")
        seen.page.locator("#route-clear").click()
        near(seen, cell_of("ice"))
        for x in (300, 500):
            seen.page.locator("#map").click(position={"x": x, "y": 300})
        waits(seen, "document.getElementById('route-worst')")
        assert "its grip is unknown" in seen.page.locator("#route-worst").inner_text()


@pytest.mark.campaign
def test_shared_link_restores_the_whole_page_state(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 18.5)
        waits(seen, ICE_DRAWN)
        seen.page.locator("#map").click()
        seen.page.locator("#tab-legend").click()
        seen.page.locator("#show-bounds").click()
        seen.page.locator("#tab-share").click()
        link = seen.page.locator("#link").input_value()
    with open_map(page, link.removeprefix(page.address)) as again:
        waits(again, "gripmap.state.chosen")
        state: dict[str, Any] = again.page.evaluate(
            "({ x: gripmap.map.view.x, zoom: gripmap.map.view.zoom, tab: gripmap.state.tab,"
            " bounds: "
            "gripmap.state.show.bounds,"
            " cell: gripmap.state.chosen.tile * 16384 + gripmap.state.chosen.local })"
        )
        assert state["cell"] == cell_of("ice")
        assert (state["zoom"], state["tab"], state["bounds"]) == (18.5, "share", False)
        with again.page.expect_download() as waiting:
            again.page.locator("#geojson").click()
        features = json.loads(Path(waiting.value.path()).read_text())["features"]
        assert len(features) == street.count_known("ice")
        assert all(one["properties"]["basis"] == "measured" for one in features)
        with again.page.expect_download() as waiting:
            again.page.locator("#csv").click()
        assert (
            len(Path(waiting.value.path()).read_text().splitlines())
            == street.count_known("ice") + 1
        )


def test_downloaded_file_has_no_mu_for_a_lower_bound(page: RunningPage, drive: Drive) -> None:
    drive("passed")
    with open_map(page) as seen:
        near(seen, cell_of("passed", 3), 17)
        waits(
            seen,
            f"document.body.dataset.kinds?.split(',')[{HOLLOW}] == {street.count_known('passed')}",
        )
        seen.page.locator("#tab-share").click()
        with seen.page.expect_download() as waiting:
            seen.page.locator("#geojson").click()
        rows = [
            one["properties"]
            for one in json.loads(Path(waiting.value.path()).read_text())["features"]
        ]
        assert len(rows) == street.count_known("passed")
        assert all(row["mu"] is None and row["basis"] == "bound" for row in rows)


def test_keys_alone_are_enough(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        waits(seen, "document.body.dataset.alerts === '1'")
        for _ in range(20):
            seen.page.keyboard.press("Tab")
            if seen.page.evaluate("document.activeElement.id") == "map":
                break
        assert seen.page.evaluate("document.activeElement.id") == "map"
        seen.page.keyboard.press("a")
        waits(seen, ICE_DRAWN)
        for key in ("ArrowLeft", "ArrowRight", "+", "-", "Enter"):
            seen.page.keyboard.press(key)
        waits(seen, "document.querySelector('[data-value=basis]')?.textContent === 'measured'")
        seen.page.locator("#tab-cell").focus()
        seen.page.keyboard.press("ArrowRight")
        assert seen.page.evaluate("gripmap.state.tab") == "alerts"


def test_a_phone_shows_map_and_words_without_scrolling_sideways(
    page: RunningPage, drive: Drive
) -> None:
    drive()
    with open_map(page, phone=True) as seen:
        near(seen, cell_of("ice"), 17)
        waits(seen, "document.body.dataset.kinds?.split(',')[0] > 0")
        size = seen.page.evaluate(
            "[document.documentElement.scrollWidth, innerWidth, gripmap.map.view.height]"
        )
        assert size[0] <= size[1]
        assert size[2] > 200
        seen.page.locator("#map").tap()
        waits(seen, "document.querySelector('[data-value=basis]')")
        look(seen, "phone")
