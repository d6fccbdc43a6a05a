"""Helpers for tests of pages in a real browser: headless Chromium of the system, driven by
Playwright.

On Debian and Ubuntu install it with `apt install chromium`. Without Chromium or Playwright the
tests of pages are skipped, and the reason is reported.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
UNBOUND: Final = ("--disable-frame-rate-limit", "--disable-gpu-vsync")
PHONE: Final = {"width": 390, "height": 844}
DESK: Final = {"width": 1280, "height": 900}


def find_chromium() -> str | None:
    """Return the path of the system's Chromium, or None if it is not installed."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Opened:
    """Page that is open in the browser: its errors, and the network requests that it made."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on(
            "console",
            lambda message: self.errors.append(message.text) if message.type == "error" else None,
        )
        page.on("request", lambda request: self.requests.append(request.url))

    @property
    def drawn_count(self) -> int:
        """Return the number of shapes (such as cells and roads) that the map page reports as
        painted.
        """
        return int(self.page.evaluate("document.body.dataset.drawn || 0"))

    def count_colours(self, panel: int = 0) -> dict[str, int]:
        """Return the number of pixels of each opaque colour (#rrggbb) in the page's canvas number
        `panel`.
        """
        found: dict[str, int] = self.page.evaluate(_COLOURS, panel)
        return found


@contextmanager
def open_page(
    path: Path | str, *, phone: bool = False, ratio: float = 1.0, unbound: bool = False
) -> Iterator[Opened]:
    """Open a file or an address in the browser, and yield the page. Skip the test if there is no
    browser.

    Args:
        path: file of this machine, or address.
        phone: True for the screen of a phone.
        ratio: device pixels per CSS pixel.
        unbound: True to paint frames without the screen's rate limit.
    """
    program = find_chromium()
    if program is None:
        pytest.skip("Chromium is not installed: apt install chromium")
    api: Any = pytest.importorskip(
        "playwright.sync_api", reason="no Playwright: pip install 'gripmap[dev]'"
    )
    with api.sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=program, args=["--no-sandbox", *(UNBOUND if unbound else ())]
        )
        context = browser.new_context(
            viewport=PHONE if phone else DESK,
            device_scale_factor=ratio,
            has_touch=phone,
            is_mobile=phone,
        )
        try:
            found = Opened(context.new_page())
            found.page.goto(path if isinstance(path, str) else path.resolve().as_uri())
            yield found
        finally:
            browser.close()


_COLOURS: Final = """panel => {
  const canvas = document.querySelectorAll("canvas.map")[panel];
  const bytes = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const found = {};
  for (let k = 0; k < bytes.length; k += 4) if (bytes[k + 3] === 255) {
    const name = [bytes[k], bytes[k + 1], bytes[k + 2]].join(",");
    found[name] = (found[name] || 0) + 1;
  }
  return found;
}"""
