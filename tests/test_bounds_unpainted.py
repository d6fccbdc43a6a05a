"""Tests that no form of output gives a colour value to unmeasured cells, so that unknown road is
never shown as dry.

If only lower bounds of a cell's μ are known, or a report used little grip, the median of μ is
mostly the prior's. This median has the colour of wet asphalt, so it must not be shown as a colour.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import duckdb
import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.ipc
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics import output, synthetic
from fleet_service.analytics.plots import paint_cells
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.archive.format import readme, snapshots
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli import main
from fleet_service.fusion import Fusion
from fleet_service.serve.encode import cell_table, encode_tile
from schemas import grid
from schemas.query import Format
from tests.fleet_service.examples import CELL, START, at_least, observations, value

ROOT: Final = Path(__file__).parents[1]
WORLD: Final = synthetic.SyntheticFleet(rows=6000, days=1, vehicles=20, roads=4, length=30, icy=2)
END: Final = "2026-01-28"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive with measurements of friction and with lower bounds of friction. As in
    files before version 1.2, its stored map (snapshot) states a value of mu even for a cell that
    has only a lower bound.
    """
    root = tmp_path_factory.mktemp("bounds") / "archive"
    synthetic.write_archive(root, WORLD, 2000)
    compact(root)
    rollup.complete_parts(root)
    tile = two_cells()
    old = tile.set_column(
        tile.schema.get_field_index("mu"), "mu", pa.array([0.7, 0.7], pa.float32())
    )
    snapshots.write_snapshot(root, old, synthetic.START_NS + 20 * 3600 * 10**9)
    return root


def two_cells() -> pa.Table:
    """Return a map table with one measured cell and one cell with only a lower bound of
    friction.
    """
    fusion = Fusion(120.0)
    likelihoods = np.concatenate([value([0.3]), at_least([0.15])])
    fusion.update(observations(np.array([0, 1]), np.array([0, 1]), likelihoods, [CELL, CELL + 1]))
    table = cell_table(fusion, np.arange(2), START + 10**9)
    assert set(table["basis"].to_pylist()) == {"bound", "measured"}, "nothing is shown by this"
    return table


def find_painted(
    rows: list[dict[str, Any]], known: Callable[[dict[str, Any]], bool], *names: str
) -> list[dict[str, Any]]:
    """Return the rows of an exported map that look measured but are not. For such a row, `known`
    returns False, but one of the columns `names` has a number. Fail if the map has no measured or
    no unmeasured rows.
    """
    bounds = [row for row in rows if not known(row)]
    assert bounds
    assert any(known(row) and row[names[0]] is not None for row in rows)
    return [
        row
        for row in bounds
        if any(isinstance(row[name], float) and np.isfinite(row[name]) for name in names)
    ]


def is_measured(row: dict[str, Any]) -> bool:
    return bool(row["basis"] == "measured")


@pytest.mark.parametrize("form", Format)
def test_an_answer_of_the_service_has_no_mu_for_a_bound(form: Format) -> None:
    (batch,) = two_cells().to_batches()
    payload = encode_tile(batch, form, int(grid.tile_of(CELL)))
    if form is Format.ARROW:
        rows = pa.ipc.open_stream(payload).read_all().to_pylist()
    elif form is Format.JSON:
        rows = json.loads(payload)["cells"]
    else:
        rows = [feature["properties"] for feature in json.loads(payload)["features"]]
    assert find_painted(rows, is_measured, "mu") == []
    assert all(row["mu_lower"] < row["mu_upper"] for row in rows), "the interval stays"


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of an exported file (CSV, GeoJSON or Parquet) as dictionaries."""
    if path.suffix == ".csv":
        return pacsv.read_csv(path).to_pylist()
    if path.suffix == ".geojson":
        return [feature["properties"] for feature in json.loads(path.read_text())["features"]]
    geopandas.read_parquet(path)
    return pq.read_table(path).to_pylist()


@pytest.mark.parametrize("ending", ["parquet", "geojson", "csv"])
@pytest.mark.parametrize("what", ["map", "map --snapshot", "observations", "rollup"])
def test_an_export_has_no_mu_for_a_bound(
    archive: Path, tmp_path: Path, what: str, ending: str
) -> None:
    out = tmp_path / f"a.{ending}"
    assert (
        main(["export", *what.split(), "--archive", str(archive), "--to", END, "--out", str(out)])
        == 0
    )
    if what.startswith("map"):
        assert find_painted(read_rows(out), is_measured, "mu") == []
    elif what == "observations":
        assert find_painted(read_rows(out), lambda row: bool(row["value"]), "mu") == []
    else:
        rows = read_rows(out)
        of_mu = ("value_sum", "mu_sum", "mu_sum_squares", "mu_min", "mu_max")
        assert find_painted(rows, lambda row: bool(row["value_count"]), *of_mu) == []


@pytest.mark.parametrize("question", ["replay", "grip"])
@pytest.mark.parametrize("ending", ["geo.parquet", "geojson", "csv", "html"])
def test_an_answer_of_the_archive_has_no_mu_for_a_bound(
    archive: Path, tmp_path: Path, question: str, ending: str
) -> None:
    out = tmp_path / f"a.{ending}"
    assert (
        main(["analyze", question, "--archive", str(archive), "--to", END, "--out", str(out)]) == 0
    )
    colour = QUESTIONS[question].colour
    assert colour is not None
    known = is_measured if question == "replay" else lambda row: bool(row["values"])
    if ending == "html":
        data = json.loads(out.read_text().split("const data = ")[1].split(";\n")[0])
        basis, *_ = (k for k, name in enumerate(data["names"]) if name in ("basis", "values"))
        rows = [
            {"basis": row[basis], "values": row[basis] != "0", "colour": number}
            for row, number in zip(data["rows"], data["panels"][0]["values"], strict=True)
        ]
        assert find_painted(rows, known, "colour") == []
    else:
        assert find_painted(read_rows(out), known, colour) == []


def test_unmeasured_cells_are_hatched_in_a_picture() -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    shapes = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]] * 3)
    colours = paint_cells(axes, shapes, np.array([0.2, np.nan, np.nan]))
    hatched = next(one for one in axes.collections if one is not colours)
    assert len(colours.get_paths()) == 1
    assert len(hatched.get_paths()) == 2
    assert hatched.get_hatch()
    faces: Any = hatched.get_facecolor()
    assert faces.tolist() == [[1.0, 1.0, 1.0, 1.0]]


@pytest.mark.parametrize("page", ["deploy/docs/tutorials/first-analysis.md", "archive"])
def test_the_sql_of_the_pages_takes_values_only(
    archive: Path, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = readme.page_text() if page == "archive" else (ROOT / page).read_text()
    (sql,) = re.findall(r"duckdb\.sql\((?:\"{3}|'{3})(.*?)(?:\"{3}|'{3})", text, re.DOTALL)
    monkeypatch.chdir(archive)
    ask: Callable[[str], Any] = duckdb.sql
    found = ask(re.sub(r"'[a-z/]*observations/", "'observations/", sql)).to_arrow_table()
    valued = ask(
        "select distinct cell, sector from 'observations/*/*/*.parquet' where value"
    ).fetchall()
    rows = found.to_pylist()
    assert {(row["cell"], row["sector"]) for row in rows if row["mu"] is not None} == set(valued)
    assert any(row["mu"] is None for row in rows)


def test_rows_of_older_files_are_values_by_the_same_rule(archive: Path) -> None:
    (path, *_) = sorted((archive / "observations").rglob("*.parquet"))
    table = pq.read_table(path, partitioning=None)
    by_rule = table["mu_utilised"].to_numpy() >= 0.6 * table["mu"].to_numpy() - 1e-6
    assert table["value"].to_pylist() == by_rule.tolist()
    assert 0 < by_rule.sum() < len(by_rule)


def test_a_page_of_an_answer_without_rows_is_still_a_page(tmp_path: Path) -> None:
    columns: dict[str, Any] = {
        "cell": pa.int64(),
        "sector": pa.int8(),
        "mu": pa.float32(),
        "p_slippery": pa.float32(),
    }
    empty = pa.schema([pa.field(name, kind) for name, kind in columns.items()]).empty_table()
    assert "<title>" in output.make_page(empty, QUESTIONS["replay"])
