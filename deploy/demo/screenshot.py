"""Screenshot of the live page for the README."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Final

from schemas.errors import InputError
from schemas.runtime.installing import install_command

SIZE: Final = {"width": 1280, "height": 800}
WAIT_MS: Final = 20_000
SETTLED_MS: Final = 2_000  # wait after the first picture for data that are still in transit


def take_screenshot(address: str, path: Path) -> None:
    """Open the live page in the system's Chromium and save a screenshot.

    Raises:
        InputError: Chromium or Playwright is missing.
    """
    program = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    try:
        from playwright import sync_api
    except ImportError as error:
        raise InputError("screenshot", "Playwright is missing", install_command("dev")) from error
    if program is None:
        raise InputError("screenshot", "Chromium is not installed", "apt install chromium")
    size: Any = SIZE
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            shown = browser.new_page(viewport=size)
            shown.goto(address)
            shown.wait_for_selector("body[data-ready]", state="attached", timeout=WAIT_MS)
            shown.wait_for_timeout(SETTLED_MS)
            shown.screenshot(path=path)
        finally:
            browser.close()
