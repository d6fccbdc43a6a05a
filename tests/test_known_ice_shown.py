"""Tests that every output of the map shows each place that is known to be slippery."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.usability.known_ice import KnownIce, find_hidden

pytestmark = pytest.mark.campaign  # opens two pages in a browser


def test_no_output_draws_known_ice_as_unknown(tmp_path: Path) -> None:
    ice = KnownIce(tmp_path)
    assert len(ice.places) > 100
    assert len(ice.unvalued) > 20
    found = find_hidden(ice)
    assert len(found) > 30
    assert {name: len(places) for name, places in found.items() if places} == {}


def test_an_older_snapshot_shows_known_ice_on_page_and_in_qgis(tmp_path: Path) -> None:
    """A stored map (snapshot) of an older version has only a lower bound and no μ for some places
    that are known to be icy.

    The live page and QGIS must show these places as ice. Query answers and exported snapshots
    cannot show them, because they contain no μ for these places. `find_hidden` must report exactly
    these places as hidden in answers and exports. This proves that `find_hidden` can detect hidden
    ice.
    """
    ice = KnownIce(tmp_path, is_older=True)
    found = find_hidden(ice)
    tables = [name for name in found if name.startswith(("answer", "export map --snap"))]
    assert tables
    assert all(found[name] == ice.unvalued for name in tables)
    pages = [name for name in found if name.startswith("page") or name == "QGIS style"]
    assert len(pages) > 20
    assert {name: len(found[name]) for name in pages if found[name]} == {}
