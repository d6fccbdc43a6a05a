"""Tests of each question (predefined query): the answer equals one computed in pandas or plain
Python, and finds the events that the synthetic archive contains.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics import synthetic
from fleet_service.analytics.questions.worst import join_stretches, wilson_lower
from fleet_service.analytics.synthetic import START_NS
from fleet_service.archive.export.extract import Extract
from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import Since, replay
from fleet_service.serve.encode import cell_table
from schemas import grid
from schemas.errors import InputError
from schemas.thresholds import Z_95
from tests.fleet_service.analytics.agreement import Order
from tests.fleet_service.analytics.conftest import HOUR_NS, PART, WORLD, find_visited

Ask = Callable[..., pa.Table]
PLACE = ["cell", "sector"]


def test_grip_gives_the_percentiles_of_values_per_cell_and_day(
    asked: Ask, rows: pd.DataFrame
) -> None:
    table = asked("grip")
    found = table.to_pandas().set_index(["day", *PLACE]).sort_index()
    rows = rows.assign(day=rows["leave_time"].dt.date)
    groups = rows.groupby(["day", *PLACE])
    assert found["observations"].to_dict() == groups.size().to_dict()
    assert found["vehicles"].to_dict() == groups["vehicle"].nunique().to_dict()
    measured = rows[rows["value"]].groupby(["day", *PLACE])["mu"]
    for name, q in (("mu_p10", 0.1), ("mu_p50", 0.5), ("mu_p90", 0.9)):
        expected = measured.quantile(q).reindex(found.index)
        np.testing.assert_allclose(found[name].astype(float), expected, atol=1e-9)
    first = table.schema.metadata[b"report"].decode().splitlines()[0]
    network = len(rows.drop_duplicates(PLACE))
    day = rows[rows["day"] == rows["day"].min()]
    share = len(day[day["value"]].drop_duplicates(PLACE)) / network
    assert first.startswith(f"2026-01-27: {share:.0%} of {network} cells measured")


def test_worst_finds_the_planted_ice_and_only_it(asked: Ask) -> None:
    found = asked("worst").to_pandas()
    assert len(found) >= 2
    assert found["score"].is_monotonic_decreasing
    step = 360 / 2**21
    height = step * np.cos(np.radians(synthetic.LATITUDE))
    for row in found.itertuples():
        assert (
            22
            < (row.west - synthetic.LONGITUDE) / step
            < (row.east - synthetic.LONGITUDE) / step
            < 39
        )
        assert min(abs((row.south - synthetic.LATITUDE) / height - line) for line in (130, 650)) < 3
        metres = np.hypot((row.east - row.west) * 59_400, (row.north - row.south) * 111_195)
        assert row.length_m == pytest.approx(metres, rel=0.01)
        assert 0 < row.share_lower < row.share_slippery <= 1


def test_touching_cells_of_one_sector_are_one_stretch() -> None:
    x = np.array([100, 101, 102, 104, 100])
    cell = grid.interleave(x, np.array([7, 8, 8, 8, 9]))
    table = pa.table(
        {
            "cell": cell,
            "sector": pa.array([0, 0, 0, 0, 1], pa.int8()),
            "observations": [5] * 5,
            "values": [4] * 5,
            "slippery": [4, 2, 4, 4, 4],
            "mu_sum": [1.0, 0.5, 1.0, 1.0, 1.0],
            "witnesses": [2] * 5,
        }
    )
    found = join_stretches(table)
    assert sorted(found["cells"].to_numpy().tolist()) == [1, 1, 3]
    row = found.to_pylist()[found["cells"].to_pylist().index(3)]
    assert (row["exposure"], row["values"], row["share_slippery"], row["mu"]) == (
        15,
        12,
        pytest.approx(10 / 12),
        0.25,
    )
    assert join_stretches(table.slice(0, 0)).num_rows == 0


def test_the_bound_of_a_share_is_wilson_s() -> None:
    z = Z_95
    for hits, of in ((3, 10), (10, 10), (0, 5)):
        lower = wilson_lower(np.array([hits]), np.array([of]))[0]
        assert (hits / of - lower) ** 2 == pytest.approx(z**2 * lower * (1 - lower) / of, abs=1e-12)


@pytest.mark.campaign
def test_spells_are_the_runs_of_slippery_values(asked: Ask, rows: pd.DataFrame) -> None:
    expected = []
    measured = rows[rows["value"]].sort_values(["time", "vehicle", "boot", "seq", "row"])
    for place, group in measured.groupby(PLACE):
        run: list[Any] = []
        for row in [*group.itertuples(), None]:
            if row is not None and row.mu < 0.4:
                run.append(row)
                continue
            if len({one.vehicle for one in run}) >= 2:
                first = run[0]
                other = min(one.time for one in run if one.vehicle != first.vehicle)
                end = None if row is None else row.time
                expected.append((*place, first.time, end, len(run), other - first.time))
            run = []
    table = asked("spells")
    names = (*PLACE, "onset", "end", "values", "to_alert_s")
    found = list(zip(*(table[name].to_pylist() for name in names), strict=True))
    assert len(expected) > 20
    assert sorted(found, key=str) == sorted(expected, key=str)


def test_planted_change_lies_in_the_before_after_interval(
    asked: Ask, rows: pd.DataFrame, tmp_path: Path
) -> None:
    at = START_NS + 24 * HOUR_NS
    found = asked("before-after", at=at).to_pylist()[1]
    measured = rows[rows["value"]].assign(after=lambda r: r["time"] >= at // 10**9)
    means = measured.groupby([*PLACE, "after"])["mu"].agg(["mean", "size"]).unstack().dropna()
    weight = (
        means["size"][True] * means["size"][False] / (means["size"][True] + means["size"][False])
    )
    expected = (weight * (means["mean"][True] - means["mean"][False])).sum() / weight.sum()
    assert found["difference"] == pytest.approx(expected, abs=1e-9)
    assert found["cells"] == len(means)
    assert found["lower"] < 0.0 < found["upper"]  # there is no effect, because nothing was treated
    assert 0.002 < found["upper"] - found["lower"] < 0.1
    assert found["vehicles"] <= WORLD.vehicles


@pytest.mark.campaign
def test_before_after_interval_has_its_stated_coverage() -> None:
    import ibis

    from fleet_service.analytics.questions.before_after import expression

    rng = np.random.default_rng(5)
    covered = 0
    runs = 50
    for _ in range(runs):
        vehicles = 25
        each = 16
        vehicle = np.repeat(np.arange(vehicles), each)
        # A vehicle drives either before or after the treatment, so its bias does not cancel.
        after = np.repeat(rng.random(vehicles) < 0.5, each)
        mu = (
            0.6
            + 0.1 * after
            + rng.normal(0, 0.05, vehicles)[vehicle]
            + rng.normal(0, 0.05, len(vehicle))
        )
        table = pa.table(
            {
                "cell": rng.integers(0, 4, len(vehicle)),
                "sector": np.zeros(len(vehicle), np.int8),
                "vehicle": vehicle.astype(str).tolist(),
                "time": np.where(after, 200, 100),
                "mu": mu,
                "mu_utilised": mu,
            }
        )
        (row,) = expression(ibis.memtable(table), 150).to_pyarrow().to_pylist()
        std = np.sqrt(row["squares"] * row["vehicles"] / (row["vehicles"] - 1)) / row["w"]
        covered += abs((row["later"] - row["before"]) / row["w"] - 0.1) < Z_95 * std
    assert 0.78 < covered / runs < 0.99


def test_vehicles_shows_the_planted_bias_of_each(asked: Ask, rows: pd.DataFrame) -> None:
    found = asked("vehicles").to_pandas().set_index("vehicle")
    assert found["observations"].to_dict() == rows.groupby("vehicle").size().to_dict()
    planted = np.random.default_rng(WORLD.seed).normal(0.0, 0.04, WORLD.vehicles)
    names = [rows_name(v) for v in range(WORLD.vehicles)]
    met = found.loc[names]
    assert (met["meetings"] > 5).all()
    assert np.corrcoef(met["bias"].astype(float), planted)[0, 1] > 0.5
    measured = rows[rows["value"]].assign(hour=lambda r: r["time"] // 3600)
    one = names[3]
    differences = []
    keys = [*PLACE, "hour"]
    for _, group in measured.merge(
        measured[measured["vehicle"] == one][keys].drop_duplicates(), on=keys
    ).groupby(keys):
        mine = group[group["vehicle"] == one]["mu"]
        others = group[group["vehicle"] != one]["mu"]
        if len(mine) and len(others):
            differences.append(mine.mean() - others.mean())
    assert found.loc[one, "bias"] == pytest.approx(np.mean(differences), abs=1e-9)
    assert found.loc[one, "meetings"] == len(differences)


def rows_name(vehicle: int) -> str:
    from hashlib import blake2b

    return blake2b(f"{WORLD.seed}/{vehicle}".encode(), digest_size=8).hexdigest()


def test_calibration_counts_later_values_inside_published_intervals(
    asked: Ask, rows: pd.DataFrame, archive: Path
) -> None:
    found = asked("calibration").to_pandas()
    measured = rows[rows["value"]]
    inside: dict[tuple[str, int], list[bool]] = {}
    for path in sorted((archive / "map").rglob("*.parquet")):
        cells = pq.read_table(path, partitioning=None).to_pandas()
        since = int(cells["snapshot_time"].iloc[0].timestamp())
        later = measured[(measured["time"] > since) & (measured["time"] <= since + 6 * 3600)].merge(
            cells, on=PLACE, suffixes=("", "_map")
        )
        for row in later.itertuples():
            held = row.mu_lower_map <= row.mu <= row.mu_upper_map
            inside.setdefault((row.basis, (row.time - since) // 3600), []).append(held)
    assert {(row.basis, row.age_h): row.values for row in found.itertuples()} == {
        k: len(v) for k, v in inside.items()
    }
    for row in found.itertuples():
        assert row.held == pytest.approx(np.mean(inside[row.basis, row.age_h]), abs=1e-9)
        assert row.compatible >= row.held


def test_weather_takes_the_nearest_station_s_reading_of_the_hour(
    asked: Ask, rows: pd.DataFrame, stations: Path
) -> None:
    found = asked("weather", stations=stations).to_pandas().set_index("temperature").sort_index()
    measured = rows[rows["value"]]
    temperature = 5.0 - 8.0 * synthetic.night_factor(
        ((measured["time"] - START_NS // 10**9) // 3600 * 3600).to_numpy(float)
    )
    groups = measured.groupby(np.floor(temperature / 2) * 2)["mu"]
    assert found["values"].to_dict() == groups.size().to_dict()
    np.testing.assert_allclose(found["mu_p10"], groups.quantile(0.1), atol=1e-9)
    np.testing.assert_allclose(found["mu_mean"], groups.mean(), atol=1e-9)
    # Colder roads are more often slippery.
    assert found["share_slippery"].iloc[0] > 3 * found["share_slippery"].iloc[-1]
    assert found.index.min() < -2


def test_replay_is_the_map_of_the_service(asked: Ask, archive: Path) -> None:
    at = START_NS + 30 * HOUR_NS
    found = asked("replay", at=at)
    fusion = Fusion(120.0)
    for _ in replay(archive, fusion, Since(until=at)):
        pass
    expected = cell_table(fusion, find_visited(fusion), at)
    assert found.drop_columns(["frame"]).sort_by("cell").equals(expected.sort_by("cell"))


def test_the_map_of_a_box_is_that_box_of_the_map(asked: Ask) -> None:
    at = START_NS + 40 * HOUR_NS
    west = 11.972
    east = 11.979
    whole = asked("replay", at=at)
    part = asked("replay", at=at, part=Extract(PART.since, PART.until, (west, 57.0, east, 58.0)))
    inside = (whole["east"].to_numpy() > west) & (whole["west"].to_numpy() < east)
    order: Order = [("cell", "ascending"), ("sector", "ascending")]
    assert 100 < part.num_rows < whole.num_rows
    assert part.sort_by(order).equals(whole.filter(pa.array(inside)).sort_by(order))


def test_a_day_of_replay_has_a_frame_per_step_within_the_box(asked: Ask) -> None:
    part = Extract(START_NS, START_NS + 12 * HOUR_NS, (11.9, 57.6, 11.985, 57.8))
    found = asked("replay", part=part, step_s=3 * 3600.0)
    frames = np.unique(found["frame"].cast(pa.int64()).to_numpy()).tolist()
    assert frames == [(START_NS + hour * HOUR_NS) // 1000 for hour in (3, 6, 9, 12)]
    assert found["west"].to_numpy().max() < 11.985


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("before-after", {}, "at: the time of the treatment"),
        ("before-after", {"at": START_NS}, "at: in no cell did two vehicles"),
        ("weather", {}, "stations: the table of readings"),
        ("weather", {"stations": Path("nowhere.csv")}, "stations: cannot read"),
    ],
)
def test_missing_option_of_a_question_is_reported(
    asked: Ask, name: str, options: dict[str, object], problem: str
) -> None:
    with pytest.raises(InputError, match=f"^{problem}"):
        asked(name, **options)


READING = "a,2026-01-27T06:30:00.5Z,57.7,11.99,-2\n"


def test_station_without_temperature_or_far_away_is_left_out(asked: Ask, tmp_path: Path) -> None:
    path = tmp_path / "stations.csv"
    head = "station,time,latitude,longitude,temperature\n"
    path.write_text(f"{head}{READING}a,2026-01-27T07:30:00Z,57.7,11.99,\n")
    assert asked("weather", stations=path)["temperature"].to_pylist() == [-2.0]
    path.write_text(head + READING.replace("57.7,11.99", "11.99,57.7"))
    assert not asked("weather", stations=path).num_rows


@pytest.mark.parametrize(
    ("given", "wrong"), [("57.7,", "577,"), (",-2\n", ",271\n"), ("11.99", "1199")]
)
def test_station_with_an_impossible_value_is_refused(
    asked: Ask, tmp_path: Path, given: str, wrong: str
) -> None:
    path = tmp_path / "stations.csv"
    row = READING.replace(given, wrong)
    path.write_text(f"station,time,latitude,longitude,temperature\n{row}")
    with pytest.raises(InputError, match="stations: stations.csv has the .* outside"):
        asked("weather", stations=path)


def test_part_without_rows_is_reported(asked: Ask) -> None:
    with pytest.raises(InputError, match="^archive: no compacted observations"):
        asked("grip", part=Extract(0, 10**9))


def test_a_box_and_times_leave_other_rows_out(asked: Ask, rows: pd.DataFrame) -> None:
    part = Extract(PART.since + HOUR_NS, PART.since + 5 * HOUR_NS, (11.97, 57.69, 11.98, 57.72))
    found = asked("grip", part=part)
    inside = rows[
        rows["time"].between(part.since // 10**9, part.until // 10**9 - 1)
        & rows["longitude"].between(11.97, 11.98, inclusive="left")
        & rows["latitude"].between(57.69, 57.72, inclusive="left")
    ]
    assert 0 < found["observations"].to_numpy().sum() == len(inside) < len(rows)


def test_stretch_over_the_antimeridian_has_its_true_length() -> None:
    latitude = np.full(8, -16.8)
    longitude = (179.9994 + 0.00018 * np.arange(8) + 180.0) % 360.0 - 180.0
    cell = np.unique(grid.cell_of(latitude, longitude))
    n = len(cell)
    columns: dict[str, object] = dict.fromkeys(("observations", "values", "slippery"), np.ones(n))
    columns |= {"cell": cell, "sector": np.zeros(n, np.int8), "mu_sum": np.full(n, 0.3)}
    found = join_stretches(pa.table(columns)).to_pylist()
    assert len(found) == 1
    assert found[0]["length_m"] == pytest.approx(n * 18.3, rel=0.1)
    assert found[0]["west"] < 180.0 < found[0]["east"]
