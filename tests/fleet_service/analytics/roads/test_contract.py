"""Tests of the question (predefined query) `contract`, which returns the shortest and longest
possible time that a road was below the contracted friction. A road without measurements never
counts as compliant.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics.questions.contract import (
    BROKEN,
    GAP_S,
    INTERVAL_STD,
    KEPT,
    LEAST_SHARE,
    SLOT_S,
    UNKNOWN,
    longest_breach,
    slot_intervals,
)
from fleet_service.cli import main
from schemas.errors import InputError

Ask = Callable[..., pa.Table]
LEVEL = 0.35
HOUR = 3600


def measure_contract(
    *slot_mu: tuple[int, float], std: float = 0.01, span: tuple[int, int] | None = None
) -> Any:  # noqa: ANN401
    slot, mu = (np.array(column) for column in zip(*slot_mu, strict=True))
    half = np.full(len(mu), 1.645 * std)
    whole = (int(slot[0]) * SLOT_S, (int(slot[-1]) + 1) * SLOT_S)
    return longest_breach(slot, mu - half, mu, mu + half, LEVEL, span or whole)


def test_a_breach_runs_from_the_first_slot_below_to_the_next_that_is_not() -> None:
    by_mean, least, most, begin = measure_contract(
        (10, 0.8), (11, 0.2), (12, 0.2), (13, 0.8), (14, 0.2), (15, 0.8)
    )
    assert (by_mean, least, most) == (2 * SLOT_S, 2 * SLOT_S, 2 * SLOT_S)
    assert begin == 11 * SLOT_S


def test_friction_between_two_measurements_is_unknown() -> None:
    far = 20 + GAP_S // SLOT_S
    by_mean, least, most, _ = measure_contract((10, 0.8), (20, 0.2), (far + 1, 0.2), (far + 9, 0.8))
    assert least == SLOT_S, "two breaches, surely"
    assert by_mean == (far + 9 - 20) * SLOT_S
    assert most == (far + 9 - 11) * SLOT_S


def test_uncertain_slots_are_neither_breached_nor_kept() -> None:
    by_mean, least, most, _ = measure_contract((10, 0.8), (11, 0.3), (12, 0.8), std=0.1)
    assert (by_mean, least, most) == (SLOT_S, 0, SLOT_S)
    assert measure_contract((10, 0.4), (11, 0.4), std=0.2)[1:3] == (0, 2 * SLOT_S)


def test_before_the_first_and_after_the_last_measurement_it_is_unknown() -> None:
    *_, most, _ = measure_contract((10, 0.8), span=(0, 30 * SLOT_S))
    assert most == 19 * SLOT_S
    assert measure_contract((5, 0.8), (6, 0.8))[:3] == (0, 0, 0)


def test_interval_of_a_slot_has_its_stated_coverage() -> None:
    rng = np.random.default_rng(11)
    truth = 0.5
    std = 0.08
    hits = []
    for n in (1, 2, 3, 8):
        keys = np.repeat(np.arange(2000), n)
        y = truth + rng.normal(0.0, std, len(keys))
        table = pa.table({"key": keys, "y": y, "variance": np.full(len(keys), std**2)})
        found = slot_intervals(table)
        hits.append(float(((found["lower"] <= truth) & (truth <= found["upper"])).mean()))
    assert min(hits) > 0.88, hits


@pytest.mark.campaign
def test_contract_lists_exactly_the_links_with_readings(
    asked: Ask, links: Path, rows: pd.DataFrame
) -> None:
    found = asked("contract", roads=links, level=LEVEL, within_s=1.0 * HOUR).to_pandas()
    roads = pq.read_table(links).to_pandas()
    measured = rows[rows["value"]].merge(roads, on=["cell", "sector"])
    worst = measured.groupby(["link", "direction"])["mu"].min()
    assert set(zip(found["link"], found["direction"], strict=True)) == set(worst.index)
    assert "nobody" not in set(found["link"])
    broken = found[found["verdict"] == BROKEN]
    assert len(broken) >= 2
    for row in broken.itertuples():
        assert row.least_s > HOUR
        assert worst[row.link, row.direction] < LEVEL
    assert not len(found[(found["verdict"] == KEPT) & (found["measured_share"] < LEAST_SHARE)])
    assert (found["least_s"] <= found["most_s"]).all()
    assert (found["breach_s"] <= found["most_s"].clip(lower=SLOT_S)).all()
    dry = found[
        [worst[key] > 1.4 * LEVEL for key in zip(found["link"], found["direction"], strict=True)]
    ]
    assert len(dry)
    assert (dry["least_s"] == 0).all()
    counts = measured.groupby(["link", "direction"]).agg(
        values=("mu", "size"), vehicles=("vehicle", "nunique")
    )
    for row in found.itertuples():
        assert (row.values, row.vehicles) == tuple(counts.loc[(row.link, row.direction)])


def test_the_time_that_was_agreed_and_the_share_measured_decide(asked: Ask, links: Path) -> None:
    short, long = (
        asked("contract", roads=links, level=LEVEL, within_s=s).to_pandas() for s in (600.0, 3e6)
    )
    assert (short["verdict"] == BROKEN).sum() > (long["verdict"] == BROKEN).sum() == 0
    assert (
        (long["verdict"] == KEPT)
        == ((long["measured_share"] >= LEAST_SHARE) & (long["vehicles"] >= 2))
    ).all()
    assert not (short["verdict"] == KEPT).any(), "nobody measured every ten minutes"
    assert set(short["verdict"]) == {BROKEN, UNKNOWN}


def test_one_vehicle_s_ten_passes_are_one_witness() -> None:
    many = pa.table({"key": [0, 1], "y": [0.5, 0.5], "variance": [0.0064, 0.0064]})
    found = slot_intervals(many)
    half = (found["upper"] - found["lower"])[0] / 2
    assert half == pytest.approx(INTERVAL_STD / 2 * np.hypot(0.08, 0.05))


@pytest.mark.parametrize("lacks", ["roads", "level", "within_s"])
def test_missing_option_of_a_contract_is_reported(asked: Ask, links: Path, lacks: str) -> None:
    options = {"roads": links, "level": LEVEL, "within_s": 3600.0}
    del options[lacks]
    with pytest.raises(InputError) as error:
        asked("contract", **options)
    assert error.value.field == lacks.removesuffix("_s")


def test_roads_elsewhere_are_reported(asked: Ask, links: Path, tmp_path: Path) -> None:
    roads = pq.read_table(links)
    cells = pa.array(np.arange(roads.num_rows, dtype=np.int64))
    elsewhere = tmp_path / "elsewhere.parquet"
    pq.write_table(roads.set_column(0, roads.schema.field("cell"), cells), elsewhere)
    assert roads.column_names[0] == "cell"
    found = asked("contract", roads=elsewhere, level=LEVEL, within_s=3600.0)
    assert not found.num_rows
    assert b"no measured friction lies on a road of" in found.schema.metadata[b"report"]


def test_contract_command_reads_an_archive(
    archive: Path, links: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "analyze",
        "contract",
        "--archive",
        str(archive),
        "--roads",
        str(links),
        "--level",
        ".35",
        "--json",
    ]

    def verdicts(*more: str) -> list[str]:
        assert main([*words, *more]) == 0
        return [json.loads(line)["verdict"] for line in capsys.readouterr().out.splitlines()]

    out = tmp_path / "kept.csv"
    assert verdicts("--within", "30min", "--out", str(out)).count(BROKEN) >= 2
    assert BROKEN not in verdicts("--within", "9d")
    assert BROKEN not in verdicts("--within", "30min", "--level", ".06")
    assert "measured_share" in out.read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["contract", "--within", "4", "--level", ".3"], "within"),
        (["contract", "--within", "4h", "--level", "3"], "level"),
        (["contract", "--within", "4h", "--level", "nan"], "level"),
        (["grip", "--within", "4h"], "within"),
        (["grip", "--level", ".3"], "level"),
        (["grip", "--roads", "a"], "roads"),
    ],
)
def test_invalid_options_of_a_contract_are_refused(
    words: list[str], field: str, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["analyze", *words, "--archive", str(archive)]) == 2
    assert capsys.readouterr().err.startswith(f"error: {field}: ")


def test_a_breach_lies_within_the_measurements() -> None:
    """The reports cover half an hour and begin in the middle of a time slot (fixed step of the
    computation). No breach (time below the contracted friction) may begin before the first report
    or last longer than the reports.
    """
    begin = 100 * SLOT_S + 1300
    span = (begin, begin + 1897)
    by_mean, least, most, since = measure_contract((100, 0.2), (101, 0.2), span=span)
    assert least <= by_mean <= most == 1897
    assert since == begin
