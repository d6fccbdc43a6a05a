"""Tests of roads drawn as ribbons (coloured bands along the road) in a real browser. Clicks, alerts
and the overview must show the same values as the ribbons.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from fleet_service.page.roads import Line, RoadMap
from schemas import grid
from schemas.config import ZenohSettings
from tests.fleet_service.conftest import running
from tests.fleet_service.page import street
from tests.fleet_service.page.conftest import Drive, RunningPage, page_of
from tests.fleet_service.page.test_page import ICE, cell_of, look, near, open_map, waits

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

# Distance in cells between reported positions and the map's road, like the error of a receiver.
ASIDE: Final = 1
STREET: Final = "Main Street"
_DRAWN: Final = "document.body.dataset.kinds?.split(',')[{kind}] == {count}"
# Screen position of the middle of a ribbon of the given kind on an eastward lane.
_RIBBON: Final = """kind => {
  const { state: { roads }, map: { view } } = gripmap;
  for (const lane of roads.lanes) {
    const i = lane.kind.indexOf(kind);
    if (i < 0 || lane.x[i + 1] <= lane.x[i]) continue;
    const off = view.width ? gripmap.map.asRoads : 0;
    const x = (lane.x[i] + lane.x[i + 1]) / 2, y = (lane.y[i] + lane.y[i + 1]) / 2;
    return [view.left(x), view.top(y), off];
  }
}"""
_UNDER: Final = """kind => {
  const { roads, alerts } = gripmap.state, found = alerts.flatMap(alert => roads.under(alert));
  return roads.lanes.flatMap(lane => [...lane.kind.keys()].filter(i => lane.kind[i] === kind)
    .map(i => found.some(one => one.lane === lane && one.first - 2 <= i && i <= one.end + 1)));
}"""


def road(name: str, part: str, aside: int) -> Line:
    """Return a road line along the named part of the test street, `aside` cells north of the cells
    that vehicles report.
    """
    x, y = (v.astype(np.int64) for v in grid.deinterleave(street.cells(street.PARTS[part])))
    ends = grid.interleave(
        np.array([x.min() - 20, x.max() + 20], np.int64),
        np.array([y.min(), y.max()], np.int64) - aside,
    )
    latitude, longitude = grid.centre(ends)
    points = np.stack([longitude, latitude], axis=1).tolist()
    return Line(name, points, 3)


@pytest.fixture
def page(router: ZenohSettings, tmp_path: Path) -> Iterator[RunningPage]:
    """Yield a page with a road map. Each road of this map lies ASIDE cells north of the cells that
    vehicles report.
    """
    archive = tmp_path / "archive"
    roads = RoadMap([road(STREET, "ice", ASIDE)], [("Testby", 11.97, 57.7)])
    with (
        running(router, archive, snapshot_s=1.0) as service,
        page_of(router, archive=archive, roads=roads) as address,
    ):
        yield RunningPage(address, service, archive)


def test_click_on_a_ribbon_reads_the_record_drawn_there(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 18.6)
        waits(seen, _DRAWN.format(kind=ICE, count=street.count_known("ice")))
        x, y, as_roads = seen.page.evaluate(_RIBBON, ICE)
        assert as_roads
        seen.page.locator("#map").click(position={"x": x, "y": y + 6})
        waits(seen, "document.querySelector('[data-value=basis]')")
        first = seen.page.locator(".heading").first
        assert first.locator("h3").first.inner_text() == "Ice, heading east"
        assert seen.page.locator("#panel h2").first.inner_text() == STREET


def test_alert_outlines_the_ribbons_of_its_lanes(page: RunningPage, drive: Drive) -> None:
    drive("ice", "dry")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 18)
        waits(seen, "document.body.dataset.alerts === '1'")
        waits(seen, _DRAWN.format(kind=ICE, count=street.count_known("ice")))
        under: list[bool] = seen.page.evaluate(_UNDER, ICE)
        assert len(under) >= 4
        assert all(under)
        look(seen, "ribbons")


def test_overview_names_slippery_stretches_and_the_unknown_share(
    page: RunningPage, drive: Drive
) -> None:
    drive("snow", "ice", "passed", "dry")
    with open_map(page) as seen:
        near(seen, cell_of("ice"), 17.5)
        waits(seen, _DRAWN.format(kind=ICE, count=street.count_known("ice")))
        waits(seen, "document.querySelectorAll('[data-share]').length >= 3")
        shares: dict[str, str] = seen.page.evaluate(
            "Object.fromEntries([...document.querySelectorAll('[data-share]')]"
            ".map(one => [one.dataset.share, one.textContent]))"
        )
        percent = {name: int(text.split()[0]) for name, text in shares.items()}
        assert 98 <= sum(percent.values()) <= 102
        assert percent["unknown"] > 0, "the passed part"
        assert percent["never"] > 0, "the ends of the road"
        seen.page.evaluate("gripmap.state.alerts = []; gripmap.panels.refresh()")
        waits(seen, "document.querySelectorAll('.stretch').length >= 2")
        words = seen.page.locator(".stretch").first.inner_text()
        assert re.search(
            rf"^Ice on {STREET} (east|west)bound\n"
            r"\d+ m slippery, at worst ice; up to \d\d % sure; 6 veh",
            words,
        )
        look(seen, "overview")
        seen.page.locator(".stretch").first.click()
        waits(seen, "gripmap.state.tab === 'cell' && document.querySelector('[data-value=basis]')")
        assert seen.page.locator(".heading h3").first.inner_text().startswith("Ice")


def test_time_bar_and_key_cover_no_cell_of_the_whole_map(page: RunningPage, drive: Drive) -> None:
    drive()
    with open_map(page) as seen:
        waits(seen, "document.body.dataset.alerts === '1'")
        seen.page.locator("#controls button").last.click()
        waits(seen, "!gripmap.map.frame")
        found: list[Any] = seen.page.evaluate(
            "(() => { const { map: { view }, state } = gripmap;"
            " const { south, east } = state.now.extent;"
            " return [view.top(south), document.getElementById('foot').offsetTop, view.left(east),"
            " document.getElementById('controls').offsetLeft] })()"
        )
        assert found[0] <= found[1]
        assert found[2] <= found[3]


def test_paper_takes_the_whole_picture_of_the_screen(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        size = "(map => [map.width, map.height])(document.getElementById('map'))"
        before = seen.page.evaluate(size)
        seen.page.emulate_media(media="print")
        seen.page.evaluate("gripmap.map.resize()")
        assert seen.page.evaluate(size) == before
        fit = "getComputedStyle(document.getElementById('map')).objectFit"
        assert seen.page.evaluate(fit) == "contain", "neither cut nor stretched"
        orders = "getComputedStyle(document.querySelector('header')).order"
        assert seen.page.evaluate(orders) == "-1", "the title comes first"
