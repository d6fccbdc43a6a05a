"""Accessibility scan of the page with axe-core: serious and critical findings in every panel."""

from __future__ import annotations

from typing import Any, Final

from tests.browser import Opened
from tests.npm import file_of

TABS: Final = ("now", "legend", "cell", "alerts", "route", "health", "share")
SERIOUS: Final = ("serious", "critical")
_RUN: Final = "async () => (await axe.run(document)).violations"
MISSING: Final = "no axe-core in .page/tools: make browser-test fetches it with npm"


def findings(seen: Opened, tabs: tuple[str, ...] = TABS) -> list[str] | None:
    """Return one text per serious accessibility finding on the page's panels `tabs`. Return None if
    axe-core is not installed.
    """
    source = file_of("axe-core", "axe.min.js")
    if source is None:
        return None
    # Without animations: the contrast of a colour that is still fading in would be measured
    # wrongly.
    seen.page.emulate_media(reduced_motion="reduce")
    seen.page.evaluate(f"() => {{ {source.read_text()} }}")
    found: list[str] = []
    for tab in tabs:
        seen.page.evaluate(
            "async tab => { gripmap.panels.open(tab); await gripmap.panels.refresh() }", tab
        )
        violations: list[dict[str, Any]] = seen.page.evaluate(_RUN)
        found += [
            f"{tab}: {one['id']} ({one['impact']}): {one['help']}: {node['html'][:200]}"
            for one in violations
            if one["impact"] in SERIOUS
            for node in one["nodes"]
        ]
    return found
