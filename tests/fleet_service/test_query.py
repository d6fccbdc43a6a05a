"""Tests of the command that queries the map. It must distinguish an empty map from a missing
service, and write the answer in the format that the file's name selects.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fleet_service.cli import main
from schemas.config import ZenohSettings

Capture = pytest.CaptureFixture[str]


def test_no_service_is_not_an_empty_map(
    router: ZenohSettings, tmp_path: Path, capsys: Capture
) -> None:
    assert main(["query", "--connect", router.connect[0]]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("no service answers for the map")


@pytest.mark.usefixtures("service")
@pytest.mark.parametrize("ending", ["geojson", "parquet", "csv", "arrow", "json"])
def test_an_empty_map_is_written_in_the_form_of_its_ending(
    router: ZenohSettings, tmp_path: Path, ending: str
) -> None:
    out = tmp_path / f"map.{ending}"
    assert main(["query", "--connect", router.connect[0], "--out", str(out)]) == 0
    begin = {
        "geojson": b'{"type": "FeatureCollection"',
        "parquet": b"PAR1",
        "json": b'{"tiles"',
        "csv": b'"cell"',
    }
    assert out.read_bytes().startswith(begin.get(ending, b"\xff\xff\xff\xff"))
    words = [
        "query",
        "--connect",
        router.connect[0],
        "--format",
        "json",
        "--out",
        str(tmp_path / "a.geojson"),
    ]
    assert main(words) == 2
