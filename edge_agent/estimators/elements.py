"""Record type `Element`: one equation, table or figure of a paper, and how the code implements it.

The module of each paper has a list of such records. Documentation and reports are generated from
these lists.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, TypeAlias

Verdict: TypeAlias = Literal["as printed", "option", "corrected", "left out"]
VERDICTS: Final[tuple[Verdict, ...]] = ("as printed", "option", "corrected", "left out")


class Element(NamedTuple):
    """One equation, table, figure or section of a paper, and how the code treats it.

    Attributes:
        place: number of the equation, table, figure or section in the paper.
        what: content of the element.
        verdict: "as printed"; "option" (implemented as printed, but not the default); "corrected";
            "left out".
        why: reason of the verdict, required except for "as printed".
        where: module, function or option that implements the element.
    """

    place: str
    what: str
    verdict: Verdict
    why: str = ""
    where: str = ""


def elements_without_reason(elements: tuple[Element, ...]) -> list[str]:
    """Return the `place` (number in the paper) of each element (equation, figure, …) whose record
    lacks a required reason or a required code location.
    """
    found = []
    for element in elements:
        lacks_reason = element.verdict != "as printed" and not element.why
        lacks_home = element.verdict != "left out" and not element.where
        if lacks_reason or lacks_home:
            found.append(element.place)
    return found
