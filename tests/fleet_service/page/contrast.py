"""Contrast of the page's texts and map classes against their backgrounds (WCAG 2.2), for light and
dark colours and all kinds of colour vision.
"""

from __future__ import annotations

import re
from typing import Final

from tests.colour_vision import SIGHTS, to_lab
from tests.structure import ROOT

STATIC: Final = ROOT / "fleet_service" / "page" / "static"
THEMES: Final = (":root", '[data-theme="dark"]')
CLASSES: Final = ("ice", "snow", "wet", "dry", "rather", "rather-not", "little")
TEXTS: Final = (
    *((text, behind) for text in ("ink", "soft", "blue") for behind in ("paper", "sunk")),
    ("alert", "paper"),
)


def contrast(first: str, second: str, sight: str) -> float:
    """Return the contrast ratio of two colours (WCAG 2.2), computed from CIE lightness."""
    light = [float(to_lab(colour, sight)[0]) for colour in (first, second)]
    low, high = sorted(((v + 16) / 116) ** 3 if v > 8 else v / 903.3 for v in light)
    return (high + 0.05) / (low + 0.05)


def read_colours(theme: str) -> dict[str, str]:
    """Return the colours that the page's style sheet defines for a theme, light or dark, by
    name.
    """
    style = (STATIC / "style.css").read_text()
    block = style[style.index(theme) :].partition("}")[0]
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block))


def text_contrasts(theme: str, sight: str) -> dict[str, float]:
    """Return the contrast of each pair of text and background colour in a theme (light or dark), as
    seen with a kind of colour vision.
    """
    named = read_colours(theme)
    return {
        f"{text} on {behind}": contrast(named[text], named[behind], sight) for text, behind in TEXTS
    }


def class_contrasts(theme: str, sight: str) -> dict[str, float]:
    """Return the contrast of each map class against the background in a theme (light or dark), as
    seen with a kind of colour vision. Some classes are drawn with an edge, because their fill has
    too little contrast. For these, return the higher contrast of fill and edge.
    """
    named = read_colours(theme)
    edged = re.search(r"EDGED = \[([\d, ]+)\]", (STATIC / "ribbons.js").read_text())
    assert edged is not None
    with_edge = {int(kind) for kind in edged[1].split(", ")}
    return {
        name: max(
            contrast(colour, named["ground"], sight)
            for colour in (named[name], *((named["bound"],) if kind in with_edge else ()))
        )
        for kind, name in enumerate(CLASSES)
    }


def worst_contrasts() -> tuple[float, float]:
    """Return the smallest contrast of any text and that of any map class, over all themes and kinds
    of colour vision.
    """
    both = [(theme, sight) for theme in THEMES for sight in SIGHTS]
    return (
        min(value for one in both for value in text_contrasts(*one).values()),
        min(value for one in both for value in class_contrasts(*one).values()),
    )
