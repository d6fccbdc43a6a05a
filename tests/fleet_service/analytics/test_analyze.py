"""The command as a person types it, and the files that it writes."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas
import geoparquet_validator
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics.questions import QUESTIONS
from fleet_service.cli import main

DAYS = ("--from", "2026-01-27", "--to", "2026-01-29")


def analyze(archive: Path, *words: str) -> int:
    return main(["analyze", words[0], "--archive", str(archive), *DAYS, *words[1:]])


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_question_prints_a_table_and_says_what_it_reads(
    archive: Path, stations: Path, name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    more = {"before-after": ["--at", "2026-01-28"], "weather": ["--stations", str(stations)]}.get(name, [])
    out = tmp_path / "answer.parquet"
    assert analyze(archive, name, *more, "--out", str(out)) == 0
    said = capsys.readouterr()
    assert said.err.startswith(f"{name}: 2 files, 24,000 observations\n")
    lines = said.out.splitlines()
    answer = pq.read_table(out)
    assert lines[0].split() == [f.name for f in answer.schema]
    assert lines[-1].startswith(f"{answer.num_rows} rows")


def test_an_answer_with_a_place_becomes_geoparquet_geojson_and_a_map(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for ending in ("geo.parquet", "geojson", "html", "csv", "png", "svg"):
        assert analyze(archive, "worst", "--out", str(tmp_path / f"worst.{ending}")) == 0
    path = tmp_path / "worst.geo.parquet"
    assert geoparquet_validator.failed(geoparquet_validator.check(str(path)), "core") == []
    frame = geopandas.read_parquet(path)
    assert len(geopandas.read_file(tmp_path / "worst.geojson")) == len(frame) >= 2
    page = (tmp_path / "worst.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    data = json.loads(page.split("const data = ")[1].split(";\n")[0])
    assert len(data["boxes"]) == len(data["values"]) == len(data["rows"]) == len(frame)
    assert (tmp_path / "worst.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "worst.svg").read_text()
    capsys.readouterr()


def test_a_day_becomes_a_page_with_frames(archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "day.html"
    assert analyze(archive, "replay", "--step", "21600", "--out", str(out)) == 0
    data = json.loads(out.read_text().split("const data = ")[1].split(";\n")[0])
    assert data["frames"][:2] == ["2026-01-27 06:00", "2026-01-27 12:00"]
    assert "frame 2026-01-27T06:00:00: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["colour"], "error: question: 'colour' is none; use one of grip, worst"),
        (["grip", "--out", "x.xls"], "error: out: x.xls has no known ending"),
        (["grip", "--engine", "abacus"], "error: engine: 'abacus' is none"),
        (["grip", "--bbox", "1,2"], "error: bbox: "),
        (["before-after"], "error: at: no moment"),
        (["vehicles", "--out", "x.html"], "error: out: the answer of vehicles has no place"),
        (["grip", "--out", "/nowhere/at/all.csv"], "error: out: cannot write"),
    ],
)
def test_a_wrong_word_is_one_line(
    archive: Path, words: list[str], start: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, *words) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(start)
