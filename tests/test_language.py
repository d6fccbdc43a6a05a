"""Tests that docstrings, names and pages keep the rules of language: no count of broken rules may
exceed the ceiling (stored upper limit) of its package or page.

`python -m tests.language` lowers the ceilings, `python -m tests.language RULE` prints the texts
that break a rule.
"""

from __future__ import annotations

import pytest

from tests import language
from tests.structure import ROOT

PACKAGES = pytest.mark.parametrize("package", language.PACKAGES)
MOST_WORDS = 25_000


@pytest.mark.campaign
@PACKAGES
def test_language_of_a_package_is_not_worse_than_its_ceilings(package: str) -> None:
    ceilings = language.read_ceilings()["packages"][package]
    measured = language.measure_package(package)
    worse = {
        name: (value, ceilings[name]) for name, value in measured.items() if value > ceilings[name]
    }
    assert not worse, f"{worse}: see `python -m tests.language {next(iter(worse))}`"


def test_language_of_pages_is_not_worse_than_their_ceilings() -> None:
    ceilings = language.read_ceilings()["pages"]
    for page, measured in language.measure_pages().items():
        allowed = ceilings.get(page, {})
        allowed = {**allowed, "words": max(MOST_WORDS, allowed.get("words", 0.0))}
        worse = {name: value for name, value in measured.items() if value > allowed.get(name, 0.0)}
        assert not worse, f"{page}: {worse}; see `python -m tests.language pages`"


def test_ceilings_have_every_package_and_only_existing_pages() -> None:
    ceilings = language.read_ceilings()
    assert set(ceilings["packages"]) == set(language.PACKAGES)
    assert not [page for page in ceilings["pages"] if page != "*" and not (ROOT / page).exists()]


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("Of those who is there.", 1),
        ("Return what the map knows.", 1),
        ("Return the rows so that none is lost.", 0),
    ],
)
def test_free_relatives_are_found(text: str, count: int) -> None:
    assert len(language.free_relatives(text)) == count


@pytest.mark.parametrize(
    ("name", "is_one"),
    [
        ("joined", True),
        ("_kept", True),
        ("told", True),
        ("seed", False),
        ("decode_cells", False),
        ("spread", False),
    ],
)
def test_a_lone_participle_is_recognised(name: str, is_one: bool) -> None:
    assert language.is_participle(name) == is_one


@pytest.mark.parametrize(
    "text", ["Write it anew.", "At the most two.", "What lies beside it.", "It is mended."]
)
def test_stop_words_are_found(text: str) -> None:
    assert language.stop_words(text)


def test_prose_leaves_out_code_tables_and_links() -> None:
    text = (
        "# Title\n\nOne [word](a/b.md) and `code`.\n\n| a |\n|---|\n\n```\nanew\n```\n- item "
        "one.\n- item two.\n"
    )
    assert [one.strip() for one in language.split_sentences(text)] == [
        "One word and Code.",
        "item one.",
        "item two.",
    ]
