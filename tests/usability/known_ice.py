"""Measurement of how many known slippery places each output of the map hides, that is, shows as
unknown.

A place is a cell and a heading. It is known to be slippery if P(μ < 0.4) is above 0.5. An output of
the map is a form in which a user sees it: an answer to a query, an exported file, a picture, or a
live page. The output hides a place if it leaves the place out, gives it no value of μ, hatches it,
or draws it in the page's hollow or grey class.
"""

from __future__ import annotations

import contextlib
import io
import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Set
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeAlias

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.ipc
import pyarrow.parquet as pq
import zenoh
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from deploy.demo.compare import MapComparison
from deploy.router import open_router
from fleet_service.analytics import plots, synthetic
from fleet_service.archive.format import snapshots
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli import main
from fleet_service.client import watching
from fleet_service.fusion import Fusion
from fleet_service.page.records import CELL_LEVEL, LEAST_LEVEL
from fleet_service.replay.rebuild import Since, fusion_with_weather, replay
from fleet_service.serve.encode import arrow_stream, cell_table, encode_tile
from fleet_service.serve.view import view_cells
from schemas import grid, keys, mugrid, tables
from schemas.config import ZenohSettings
from schemas.query import Format
from schemas.thresholds import NS
from tests.benchmarks.page_stage import tiles_of
from tests.browser import open_page
from tests.fleet_service.page.conftest import page_of
from tests.structure import ROOT
from tests.waiting import until

# All roads freeze in the first night. The map is that of 04:00.
WORLD: Final = synthetic.SyntheticFleet(
    rows=24_000, days=1, vehicles=40, roads=16, length=60, icy=1
)
NOW: Final = synthetic.START_NS + 4 * 3600 * NS
KNOWN: Final = 0.5
UNKNOWN_KIND: Final = 6  # the page draws classes from this number on as unknown
Places: TypeAlias = Set[tuple[int, int]]  # cell and heading sector


class KnownIce:
    """Archive of one icy night, the map that is computed from it, and the places that this map
    knows to be slippery.

    Args:
        folder: folder for the archive and the outputs.
        is_older: True for a map in the form of older versions, in which the places `unvalued` have
            only a lower bound of friction.

    Attributes:
        archive: folder of the archive, with a stored map (snapshot).
        table: the map, with the columns of an answer to a map query.
        places: cells and headings with P(slippery) above KNOWN, computed from the beliefs.
        unvalued: those of `places` for which no vehicle reported a value of its own.
    """

    def __init__(self, folder: Path, *, is_older: bool = False) -> None:
        self.folder = folder
        self.archive = folder / "icy"
        synthetic.write_archive(self.archive, WORLD, 2000)
        compact(self.archive)
        fusion = fusion_with_weather(self.archive, 120.0, NOW)
        for _ in replay(self.archive, fusion, Since(until=NOW)):
            pass
        visited = np.flatnonzero(fusion.live.vehicles[: fusion.size] > 0)
        self.table = cell_table(fusion, visited, NOW)
        self.places, self.unvalued = _find_slippery(fusion, visited)
        if is_older:
            self.table = _hide_unvalued(self.table, self.unvalued)
        snapshots.write_snapshot(self.archive, self.table, NOW)

    def batches(self) -> Iterator[tuple[int, pa.RecordBatch]]:
        """Yield (number of the tile, rows of its cells) for each tile of the map."""
        tile = np.asarray(grid.tile_of(self.table["cell"].to_numpy()))
        for one in np.unique(tile).tolist():
            (batch,) = self.table.filter(pa.array(tile == one)).combine_chunks().to_batches()
            yield one, batch


def _find_slippery(fusion: Fusion, slots: Any) -> tuple[Places, Places]:  # noqa: ANN401 an array
    view = view_cells(fusion, slots, NOW)
    slippery = view.belief @ mugrid.SLIPPERY_SHARE > KNOWN
    every = list(zip(view.cell.tolist(), view.sector.tolist(), strict=True))
    return (
        {every[k] for k in np.flatnonzero(slippery)},
        {every[k] for k in np.flatnonzero(slippery & (view.values == 0))},
    )


def find_hidden(ice: KnownIce) -> dict[str, Places]:
    """Return, by name of the output, the known slippery places that this output of the map hides
    (shows as unknown). A correct output has an empty set.
    """
    return {
        **{f"answer, {form}": _hidden_rows(ice, _answered_rows(ice, form)) for form in Format},
        **{
            f"export {what}, {ending}": _hidden_rows(ice, _exported_rows(ice, what, ending))
            for what in ("map", "map --snapshot")
            for ending in ("parquet", "csv", "geojson")
        },
        "QGIS style": _hidden_by_style(ice),
        **{
            f"analyze replay, {ending}": _hidden_rows(ice, _replayed_rows(ice, ending))
            for ending in ("parquet", "csv", "geojson")
        },
        "analyze replay, html": _hidden_on_html(ice),
        "analyze replay, png": _hidden_on_picture(ice),
        "picture and page of the demo": _hidden_by_demo(ice),
        "fleet-service watch": _hidden_by_watch(ice),
        **_hidden_on_page(ice),
    }


def _key(row: dict[str, Any]) -> tuple[int, int]:
    return int(row["cell"]), int(row["sector"])


def _hidden_rows(ice: KnownIce, rows: list[dict[str, Any]]) -> Places:
    """Return the known slippery places that the rows of an output hide: they have no row, no μ, or
    the basis (kind of evidence) `bound`.
    """
    shown = {
        _key(row)
        for row in rows
        if row["mu"] is not None and np.isfinite(row["mu"]) and row.get("basis") != "bound"
    }
    return ice.places - shown


def _answered_rows(ice: KnownIce, form: Format) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for tile, batch in ice.batches():
        payload = encode_tile(batch, form, tile)
        if form is Format.ARROW:
            rows += pa.ipc.open_stream(payload).read_all().to_pylist()
        elif form is Format.JSON:
            rows += json.loads(payload)["cells"]
        else:
            rows += [feature["properties"] for feature in json.loads(payload)["features"]]
    return rows


def _write_file(words: list[str], out: Path) -> None:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert main([*words, "--out", str(out)]) == 0, words


def _written_rows(words: list[str], out: Path) -> list[dict[str, Any]]:
    """Run a command that writes the file `out`, and return the rows of this file."""
    _write_file(words, out)
    if out.suffix == ".csv":
        return pacsv.read_csv(out).to_pylist()
    if out.suffix == ".geojson":
        return [feature["properties"] for feature in json.loads(out.read_text())["features"]]
    return pq.read_table(out).to_pylist()


def _until() -> str:
    return f"{np.datetime64(NOW, 'ns').astype('datetime64[s]')}Z"


def _exported_rows(ice: KnownIce, what: str, ending: str) -> list[dict[str, Any]]:
    words = ["export", *what.split(), "--archive", str(ice.archive), "--to", _until()]
    return _written_rows(words, ice.folder / f"map.{ending}")


def _replay_words(ice: KnownIce) -> list[str]:
    return ["analyze", "replay", "--archive", str(ice.archive), "--at", _until()]


def _replayed_rows(ice: KnownIce, ending: str) -> list[dict[str, Any]]:
    return _written_rows(_replay_words(ice), ice.folder / f"replay.{ending}")


def _hidden_by_style(ice: KnownIce) -> Places:
    """Return the known slippery places that the QGIS style does not draw, or draws only by its rule
    for unknown cells. A rule of the style applies to the cells that satisfy its filter, an SQL
    expression; the function evaluates this expression.
    """
    text = (ROOT / "deploy" / "examples" / "gripmap.qml").read_text()
    root = ET.fromstring(text[text.index("<qgis") :])
    coloured = [
        f"({rule.get('filter')})" for rule in root.iter("rule") if rule.get("key") != "unknown"
    ]
    rows = _exported_rows(ice, "map --snapshot", "geojson")
    exported = pa.Table.from_pylist(rows)  # noqa: F841 duckdb reads this variable
    filtered: Any = duckdb.sql(f"select cell, sector from exported where {' or '.join(coloured)}")
    shown = filtered.fetchall()
    return ice.places - {(int(cell), int(sector)) for cell, sector in shown}


def _hidden_on_html(ice: KnownIce) -> Places:
    out = ice.folder / "replay.html"
    _write_file(_replay_words(ice), out)
    data = json.loads(out.read_text().split("const data = ")[1].split(";\n")[0])
    assert data["part"] is None, "one box for each row"
    west, south, east, north = np.array(data["boxes"]).T
    cells = grid.cell_of((south + north) / 2, (west + east) / 2).tolist()
    rows = zip(cells, data["sector"], data["panels"][0]["values"], strict=True)
    return ice.places - {(cell, sector) for cell, sector, value in rows if value is not None}


def _hidden_on_picture(ice: KnownIce) -> Places:
    table = pq.read_table(ice.folder / "replay.parquet")
    figure = Figure()
    plots._draw_replay(figure, table)
    hatched = [
        one
        for one in figure.axes[0].collections
        if isinstance(one, PolyCollection) and one.get_hatch()
    ]
    shapes = plots.cell_shapes(table["cell"].to_numpy(), table["sector"].to_numpy().astype(int))
    unknown = {_first_corner(path.vertices) for one in hatched for path in one.get_paths()}
    places = zip(table["cell"].to_pylist(), table["sector"].to_pylist(), strict=True)
    drawn = {
        place
        for place, shape in zip(places, shapes, strict=True)
        if _first_corner(shape) not in unknown
    }
    return ice.places - drawn


def _first_corner(shape: Any) -> bytes:  # noqa: ANN401 any kind of array
    return bytes(np.asarray(shape, np.float64)[0])


def _hidden_by_demo(ice: KnownIce) -> Places:
    values = MapComparison(ice.table, np.zeros(ice.table.num_rows)).values
    rows = zip(ice.table.select(["cell", "sector"]).to_pylist(), values.tolist(), strict=True)
    return ice.places - {_key(row) for row, mu in rows if np.isfinite(mu)}


def _hidden_by_watch(ice: KnownIce) -> Places:
    """Return the known slippery places that the command `watch` hides. For each map tile, `watch`
    prints a count of slippery cells and a count of measured cells. If either count is smaller than
    the number of known slippery places in the tile, all these places are returned as hidden.
    """
    found: set[tuple[int, int]] = set()
    for tile, batch in ice.batches():
        document = json.loads(watching._tile_line(tile, pa.Table.from_batches([batch]), True))
        own = {place for place in ice.places if int(grid.tile_of(place[0])) == tile}
        if document["slippery"] < len(own) or document["measured"] < len(own):
            found |= own
    return found


@contextmanager
def serve_page(ice: KnownIce) -> Iterator[str]:
    """Yield the address of a live page that has received the map from Zenoh."""
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    with router, page_of(ZenohSettings(connect=endpoints), archive=ice.archive) as address:
        tiles = dict(ice.batches())
        until(lambda: _put_missing(router, tiles, address))
        yield address


def _put_missing(router: zenoh.Session, tiles: dict[int, pa.RecordBatch], address: str) -> bool:
    """Publish all map tiles to the live page. Return True if the page has already received all of
    them.
    """
    for tile, batch in tiles.items():
        router.put(keys.map_key(tile), arrow_stream(batch))
    return tiles_of(address) == len(tiles)


def _hidden_on_page(ice: KnownIce) -> dict[str, Places]:
    """Return, by form of drawing, the places that the live page hides (draws hollow, grey or not at
    all). The forms are ribbons, cells and squares of each zoom level, for the present map and for a
    past map.
    """
    names = sorted(ice.places)
    ordered = [[int(grid.tile_of(cell)), cell & 0x3FFF, sector] for cell, sector in names]
    found: dict[str, Places] = {}
    with serve_page(ice) as address:
        for what, state in (("page", ""), ("page, past", f"#at={NOW // NS}")):
            with open_page(address + state) as seen:
                seen.page.wait_for_selector("body[data-ready]", state="attached")
                until(lambda: seen.drawn_count)
                for name, kinds in seen.page.evaluate(_KINDS, [ordered, LEAST_LEVEL]).items():
                    shown = [UNKNOWN_KIND > kind >= 0 for kind in kinds]
                    hidden = {n for n, is_shown in zip(names, shown, strict=True) if not is_shown}
                    found[f"{what}, {name}"] = hidden
    return found


# Class in which each place (tile, cell within it, heading) is drawn; -1 if it is not drawn. The
# script uses cells of its own, because the open page changes those of its state.
_KINDS: Final = """async ([places, least]) => {
  const { Cells } = await import("/static/cells.js"), found = {};
  const { setColours } = await import("/static/colours.js");
  setColours(gripmap.settings);
  const cells = new Cells(gripmap.state.cells.at);
  await cells.list();
  const world = [...cells.known];
  const at = (tile, local) => {
    for (let k = 0; k < tile.rows.count; k++) {
      if (tile.rows.place[k] >> 2 === local) return tile.kind[k];
    }
    return -1;
  };
  for (let level = CELLS; level >= least; level--) {
    cells.tiles.clear();
    await cells.fetch(world, level);
    found[`squares of level ${level}`] = places.map(([tile, local]) =>
      cells.tiles.has(tile) ? at(cells.tiles.get(tile).squares, local >> 2 * (CELLS - level)) : -1);
  }
  cells.tiles.clear();
  await cells.fetch(world, CELLS);
  const own = ([tile, local, sector]) => {
    const { rows, kind } = cells.tiles.get(tile)?.parts ?? { rows: { count: 0 } };
    for (let k = 0; k < rows.count; k++) {
      if (rows.place[k] === local * 4 + sector) return kind[k];
    }
    return -1;
  };
  found.cells = places.map(own);
  await gripmap.updates.loadRoads();
  if (gripmap.state.roads.lines.length) {
    const { columnOf, rowOf } = await import("/static/grid.js");
    const all = { west: 0, east: 1, north: 0, south: 1 };
    const { passing } = await import("/static/paint.js");
    const valued = passing({ oldest: 0, bounds: false });
    const filters = { ribbons: null, "ribbons without bounds": valued };
    for (const [name, passes] of Object.entries(filters)) {
      gripmap.state.roads.lay([...cells.tiles.values()], passes, new Array(8).fill(0), all);
      found[name] = places.map(place => {
        const [tile, local, sector] = place;
        const column = columnOf(tile) * 128 + columnOf(local);
        const row = rowOf(tile) * 128 + rowOf(local);
        const piece = gripmap.state.roads.pieceOf(column, row, sector);
        return piece ? gripmap.state.roads.lanes[piece[0]].kind[piece[1]] : own(place);
      });
    }
  }
  return found;
}""".replace("CELLS", str(CELL_LEVEL))


def _hide_unvalued(table: pa.Table, unvalued: Places) -> pa.Table:
    """Return the map as an older version of the service would answer: for the places `unvalued` it
    has only a lower bound of friction, and no value of mu.
    """
    rows = table.select(["cell", "sector"]).to_pylist()
    bound = pa.array([_key(row) in unvalued for row in rows])
    for name, other in (("basis", "bound"), ("mu", None)):
        field = tables.MAP_SCHEMA.field(name)
        held = pc.if_else(bound, pa.scalar(other, field.type), table[name])
        table = table.set_column(table.schema.get_field_index(name), field, held)
    return table
