"""Tests that clients in other languages can publish reports, receive acknowledgements and warnings,
and read a map tile.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deploy.clients import PLACES, build_client, missing_tool, run_client, served_map

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served_map(tmp_path_factory.mktemp("served")) as found:
        yield found


@pytest.mark.parametrize("language", PLACES)
def test_a_client_in_another_language_takes_part(
    language: str, endpoint: str, tmp_path: Path
) -> None:
    reason = missing_tool(language)
    if reason:
        pytest.skip(f"the client in {language} is not tested: {reason}")
    found = run_client(build_client(language, tmp_path), language, endpoint)
    assert found["durable"] is True
    assert 0.05 < found["alert_mu"] < 0.4
    assert found["cells"] == 1
