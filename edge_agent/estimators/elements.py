"""Elements of the papers: one entry per equation, table or figure, with how the code implements it.

Each paper's module holds its list. Documentation and reports are generated from these lists.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, TypeAlias

Verdict: TypeAlias = Literal["as printed", "option", "corrected", "left out"]
VERDICTS: Final[tuple[Verdict, ...]] = ("as printed", "option", "corrected", "left out")


class Element(NamedTuple):
    """One element of a paper.

    Attributes:
        place: equation, table, figure or section of the paper.
        what: the element.
        verdict: "as printed"; "option": as printed if it is asked for, because the default needs
        something else; "corrected"; "left out".
        why: the reason, for everything but "as printed".
        where: module, function or option that holds it.
    """

    place: str
    what: str
    verdict: Verdict
    why: str = ""
    where: str = ""


def elements_without_reason(elements: tuple[Element, ...]) -> list[str]:
    """Return the places of elements that lack a reason or a home."""
    found = []
    for element in elements:
        lacks_reason = element.verdict != "as printed" and not element.why
        lacks_home = element.verdict != "left out" and not element.where
        if lacks_reason or lacks_home:
            found.append(element.place)
    return found
