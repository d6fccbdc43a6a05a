"""Test that no regular expression of the product takes more than linear time in the length of the
text.
"""

from __future__ import annotations

import pytest

from tests import regexes

BAD = (
    r"^\s*SG_\s+(?P<name>[^:]*?)(?:\s+(?P<mux>M|m\d+M?))?\s*:\s*\d+",
    r"(a+)+b",
    r"\s*\(\s*([^,]+),",
    r"(\w+\s?)*!",
    r"\d+\d+x",
)
GOOD = (r"\s*(\d+)\s*:\s*(\w+)", r"[a-z0-9][a-z0-9-]{0,63}", r"^a+b+c+$", r"\d+\.\d+", r"x\s*")


@pytest.mark.parametrize("pattern", BAD)
def test_superlinear_pattern_is_found(pattern: str) -> None:
    assert regexes.is_superlinear(pattern)


@pytest.mark.parametrize("pattern", GOOD)
def test_linear_pattern_is_not_accused(pattern: str) -> None:
    assert not regexes.is_superlinear(pattern)


@pytest.mark.campaign
def test_product_has_no_superlinear_pattern() -> None:
    found = regexes.find_all()
    assert not found, "\n".join(f"{one.place}: {one.pattern}" for one in found)
