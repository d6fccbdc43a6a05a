"""Measure the language of docstrings, names and pages; lower the ceilings (upper limits) of
`tests/test_language.py`.

    python -m tests.language          print the figures, and lower the ceilings to them
    python -m tests.language RULE     print every text that breaks this rule

CONTRIBUTING.md, section "Rules for language", states the rules. `language_ceilings.json` has the
ceilings per package. No ceiling is ever raised.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from tests.results import list_pages
from tests.structure import ROOT, list_nodes, list_sources

PACKAGES: Final = ("schemas", "edge_agent", "fleet_service", "deploy", "tests")
CEILINGS: Final = ROOT / "tests" / "language_ceilings.json"
LONGEST_TEST_NAME: Final = 70
LONGEST_SENTENCE: Final = 30  # [words]
# A licence, and a page whose text comes from the figures.
NOT_OURS: Final = ("NOTICE.md", "results.md")

# A docstring begins with an imperative verb or a noun phrase.
OPENING: Final = re.compile(r"(What|Who|Whether|Of|How)\b")
# "who is late", "what the map knows": relative clauses without a noun.
FREE_RELATIVE: Final = re.compile(
    r"\b(?:who (?:is|was|has|had|may|said|told|comes|asks|waits|would|can|does|did"
    r"|knows|says|reads|sends)"
    r"|what (?:is|was|has|had|may|it|they|a|an|the|no|was|comes|does|can|would|goes|lies"
    r"|stands|others?|we|nobody))\b",
    re.IGNORECASE,
)
# Words that are archaic or translated, with the standard word.
STOP_WORDS: Final = {
    r"anew": "again",
    r"likewise": "also, the same",
    r"at the most": "at most",
    r"at the least": "at least",
    r"gives? free": "release",
    r"given free": "released",
    r"mend(?:s|ed)?": "fix",
    r"beside(?! the point)": "next to, compared with, in addition to",
    r"whoever": "the client that, anyone who",
    r"of whom": "whose",
    r"oneself|one's own": "your own, its own",
    r"amid of": "during",
    r"is to be": "must be",
    r"are to be": "must be",
    r"wants an?": "needs a",
    r"speaks? the truth": "is correct",
}
STOP: Final = re.compile(r"\b(?:" + "|".join(STOP_WORDS) + r")\b", re.IGNORECASE)
# Participles that are also nouns or adjectives of the field.
NOT_PARTICIPLES: Final = {"embed", "feed", "need", "seed", "speed", "shed", "read", "spread"}
IRREGULAR: Final = (
    "begun born bound bought brought built caught chosen come cut dealt done drawn driven eaten "
    "fallen fed felt fit flown forbidden forgotten found frozen given gone grown heard held "
    "hidden hit hung hurt kept known laid led left lent let lit lost made meant met mixed moved "
    "paid put quit read rid risen run said seen sent set shown shut sold spent split spoken "
    "spread stood stuck swept sworn taken taught thought thrown told torn understood woken won "
    "worn written"
)
PARTICIPLES: Final = set(IRREGULAR.split()) - {
    "bound",
    "fit",
    "let",
    "put",
    "read",
    "run",
    "set",
    "split",
    "spread",
}
DUNDER: Final = re.compile(r"__\w+__")


class Docstring(NamedTuple):
    """Docstring in the code, with its file and line."""

    place: str
    text: str


class Named(NamedTuple):
    """Name of a function in the code, with its file and line."""

    place: str
    name: str


def docstrings(package: str) -> Iterator[Docstring]:
    """Yield the docstrings of a package."""
    for path in list_sources(ROOT, package):
        for node in list_nodes(path):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    line = getattr(node, "lineno", 1)
                    yield Docstring(f"{path.relative_to(ROOT)}:{line}", text)


def functions(package: str) -> Iterator[Named]:
    """Yield the functions and methods of a package, including tests and properties, without dunder
    methods.
    """
    for path in list_sources(ROOT, package):
        for node in list_nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not DUNDER.fullmatch(
                node.name
            ):
                yield Named(f"{path.relative_to(ROOT)}:{node.lineno}", node.name)


def user_texts(package: str) -> Iterator[Docstring]:
    """Yield the texts of a package that users read: help texts, descriptions of settings, and
    messages of errors.
    """
    for path in list_sources(ROOT, package):
        for node in list_nodes(path):
            if not isinstance(node, ast.Call):
                continue
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            shown = [word.value for word in node.keywords if word.arg in ("help", "description")]
            for part in [*node.args, *shown] if called.endswith("Error") else shown:
                words = [
                    one.value
                    for one in ast.walk(part)
                    if isinstance(one, ast.Constant) and isinstance(one.value, str)
                ]
                yield Docstring(f"{path.relative_to(ROOT)}:{part.lineno}", " … ".join(words))


def is_participle(name: str) -> bool:
    """Return True if the name of a function is only a participle, such as `joined` or `kept`."""
    word = name.strip("_")
    regular = word.endswith("ed") and word.isalpha() and word not in NOT_PARTICIPLES
    return regular or word in PARTICIPLES


def free_relatives(text: str) -> list[str]:
    """Return the relative clauses of a text that have no antecedent noun (see FREE_RELATIVE)."""
    return [found[0] for found in FREE_RELATIVE.finditer(text)]


def stop_words(text: str) -> list[str]:
    """Return the words on the stop list in a text."""
    return [found[0] for found in STOP.finditer(text)]


def measure_package(package: str) -> dict[str, float]:
    """Return the language figures of a package; less is better for each.

    Keys: `openings` (docstrings that begin with What, Who, Whether, Of or How), `stop_words` (in
    docstrings), `free_relatives` (per 1,000 docstring words), `user_texts` (stop words and free
    relatives in texts for users), `participles` and `one_word` (percent of function names),
    `long_test_names` (percent of test functions).
    """
    texts = [docstring.text for docstring in docstrings(package)]
    names = [function.name for function in functions(package)]
    tests = [name for name in names if name.startswith("test_")]
    others = [name for name in names if not name.startswith("test_")]
    words = sum(len(text.split()) for text in texts)
    shown = [one.text for one in user_texts(package)]
    return {
        "openings": float(sum(bool(OPENING.match(text)) for text in texts)),
        "stop_words": float(sum(len(stop_words(text)) for text in texts)),
        "free_relatives": round_up(
            1e3 * sum(len(free_relatives(text)) for text in texts) / max(words, 1)
        ),
        "user_texts": float(sum(len(stop_words(one) + free_relatives(one)) for one in shown)),
        "participles": round_up(100 * sum(map(is_participle, others)) / max(len(others), 1)),
        "one_word": round_up(
            100 * sum("_" not in name.strip("_") for name in others) / max(len(others), 1)
        ),
        "long_test_names": round_up(
            100 * sum(len(name) > LONGEST_TEST_NAME for name in tests) / max(len(tests), 1)
        ),
    }


def round_up(value: float) -> float:
    """Return `value` rounded up to a tenth, so that a ceiling (upper limit of a count) computed
    from it never lies below the measurement.
    """
    return -(-int(value * 1000) // 100) / 10


def extract_prose(text: str) -> str:
    """Return the prose of a Markdown page: its text without code, tables, generated parts,
    headings, link targets and markers.
    """
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    kept = [
        line
        for line in text.splitlines()
        if not re.match(r"\s*(\||#|    \S|\[[^\]]+\]:|\(.*\)=|:)", line)
    ]
    text = "\n".join(kept)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"`[^`]*`", "Code", text)


def split_sentences(text: str) -> list[str]:
    """Return the sentences of a page's prose. The end of a list item or paragraph also ends a
    sentence.
    """
    items = re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", extract_prose(text), flags=re.MULTILINE)
    blocks = re.split(r"\n\s*\n", items)
    found = []
    for block in blocks:
        found += re.split(r"(?<=[.!?:;])\s+(?=[\"(*`A-Z0-9])", " ".join(block.split()))
    return [sentence for sentence in found if re.search(r"\w", sentence)]


def long_sentences(page: Path) -> list[str]:
    """Return the sentences of a page with more than LONGEST_SENTENCE words."""
    found = split_sentences(page.read_text(encoding="utf-8"))
    return [one for one in found if len(re.findall(r"\w[\w'’./-]*", one)) > LONGEST_SENTENCE]


def page_stop_words(page: Path) -> list[str]:
    """Return the words on the stop list in the prose and the tables of a page."""
    text = re.sub(
        r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    return stop_words(re.sub(r"`[^`]*`", "", text))


def markdown_words() -> int:
    """Return the number of words of all handwritten pages. A word is a token with a letter or
    digit; the results page is not counted.
    """
    written = [page for page in list_pages() if page.name not in NOT_OURS]
    return sum(len(re.findall(r"\S*\w\S*", page.read_text(encoding="utf-8"))) for page in written)


def measure_pages() -> dict[str, dict[str, float]]:
    """Return the numbers of long sentences and stop words, by page. Pages without any are left out.
    The key "*" has the number of words of all pages.
    """
    found: dict[str, dict[str, float]] = {"*": {"words": float(markdown_words())}}
    for page in list_pages():
        if page.name in NOT_OURS:
            continue
        figures = {
            "long_sentences": float(len(long_sentences(page))),
            "stop_words": float(len(page_stop_words(page))),
        }
        if any(figures.values()):
            found[str(page.relative_to(ROOT))] = figures
    return found


def read_ceilings() -> dict[str, dict[str, dict[str, float]]]:
    """Return the ceilings (upper limits) of the language figures, indexed by `packages` or `pages`,
    then by package or page, then by figure.
    """
    found: dict[str, dict[str, dict[str, float]]] = json.loads(CEILINGS.read_text(encoding="utf-8"))
    return found


def lower_ceilings() -> None:
    """Lower each stored ceiling (upper limit that a test checks) that is above the present figure
    to this figure. Add missing ceilings.
    """
    today = {
        "packages": {package: measure_package(package) for package in PACKAGES},
        "pages": measure_pages(),
    }
    before = read_ceilings() if CEILINGS.exists() else today
    lowered: dict[str, dict[str, dict[str, float]]] = {"packages": {}, "pages": {}}
    for package, figures in today["packages"].items():
        old = before["packages"].get(package, figures)
        lowered["packages"][package] = {
            name: min(value, old.get(name, value)) for name, value in figures.items()
        }
    for page, old in before["pages"].items():
        figures = today["pages"].get(page, {})
        left = {name: min(value, figures.get(name, 0.0)) for name, value in old.items()}
        if any(left.values()):
            lowered["pages"][page] = left
    CEILINGS.write_text(json.dumps(lowered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def print_faults(rule: str) -> None:
    """Print the file and line of each text that breaks a rule."""
    for package in PACKAGES:
        for place, text in docstrings(package):
            first = text.splitlines()[0]
            if rule == "openings" and OPENING.match(text):
                print(f"{place}: {first}")
            if rule == "stop_words" and (found := stop_words(text)):
                print(f"{place}: {', '.join(found)}")
            if rule == "free_relatives" and (found := free_relatives(text)):
                print(f"{place}: {', '.join(found)}")
        for place, text in user_texts(package):
            if rule == "user_texts" and (found := stop_words(text) + free_relatives(text)):
                print(f"{place}: {', '.join(found)}")
        for place, name in functions(package):
            if rule == "participles" and is_participle(name):
                print(f"{place}: {name}")
            if (
                rule == "long_test_names"
                and name.startswith("test_")
                and len(name) > LONGEST_TEST_NAME
            ):
                print(f"{place}: {name}")
    if rule == "pages":
        for page in list_pages():
            for fault in (*long_sentences(page), *page_stop_words(page)):
                print(f"{page.relative_to(ROOT)}: {fault}")


def main() -> None:
    """Print the figures and lower the ceilings (upper limits), or print the texts that break the
    given rule.
    """
    if len(sys.argv) > 1:
        print_faults(sys.argv[1])
        return
    lower_ceilings()
    for package in PACKAGES:
        print(package, measure_package(package))
    print(measure_pages())


if __name__ == "__main__":
    main()
