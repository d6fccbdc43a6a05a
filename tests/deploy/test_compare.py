"""Tests of the demo's figures and pictures, on small made-up drives and maps. Each figure must
follow its definition, and the demo must fail only if a mandatory target is missed.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from deploy.demo import compare, page, picture
from deploy.demo.ice import NewIce, new_ice
from deploy.demo.story import report_figures
from edge_agent.lab.simulation.friction import Patch
from edge_agent.lab.simulation.scenarios import scenario_named
from schemas import grid
from schemas.runtime.figures import Figure
from schemas.wire import Alert
from tests.browser import open_page

S = 1_000_000_000


def make_visits(*rows: tuple[str, float, int, float, float]) -> pa.Table:
    """Return a table of visits (passes of a vehicle through a map cell), each half a second long,
    in heading sector 0. The columns are vehicle, second, cell, friction mu, and utilisation (used
    share of the friction).
    """
    vehicle, at, cell, mu, used = zip(*rows, strict=True)
    enter = np.array([int(second * S) for second in at])
    return pa.table(
        {
            "vehicle": list(vehicle),
            "enter_time": pa.array(enter, pa.timestamp("ns", "UTC")),
            "leave_time": pa.array(enter + S // 2, pa.timestamp("ns", "UTC")),
            "cell": list(cell),
            "sector": pa.array([0] * len(rows), pa.int8()),
            "mu": list(mu),
            "utilisation": list(used),
        }
    )


def make_tile(cells: list[int], lower: float, upper: float) -> pa.Table:
    n = len(cells)
    return pa.table(
        {
            "cell": cells,
            "sector": pa.array([0] * n, pa.int8()),
            "mu": [(lower + upper) / 2] * n,
            "mu_lower": [lower] * n,
            "mu_upper": [upper] * n,
            "p_slippery": [0.1] * n,
            "vehicles": [2] * n,
            "observations": [3] * n,
            "basis": ["measured"] * n,
            "latitude": [57.7] * n,
            "longitude": [11.97] * n,
            "west": [11.97 + 1e-4 * i for i in range(n)],
            "south": [57.7] * n,
            "east": [11.9701 + 1e-4 * i for i in range(n)],
            "north": [57.7001] * n,
        }
    )


def make_alert(cell: int) -> Alert:
    return Alert(cell, 0, True, 0, 0.2, 0.1, 0.3, 0.95, 2, 57.7, 11.97, "test")


def test_the_truth_is_the_friction_after_the_change_where_there_is_one() -> None:
    road = make_visits(
        ("a", 1, 7, 0.9, 0.1), ("a", 11, 7, 0.2, 0.1), ("b", 12, 7, 0.3, 0.1), ("a", 2, 8, 0.6, 0.1)
    )
    assert compare.final_truth(road, 10 * S) == pytest.approx({(7, 0): 0.25, (8, 0): 0.6})


def test_a_cell_without_a_truth_is_left_out() -> None:
    found = compare.compare(
        make_tile([7, 99], 0.1, 0.4), make_visits(("a", 11, 7, 0.2, 0.1)), 10 * S
    )
    assert found.cells["cell"].to_pylist() == [7]
    assert found.is_covered.tolist() == [True]


def test_passes_count_excited_drives_over_the_patch_until_its_alert() -> None:
    road = make_visits(
        ("z", 1, 7, 0.9, 0.9),
        ("z", 2, 8, 0.9, 0.9),  # this road was not slippery
        ("a", 11, 7, 0.2, 0.9),
        ("a", 12, 8, 0.2, 0.9),  # one pass of vehicle a over two cells
        ("b", 20, 7, 0.2, 0.9),
        ("c", 21, 7, 0.2, 0.1),  # vehicle c only rolled over it
        ("a", 40, 7, 0.2, 0.9),
        ("d", 60, 7, 0.2, 0.9),  # vehicle d comes after the alert
    )
    ice = NewIce(10 * S, np.array([7, 8]))
    assert compare.delay_passes(road, ice, [(50 * S, make_alert(7))]) == 3.0


def test_an_alert_elsewhere_or_none_at_all_is_an_infinite_delay() -> None:
    road = make_visits(("a", 11, 7, 0.2, 0.9))
    ice = NewIce(10 * S, np.array([7]))
    assert compare.delay_passes(road, ice, [(50 * S, make_alert(99))]) == float("inf")
    assert compare.delay_passes(road, ice, []) == float("inf")


def test_visits_to_new_ice_begin_when_it_appears() -> None:
    road = make_visits(
        ("a", 2, 8, 0.9, 0.9),
        ("a", 11, 7, 0.2, 0.9),  # old snow
        ("a", 12, 8, 0.2, 0.9),
        ("b", 13, 8, 0.5, 0.9),  # beside the ice, in the same cell
        ("b", 14, 10, 0.2, 0.9),  # elsewhere
    )
    new = NewIce(10 * S, np.array([8])).find_visits(road)
    assert new.tolist() == [False, False, True, False, False]


def test_new_ice_is_where_a_dry_or_wet_road_becomes_slippery() -> None:
    """Ice appears on dry road, and on snow that was there before. Only the cells with dry road
    before are new ice: the snow was slippery already.
    """
    road = replace(
        scenario_named("test"),
        background=0.9,
        patches=(
            Patch("old snow", 100.0, 0.0, 40.0, 40.0, 0.35),
            Patch("ice on dry road", 0.0, 0.0, 40.0, 10.0, 0.15, start=30.0),
            Patch("ice on snow", 100.0, 0.0, 20.0, 10.0, 0.15, start=30.0),
        ),
    )
    ice = new_ice(road, 5 * S)

    def cell_at(x: float, y: float) -> int:
        return int(grid.cell_of(*road.to_latlon(np.array([x]), np.array([y])))[0])

    assert ice.since_ns == 35 * S
    assert np.isin([cell_at(0.0, 0.0), cell_at(-15.0, 3.0)], ice.cells).all()
    assert not np.isin([cell_at(100.0, 0.0), cell_at(60.0, 0.0)], ice.cells).any()


def test_picture_and_page_are_written_and_no_value_can_end_the_script(tmp_path: Path) -> None:
    found = compare.compare(
        make_tile([7, 8], 0.1, 0.4),
        make_visits(("a", 11, 7, 0.2, 0.1), ("a", 12, 8, 0.5, 0.1)),
        10 * S,
    )
    basis = found.cells.schema.get_field_index("basis")
    hostile = replace(
        found, cells=found.cells.set_column(basis, "basis", [["</script><!--<script>", "measured"]])
    )
    picture.draw_maps(found, tmp_path / "map.png")
    page.write_page(hostile, [Figure("demo.map.rmse", 0.09, "", 0.12)], tmp_path / "map.html")
    assert (tmp_path / "map.png").stat().st_size > 10_000
    text = (tmp_path / "map.html").read_text()
    assert text.count("</script>") == 1
    data = json.loads(text.split("const data = ")[1].split(";\n")[0])
    assert [row[4] for row in data["rows"]] == ["</script><!--<script>", "measured"]
    assert "<!--" not in text
    truth, shown = data["panels"]
    assert (truth["name"], truth["values"]) == ("truth", [0.2, 0.5])
    assert (shown["name"], shown["values"]) == ("map", [None, pytest.approx(0.25)])
    assert "http" not in text


def test_demo_page_opens_in_a_browser_with_both_maps_and_figures(tmp_path: Path) -> None:
    found = compare.compare(
        make_tile([7, 8], 0.1, 0.4),
        make_visits(("a", 11, 7, 0.2, 0.1), ("a", 12, 8, 0.5, 0.1)),
        10 * S,
    )
    basis = found.cells.schema.get_field_index("basis")
    found = replace(found, cells=found.cells.set_column(basis, "basis", [["bound", "measured"]]))
    page.write_page(found, [Figure("demo.map.rmse", 0.09, "", 0.12)], tmp_path / "map.html")
    with open_page(tmp_path / "map.html") as shown:
        assert shown.errors == []
        assert shown.drawn_count == 4
        assert len(shown.count_colours(0)) >= 2
        assert len(shown.count_colours(1)) > 2, "a colour, and the hatching with its white"
        assert shown.page.locator("#unknown").is_visible()
        assert "demo.map.rmse" in shown.page.locator("#table").inner_text()


def test_lost_grip_on_new_ice_is_counted_by_passes_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Count drivers that lose grip on new ice. After the first alert, two warned drivers and one
    unwarned driver pass over the ice: these three passes must be counted, and the earlier passes
    must not.
    """
    driven = make_visits(
        ("sim-001", 1.0, 7, 0.9, 0.5),
        ("sim-002", 11.0, 7, 0.2, 1.0),
        ("sim-001", 31.0, 7, 0.2, 0.6),
        ("sim-001", 32.0, 7, 0.2, 0.99),
        ("sim-002", 33.0, 7, 0.2, 1.0),
        ("sim-004", 40.0, 7, 0.2, 0.7),
    )
    alerts = [(20 * S, Alert(7, 0, True, 20 * S, 0.2, 0.1, 0.3, 0.95, 2, 0.0, 0.0, "ice"))]
    ice = NewIce(10 * S, np.array([7]))
    grip = compare.lost_grip(driven, alerts, ice, 0.5)
    assert sorted(zip(grip.warned.tolist(), grip.lost.tolist(), strict=True)) == [
        (False, True),
        (True, False),
        (True, True),
    ]
    assert (
        grip.line()
        == "On the new ice, after it was known: 1 of 2 warned drivers lost grip, and 1 of 1 "
        "unwarned drivers."
    )
    unheard = compare.lost_grip(driven, [], ice, 0.5)
    assert not len(unheard.lost), "nobody knew of it"
    assert {one.name: one.value for one in unheard.figures()} == {
        "demo.passes.warned": 0,
        "demo.passes.unwarned": 0,
    }
    assert not any(one.holds for one in unheard.figures())
    assert compare.demo_works(unheard.figures()), "few passes are no failure of the demo"
    found = compare.MapComparison(make_tile([7, 8], 0.1, 0.3), np.array([0.2, 0.2]))
    figures = report_figures(tmp_path, found, [Figure("demo.map.rmse", 0.09, "", 0.12)], grip, 1)
    assert grip.line() in capsys.readouterr().out
    shares = {figure.name: figure.value for figure in figures}
    assert (shares["demo.lost_grip.warned"], shares["demo.lost_grip.unwarned"]) == (0.5, 1.0)
    assert [row["name"] for row in json.loads((tmp_path / "figures.json").read_text())[1:]] == list(
        shares
    )
    picture.draw_maps(found, tmp_path / "without.png")
    assert (tmp_path / "map.png").read_bytes() != (tmp_path / "without.png").read_bytes()


@pytest.mark.parametrize(
    ("name", "value", "works"),
    [
        (compare.COVERAGE, 0.95, True),
        (compare.COVERAGE, 0.995, True),
        (compare.COVERAGE, 0.79, False),
        (compare.COVERAGE, float("nan"), False),
        (compare.DELAY, 6, True),
        ("demo.observations.duplicates", 1, False),
    ],
)
def test_demo_fails_if_a_promise_is_broken(name: str, value: float, works: bool) -> None:
    among = Figure(name, value, "", 0)
    if name == compare.COVERAGE:
        among = Figure(name, value, "", (0.8, compare.WIDEST), "within")
    assert compare.demo_works([Figure("demo.vehicles", 36, "", 30, "more"), among]) == works
