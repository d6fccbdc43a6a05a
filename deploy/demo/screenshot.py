"""Screenshot of the live page for the README."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.installing import install_command

ENDINGS: Final = (".png", ".jpg", ".jpeg")
SIZE: Final = {"width": 1280, "height": 800}
WAIT_MS: Final = 20_000
SETTLED_MS: Final = 2_000  # wait after the first picture for data that are still in transit


def check_screenshot(path: Path) -> None:
    """Check that a screenshot can be taken and saved at `path`.

    Raises:
        InputError: the path is not that of an image in an existing folder, or Chromium or
            Playwright is missing.
    """
    commandline.check_ending("screenshot", commandline.check_out_file("screenshot", path), ENDINGS)
    if find_spec("playwright") is None:
        raise InputError("screenshot", "Playwright is missing", install_command("dev"))
    if _find_chromium() is None:
        raise InputError("screenshot", "Chromium is not installed", "apt install chromium")


def take_screenshot(address: str, path: Path) -> None:
    """Open the live page in the system's Chromium and save a screenshot; `check_screenshot` has
    passed.
    """
    from playwright import sync_api

    size: Any = SIZE
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=_find_chromium(), args=["--no-sandbox"])
        try:
            shown = browser.new_page(viewport=size)
            shown.goto(address)
            shown.wait_for_selector("body[data-ready]", state="attached", timeout=WAIT_MS)
            shown.wait_for_timeout(SETTLED_MS)
            shown.screenshot(path=path)
        finally:
            browser.close()


def _find_chromium() -> str | None:
    return (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
