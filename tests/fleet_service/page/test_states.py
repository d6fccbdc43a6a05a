"""Tests of the live page in a real browser, in each of its states (such as "no service answers"):
the page must name the state in words. A picture of each state is stored in `.page/states`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pytest
from PIL import Image

from schemas.config import ZenohSettings
from tests.browser import Opened, open_page
from tests.fleet_service.conftest import running
from tests.fleet_service.page.conftest import Drive, RunningPage, page_of
from tests.fleet_service.page.test_page import (
    ICE_DRAWN,
    PICTURES,
    READY,
    cell_of,
    near,
    open_map,
    waits,
)

if TYPE_CHECKING:
    from playwright.sync_api import Route

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

FOLDER: Final = PICTURES / "states"
LAPTOP: Final[Any] = {"width": 1366, "height": 768}


# Number of buttons when the page draws its first picture.
_FIRST_PICTURE: Final = """document.addEventListener("DOMContentLoaded", () => new MutationObserver(
  () => { globalThis.buttonsBefore ??= document.getElementById("controls").childElementCount; }
).observe(document.body, { attributeFilter: ["data-drawn"] }))"""


def keep_picture(seen: Opened, name: str) -> Path:
    """Store a picture of the page under the name of the page's present state, and return the
    picture's path.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{name}.png"
    seen.page.screenshot(path=path)
    return path


def card(seen: Opened, state: str) -> str:
    """Wait until the page shows the card (message box) of the named state, such as "no service".
    Return the card's text.
    """
    waits(seen, f"document.getElementById('card').dataset.state === '{state}'")
    assert seen.page.locator("#card").is_visible()
    return seen.page.locator("#card").inner_text()


class HeldRequests:
    """A page's requests that match a URL pattern, held back until they are released. Later requests
    pass at once, so that none of them is held for ever.
    """

    def __init__(self, seen: Opened, pattern: str) -> None:
        self._waiting: list[Route] = []
        self._released = False
        seen.page.route(pattern, self._hold_route)

    def _hold_route(self, route: Route) -> None:
        if self._released:
            route.continue_()
        else:
            self._waiting.append(route)

    def release_all(self) -> None:
        """Let all requests pass, those that wait and those that will come."""
        self._released = True
        for route in self._waiting:
            route.continue_()


def show_ice(seen: Opened, zoom: float = 17.2) -> None:
    """Show the part of the test street with ice, and wait until the page has drawn it."""
    seen.page.set_viewport_size(LAPTOP)
    near(seen, cell_of("ice"), zoom)
    waits(seen, ICE_DRAWN)


def test_empty_map_states_that_no_vehicle_reported_and_what_to_do(page: RunningPage) -> None:
    with open_map(page) as seen:
        seen.page.set_viewport_size(LAPTOP)
        assert "No vehicle has reported yet" in card(seen, "empty")
        assert "edge-agent fleet" in seen.page.locator("#card code").inner_text()
        waits(
            seen, "document.getElementById('panel').innerText.includes('No vehicle has reported')"
        )
        assert "No earlier map yet" in seen.page.locator("#timeline").inner_text()
        keep_picture(seen, "empty")


def test_map_without_a_service_states_it_and_is_hatched(bare: str) -> None:
    with open_page(bare) as seen:
        seen.page.wait_for_selector(READY, state="attached")
        assert "No fleet service answers" in card(seen, "no_service")
        assert seen.page.evaluate("gripmap.state.away.length") > 0
        keep_picture(seen, "no-service")


def test_slow_map_shows_that_it_loads(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_page("about:blank") as seen:
        seen.page.set_viewport_size(LAPTOP)
        held = HeldRequests(seen, "**/blocks*")
        seen.page.goto(page.address)
        assert "Loading the map" in card(seen, "loading")
        assert not seen.page.locator("#slider").is_visible()
        assert "as vehicles report" not in seen.page.locator("#panel").inner_text()
        keep_picture(seen, "loading")
        held.release_all()
        seen.page.wait_for_selector(READY, state="attached")
        waits(seen, "document.getElementById('card').hidden")


def test_link_is_drawn_before_there_are_buttons(page: RunningPage, drive: Drive) -> None:
    """A page opened by a link must paint the linked map before it creates its buttons. If the map's
    cells arrive late, the page must create the buttons without waiting for them.
    """
    drive("ice")
    with open_map(page) as seen:
        show_ice(seen)
        link: str = seen.page.evaluate(
            "new Promise(done => setTimeout(() => done(location.href), 300))"
        )
    with open_page("about:blank") as seen:
        seen.page.add_init_script(_FIRST_PICTURE)
        seen.page.goto(link)
        seen.page.wait_for_selector(READY, state="attached")
        waits(seen, ICE_DRAWN)
        assert seen.page.evaluate("buttonsBefore") == 0
        blocks = [url for url in seen.requests if "/blocks" in url]
        assert seen.requests.index(blocks[0]) < seen.requests.index(f"{page.address}moments")
    with open_page("about:blank") as seen:
        held = HeldRequests(seen, "**/blocks*")
        seen.page.goto(link)
        seen.page.wait_for_selector("#tab-alerts")
        held.release_all()
        waits(seen, ICE_DRAWN)


def test_map_of_a_silent_server_is_called_stale(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        show_ice(seen)
        waits(seen, "gripmap.live.state")
        seen.page.evaluate("gripmap.live.source.close()")
        assert "does not answer" in card(seen, "error")
        assert seen.page.locator("#live").inner_text().startswith("○ last update")
        # The panel is drawn after the card.
        waits(seen, "document.getElementById('panel').innerText.includes('not live')")
        keep_picture(seen, "stale")


def test_region_without_a_service_is_hatched_and_named(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        show_ice(seen)
        waits(seen, "document.getElementById('live').dataset.state === 'live'")
        assert page.service is not None
        page.service.end()
        waits(seen, "!document.getElementById('away').hidden")
        assert "No service for 1 region" in seen.page.locator("#away").inner_text()
        keep_picture(seen, "service-away")


def test_page_without_history_states_it_and_has_no_slider(
    router: ZenohSettings, tmp_path: Path
) -> None:
    with (
        running(router, tmp_path / "archive"),
        page_of(router) as address,
        open_page(address) as seen,
    ):
        seen.page.wait_for_selector(READY, state="attached")
        seen.page.set_viewport_size(LAPTOP)
        waits(seen, "gripmap.live.state")
        assert not seen.page.locator("#slider").is_visible()
        assert "The past appears" in seen.page.locator("#timeline").inner_text()
        keep_picture(seen, "no-history")


def test_place_without_history_states_it(page: RunningPage, drive: Drive) -> None:
    drive("ice")
    with open_map(page) as seen:
        seen.page.route("**/history/**", lambda route: route.fulfill(json=[]))
        show_ice(seen)
        seen.page.locator("#map").click()
        waits(seen, "document.querySelector('.history p')")
        assert "No history yet" in seen.page.locator(".history").first.inner_text()
        keep_picture(seen, "place-without-history")


def test_dark_page_has_a_dark_ground_and_light_ice(page: RunningPage, drive: Drive) -> None:
    drive()
    with open_map(page) as seen:
        seen.page.emulate_media(color_scheme="dark")
        show_ice(seen)
        waits(seen, "document.documentElement.dataset.theme === 'dark'")
        ground, ice = seen.page.evaluate(
            "['paper', 'ice'].map(n => getComputedStyle(document.documentElement)"
            ".getPropertyValue('--' + n).trim())"
        )
        assert _lightness(ground) < 60 < 180 < _lightness(ice)
        keep_picture(seen, "dark")


def _lightness(colour: str) -> float:
    return sum(int(colour[k : k + 2], 16) for k in (1, 3, 5)) / 3


def test_phone_shows_map_and_first_alert_at_once(page: RunningPage, drive: Drive) -> None:
    drive()
    with open_map(page, phone=True) as seen:
        near(seen, cell_of("ice"), 17)
        waits(seen, "document.body.dataset.kinds?.split(',')[0] > 0")
        waits(seen, "document.querySelector('#panel [data-alert]')")
        first = seen.page.locator("#panel [data-alert]").first
        box = first.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= seen.page.evaluate("innerHeight")
        keep_picture(seen, "phone")


def test_print_has_moment_legend_and_map_and_stays_readable_in_grey(
    page: RunningPage, drive: Drive
) -> None:
    drive()
    with open_map(page) as seen:
        show_ice(seen)
        waits(seen, "document.body.dataset.alerts > 0")
        seen.page.emulate_media(media="print")
        seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
        assert re.search(r"as of \d{4}-", seen.page.locator("#paper h2").inner_text())
        path = FOLDER / "print.png"
        FOLDER.mkdir(parents=True, exist_ok=True)
        seen.page.screenshot(path=path, full_page=True)
        grey = Image.open(path).convert("L")
        grey.save(FOLDER / "print-grey.png")
        steps = seen.page.evaluate(_LADDER)
        scale = grey.size[0] / seen.page.evaluate("innerWidth")
        places = [(int(x * scale), int(y * scale)) for x, y in steps]
        shades = [float(np.asarray(grey)[y, x]) for x, y in places]
        assert min(np.diff(shades[:6])) >= 8, "the more dangerous, the darker"


# Centres of the samples in the printed legend, beginning with the most dangerous class.
_LADDER: Final = """[...document.querySelectorAll("#paper .ladder .ribbon")].map(one => {
  const box = one.getBoundingClientRect();
  return [scrollX + box.left + box.width / 2, scrollY + box.top + box.height / 2];
})"""
