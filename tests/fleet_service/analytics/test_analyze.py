"""Tests of the command `analyze` as a user types it. Every question (predefined query) must print a
table, files must be written completely or not at all, and a mistake must give one line.
"""

from __future__ import annotations

import json
import re
import struct
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import geopandas
import geoparquet_validator
import ibis
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics import library
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.archive.export import extract
from fleet_service.archive.format import geo
from fleet_service.cli import main
from schemas import tables
from schemas.errors import InputError
from tests.fleet_service.examples import CELL
from tests.structure import ROOT

DAYS = ("--from", "2026-01-27", "--to", "2026-01-29")


def analyze(archive: Path, *words: str) -> int:
    return main(["analyze", words[0], "--archive", str(archive), *DAYS, *words[1:]])


# The question "contract" needs roads; roads/test_contract.py covers it.
@pytest.mark.parametrize("name", sorted(set(QUESTIONS) - {"contract"}))
def test_every_question_prints_a_table_and_its_input(
    archive: Path, stations: Path, name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    more = {"before-after": ["--at", "2026-01-28"], "weather": ["--stations", str(stations)]}.get(
        name, []
    )
    out = tmp_path / "answer.parquet"
    assert analyze(archive, name, *more, "--out", str(out)) == 0
    captured = capsys.readouterr()
    assert captured.err.startswith(f"{name}: 2 files, 24,000 observations\n")
    lines = captured.out.splitlines()
    answer = pq.read_table(out)
    flat = [f.name for f in answer.schema if not pa.types.is_nested(f.type)]
    # The printed table has the cell's centre in place of its number.
    place = ("latitude", "longitude")
    assert [name for name in lines[0].split() if name not in place] == [
        name for name in flat if name not in place
    ]
    assert lines[-1].startswith(f"{answer.num_rows} rows")
    assert set(answer.column_names) == {"frame"} | MAP if name == "replay" else list_explained(name)


def test_rows_not_shown_name_the_option_unless_it_was_given(
    archive: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert analyze(archive, "grip") == 0
    assert capsys.readouterr().out.endswith(" not shown (--out writes all)\n")
    assert analyze(archive, "grip", "--out", str(tmp_path / "grip.csv")) == 0
    assert capsys.readouterr().out.endswith(" not shown\n")


# Columns of the map that map-columns.md explains; tests/deploy/test_docs.py checks it.
MAP = {field.name for field in tables.MAP_CELL}


def list_explained(question: str) -> set[str]:
    """Return the answer columns of a question (predefined query) that its documentation
    explains.
    """
    page = (ROOT / "deploy" / "docs" / "reference" / "questions.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if line.startswith(f"| `{question}` |")]
    assert all(row[4].strip() for row in rows)
    return {name for row in rows for name in re.findall(r"`(\w+)`", row[2])}


def test_empty_box_names_the_box_of_the_archive(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, "grip", "--bbox", "0,0,1,1") == 0
    stderr = capsys.readouterr().err
    covered = re.search(r"no cell lies in this box; the archive covers --bbox ([\d.,-]+)\n", stderr)
    assert covered is not None
    west, south, east, north = covered[1].split(",")
    assert analyze(archive, "grip", "--bbox", f"{south},{west},{north},{east}") == 0
    assert "longitude comes before latitude" in capsys.readouterr().err


def test_roads_name_the_roads_of_an_answer(
    archive: Path, links: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, "worst", "--roads", str(links), "--json") == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert rows
    named = [row["road"] for row in rows if row["road"]]
    assert named
    assert set(named) <= set(pq.read_table(links)["name"].to_pylist())


def test_trend_compares_months_in_the_same_cells() -> None:
    """The answer to the question `trend` must show that one cell became 0.2 more slippery from one
    month to the next. A second cell has reports of only one month and must not count.
    """
    rows = [
        ("2026-01-10", 1, "a", 0.8),
        ("2026-01-11", 1, "b", 0.9),
        ("2026-02-10", 1, "a", 0.6),
        ("2026-02-11", 1, "b", 0.7),
        ("2026-02-11", 2, "b", 0.2),
    ]
    days = [datetime.fromisoformat(f"{day}T12:00:00+00:00") for day, *_ in rows]
    mu = [row[3] for row in rows]
    table = ibis.memtable(
        pa.table(
            {
                "day": pa.array([day.date() for day in days]),
                "time": [int(day.timestamp()) for day in days],
                "cell": [row[1] for row in rows],
                "sector": [0] * len(rows),
                "vehicle": [row[2] for row in rows],
                "mu": mu,
                "mu_utilised": mu,
            }
        )
    )
    engine: Any = SimpleNamespace(
        observations=lambda: table, answer=lambda expression: expression.to_pyarrow()
    )
    january, february = QUESTIONS["trend"].ask(engine, Options()).to_pylist()
    assert (january["values"], january["difference"]) == (2, None)
    assert february["share_slippery"] == pytest.approx(1 / 3)
    assert february["difference"] == pytest.approx(-0.2)
    assert february["cells"] == 1


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
    assert len(data["panels"][0]["values"]) == len(data["rows"]) == len(frame)
    assert (
        len(data["boxes"]) == frame["cells"].sum() == sum(len(one.geoms) for one in frame.geometry)
    )
    assert (tmp_path / "worst.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "worst.svg").read_text()
    capsys.readouterr()


def test_a_day_becomes_a_page_with_frames(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "day.html"
    assert analyze(archive, "replay", "--step", "21600", "--out", str(out)) == 0
    data = json.loads(out.read_text().split("const data = ")[1].split(";\n")[0])
    assert data["frames"][:2] == ["2026-01-27 06:00:00", "2026-01-27 12:00:00"]
    assert "frame 2026-01-27T06:00:00: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["colour"], "error: question: 'colour' is unknown; use one of grip, worst"),
        (["grip", "--out", "x.xls"], "error: out: x.xls has no known ending"),
        (["grip", "--engine", "abacus"], "error: engine: 'abacus' is unknown"),
        (["grip", "--bbox", "1,2"], "error: bbox: "),
        (["before-after"], "error: at: the time of the treatment"),
        (["vehicles", "--out", "x.html"], "error: out: the answer of vehicles has no coordinates"),
        (["grip", "--out", "/nowhere/at/all.csv"], "error: out: cannot write"),
    ],
)
def test_a_wrong_word_is_one_line(
    archive: Path, words: list[str], start: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, *words) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(start)


def test_the_first_question_as_geojson_has_its_days_as_text(archive: Path, tmp_path: Path) -> None:
    assert analyze(archive, "grip", "--out", str(tmp_path / "grip.geojson")) == 0
    first = json.loads((tmp_path / "grip.geojson").read_text())["features"][0]
    assert first["properties"]["day"] in ("2026-01-27", "2026-01-28")
    assert first["geometry"]["type"] == "Polygon"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--at", "2200-01-01"], "error: at: lies in the future; "),
        (["--to", "2200-01-01"], "error: to: lies in the future; "),
        (["--at", "2026-01-27", "--step", "600"], "error: step: cannot be combined with --at; "),
    ],
)
def test_replay_refuses_a_future_map_and_a_time_with_a_step(
    archive: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, "replay", *options) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(message)


@pytest.mark.parametrize(
    ("field", "options"),
    [
        ("bbox", {"bbox": (12.1, 57.8, 11.9, 57.6)}),
        ("bbox", {"bbox": (11.9, 57.6, 12.1)}),
        ("period", {"period": "2026-01-27"}),
        ("period", {"period": ("2026-01-28", "2026-01-27")}),
    ],
)
def test_library_names_a_wrong_box_or_period(
    archive: Path, field: str, options: dict[str, Any]
) -> None:
    with pytest.raises(InputError) as error:
        library.ask_archive(archive, "grip", **options)
    assert error.value.field == field


def test_library_takes_datetimes_and_refuses_a_future_map(archive: Path) -> None:
    begin = datetime(2026, 1, 28, tzinfo=UTC)
    found = library.ask_archive(archive, "grip", period=(begin, None))  # type: ignore[arg-type]
    assert set(found["day"].to_pylist()) == {begin.date()}
    with pytest.raises(InputError, match="at: lies in the future"):
        library.map_of_archive(archive, at="2200-01-01")


@pytest.mark.parametrize("step", ["-5", "0.0001", "nan", "inf"])
def test_a_step_that_is_none_is_refused_at_once(
    archive: Path, step: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analyze(archive, "replay", "--step", step) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: step: ")


def test_frames_begin_with_the_first_report_and_too_many_are_refused(
    archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["analyze", "replay", "--archive", str(archive), "--to", "2026-01-27T06:00"]
    assert main([*command, "--step", "10800"]) == 0
    frames = [line for line in capsys.readouterr().err.splitlines() if line.startswith("frame")]
    assert frames[0].startswith("frame 2026-01-27T03:00:00: ")
    assert main([*command, "--step", "10"]) == 2
    assert "error: step: makes 2129 frames from 2026-01-27T00:05:10 on" in capsys.readouterr().err


def test_a_file_that_could_not_be_finished_is_none(tmp_path: Path) -> None:
    table = geo.with_cells(pa.table({"cell": [CELL], "odd": [b"\x00"], "mu": [float("nan")]}))
    path = tmp_path / "a.geojson"
    path.write_text("as it was")
    broken = table.set_column(
        table.schema.get_field_index("geometry"), "geometry", pa.array([b"\x01"])
    )
    with pytest.raises((ValueError, struct.error)):
        extract.write_extract(broken, path)
    assert path.read_text() == "as it was"
    assert [one.name for one in tmp_path.iterdir()] == ["a.geojson"]
