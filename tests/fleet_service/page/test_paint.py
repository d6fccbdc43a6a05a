"""Tests of the drawn map in a real browser. When the map is zoomed out, each square stands for
several cells, and a white part in its middle shows the share of unknown cells. This part must be
visible in the smallest squares too. Neighbouring squares must touch without a gap, and a drawn
route must cover no cell. Before a service answers, the map must be hatched.
"""

from __future__ import annotations

from typing import Any, Final

import pytest

from schemas import grid
from schemas.config import ZenohSettings
from schemas.runtime import palette
from tests.browser import open_page
from tests.fleet_service.page import street
from tests.fleet_service.page.conftest import Drive, RunningPage, page_of
from tests.fleet_service.page.test_page import (
    _COLOURED,
    _POINTS,
    ICE,
    READY,
    cell_of,
    look,
    near,
    open_map,
    waits,
)

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

PLACES: Final = 12
# Draw a row of squares of known ground in two tiles. Return the number of points of each colour in
# the middle of the row.
_ROW: Final = """async ([side, first, unknown]) => {
  const { Pixels } = await import("/static/pixels.js");
  const { setColours, kindOf } = await import("/static/colours.js");
  setColours(gripmap.settings);
  const n = PLACES, all = value => new Uint8Array(n).fill(value);
  const rows = { count: n, basis: all(1), unknown: all(unknown), mu: all(160) };
  const column = Uint8Array.from({ length: n }, (_, k) => k), kind = all(kindOf(1, 160, 155, 165));
  const pixels = new Pixels();
  const view = { scale: side, left: x => x * side + first, top: y => y * side + 1 };
  pixels.begin(400, 40, 1, true);
  for (const west of [0, n]) {
    const tile = { rows, column, row: all(0), kind, side: 1, west, north: 0, steps: n };
    pixels.squares(view, tile, null, new Array(8).fill(0));
  }
  const begin = Math.round(first + 1e-4), end = Math.round(first + 2 * n * side + 1e-4);
  const high = Math.round(1 + side);
  const row = y => [...pixels.points.slice(400 * y + begin, 400 * y + end)];
  const white = y => row(y).filter(p => p === pixels.ground).length;
  const lines = Array.from({ length: high - 1 }, (_, k) => white(1 + k));
  return [lines[0], Math.max(...lines), lines.reduce((a, b) => a + b), (end - begin) * (high - 1)];
}""".replace("PLACES", str(PLACES))
_ALL: Final = """() => {
  const points = document.getElementById("map"), { width, height } = points;
  const bytes = points.getContext("2d").getImageData(0, 0, width, height).data;
  let n = 0;
  for (let k = 0; k < bytes.length; k += 4) n += bytes[k] + bytes[k + 1] + bytes[k + 2] < 660;
  return n;
}"""


def test_unknown_share_shows_in_the_smallest_square(page: RunningPage) -> None:
    with open_map(page) as seen:
        for side in (3.3, 4.0, 4.7, 5.6, 7.9, 12.2):
            for unknown in (1, 60, 127, 253):
                edge, most, white, whole = seen.page.evaluate(_ROW, [side, 1.3, unknown])
                assert edge == 0, "the colour is around"
                assert most >= 2 * PLACES, (side, unknown)
                assert white <= 0.7 * whole, (side, unknown)
            assert seen.page.evaluate(_ROW, [side, 1.3, 0])[2] == 0, "what is known has no hole"


def test_neighbours_meet_without_a_gap_wherever_they_lie(page: RunningPage) -> None:
    with open_map(page) as seen:
        for side in (3.25, 4.1, 7.75, 7.5, 10.0 / 3.0):
            for first in (0.5, 1.25, 2.0 + 1e-9, 0.5 - 1e-9):
                assert seen.page.evaluate(_ROW, [side, first, 0])[2] == 0, (side, first)


def test_a_guess_is_framed_by_a_thin_line_whatever_was_painted_before(
    page: RunningPage, drive: Drive
) -> None:
    """A cell whose values are estimated from its neighbours must have a thin dashed frame. The
    frame must also appear if the page draws the cell's tile again after a change.
    """
    drive("dry")
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        drive("ice")
        waits(
            seen, f"document.body.dataset.kinds?.split(',')[{ICE}] >= {street.count_known('ice')}"
        )
        assert seen.page.evaluate(
            "[...gripmap.state.now.tiles.values()].some(tile => tile.block.version > 1)"
        )
        seen.page.evaluate(
            "() => { globalThis.dashed = []; const real = "
            "CanvasRenderingContext2D.prototype.stroke;"
            " CanvasRenderingContext2D.prototype.stroke = function () {"
            " if (this.getLineDash().length) dashed.push(this.lineWidth); return real.apply(this, "
            "arguments); } }"
        )
        seen.page.locator("#tab-legend").click()
        seen.page.locator("#show-borrowed").click()
        waits(seen, "dashed.length > 10")
        assert set(seen.page.evaluate("dashed")) == {1}
        look(seen, "borrowed")


def test_drawn_route_covers_no_cell(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    ice = ",".join(str(int(palette.FOUR[0][k : k + 2], 16)) for k in (1, 3, 5))
    ends = [
        [float(v) for v in reversed(grid.centre(street.cells(street.PARTS["ice"])[k]))]
        for k in (0, 4)
    ]
    with open_map(page) as seen:
        for zoom in (16.0, 18.0):
            near(seen, cell_of("ice", 2), zoom)
            waits(
                seen,
                f"document.body.dataset.alerts === '1' && gripmap.map.view.zoom === {zoom} && "
                "!gripmap.map.frame",
            )
            before = seen.page.evaluate(_POINTS, ice)
            seen.page.evaluate(
                "async ends => { const { setRoute } = await import('/static/route.js'); "
                "await setRoute(gripmap, ends); gripmap.state.alerts = []; "
                "gripmap.map.drawNow() }",
                ends,
            )
            dots = 2 * 100  # points at the ends of the route
            assert seen.page.evaluate(_POINTS, ice) >= before - dots, zoom
            assert seen.page.evaluate(_COLOURED) > before
            look(seen, f"route_{zoom:g}")
            seen.page.evaluate("gripmap.state.route = []; gripmap.map.drawNow()")


def test_before_any_service_spoke_the_world_is_hatched_and_not_empty(bare: str) -> None:
    with open_page(bare) as seen:
        seen.page.wait_for_selector(READY, state="attached")
        waits(seen, "gripmap.live.state && !gripmap.map.frame")
        waits(seen, f"({_ALL})() > 10000")
        assert seen.page.locator("#live").inner_text() == "○ no update yet"
        seen.page.evaluate("gripmap.panels.refresh()")
        assert "No service answers, so nothing is known" in seen.page.locator("#panel").inner_text()
        assert not seen.page.locator("#play").is_visible(), "there is no past to play"


def test_alert_of_one_direction_is_not_shown_for_the_other(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        near(seen, cell_of("ice"))
        waits(seen, "document.body.dataset.alerts === '1'")
        waits(
            seen, f"document.body.dataset.kinds?.split(',')[{ICE}] == {street.count_known('ice')}"
        )
        seen.page.evaluate("gripmap.state.alerts[0].headings = ['west']")
        seen.page.locator("#map").click()
        waits(seen, "document.querySelectorAll('.heading').length === 2")
        found: dict[str, int] = seen.page.evaluate(
            "Object.fromEntries([...document.querySelectorAll('.heading')]"
            ".map(one => [one.dataset.sector, one.querySelectorAll('[data-value=alert]').length]))"
        )
        assert found == {str(street.EAST): 0, str(street.WEST): 1}


@pytest.mark.parametrize("width", [390, 1280, 3840])
def test_labels_are_next_to_their_elements_on_every_screen(
    router: ZenohSettings, width: int
) -> None:
    size: Any = {"width": width, "height": 900}
    with page_of(router) as address, open_page(address) as seen:
        seen.page.set_viewport_size(size)
        seen.page.wait_for_selector(READY, state="attached")
        seen.page.locator("#tab-legend").click()
        waits(seen, "document.querySelector('label.line')")
        beside = seen.page.evaluate(
            "[...document.querySelectorAll('label.line:has([type=checkbox])')].map(label => {"
            " const words = document.createRange(); words.selectNodeContents(label);"
            " const box = label.querySelector('input').getBoundingClientRect();"
            " return [...words.getClientRects()].at(-1).left >= box.right })"
        )
        assert len(beside) >= 2
        assert all(beside)
        tops: list[float] = seen.page.evaluate(
            "[...document.querySelectorAll('#tabs button')].map(one => one.offsetTop)"
        )
        assert len(tops) == 7
        assert len(set(tops)) == 1
