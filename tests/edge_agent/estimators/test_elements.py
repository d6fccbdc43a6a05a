"""Tests of the lists of the papers' equations, tables and figures. Each deviation of the code from
a paper must have a reason, and each listed place in the code must exist.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from edge_agent.estimators import (
    adaptive_federated_ckf,
    compensated_wckf,
    federated_ckf,
    paper_aco_fckf,
    sr_ukf,
)
from edge_agent.estimators.elements import VERDICTS, Element, elements_without_reason
from tests.structure import ROOT

LISTS = {
    "000": federated_ckf.ELEMENTS,
    "001": adaptive_federated_ckf.ELEMENTS,
    "002": compensated_wckf.ELEMENTS,
    "003": sr_ukf.ELEMENTS,
    "004": paper_aco_fckf.ELEMENTS,
}
SOURCE = "\n".join(
    f"{path.relative_to(ROOT).as_posix()}\n{path.read_text()}"
    for path in (ROOT / "edge_agent").rglob("*.py")
)


@pytest.mark.parametrize("paper", LISTS)
def test_every_departure_has_a_reason_and_every_element_a_home(paper: str) -> None:
    assert elements_without_reason(LISTS[paper]) == []
    assert all(element.verdict in VERDICTS for element in LISTS[paper])


def test_an_element_without_reason_or_home_is_found() -> None:
    silent = Element("(1)", "a sign", "corrected", where="dynamics")
    homeless = Element("(2)", "a filter", "as printed")
    explained = Element("(3)", "a bench", "left out", "no data")
    assert elements_without_reason((silent, homeless, explained)) == ["(1)", "(2)"]


@pytest.mark.parametrize("paper", LISTS)
def test_homes_of_elements_exist(paper: str) -> None:
    for element in LISTS[paper]:
        for name in re.findall(r"[A-Za-z_][A-Za-z_0-9]*", element.where):
            folder = Path(ROOT / "edge_agent").rglob(name)
            assert name in SOURCE or any(folder), (element.place, name)


@pytest.mark.parametrize(
    ("paper", "name"),
    [
        ("004", "dual-motor"),
        ("004", "lower vertices"),
        ("004", "objective 1/(1 + e)"),
        ("004", "visibility"),
        ("001", "stiffness polynomial"),
        ("001", "FKF"),
        ("002", "C_f, C_r and J"),
        ("002", "WCKF-A"),
        ("002", "PRE"),
        ("003", "UKF in covariance form"),
        ("003", "permanent-magnet"),
        ("003", "PID"),
        ("000", "sideslip beta"),
    ],
)
def test_elements_that_were_once_absent_are_listed(paper: str, name: str) -> None:
    assert any(name in element.what and element.verdict != "left out" for element in LISTS[paper])
