"""Tests of slippery road sections as DATEX II (a traffic data standard). Publications must be
valid, a changed section must get a new version, and an ended alert must end its section. If no
service answers, no section may end.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from fleet_service.cli import main
from fleet_service.client.datex import KEPT_S, Supplier, make_publication, same_but_for_time
from fleet_service.client.stretches import StretchAlert, Stretches
from schemas import grid
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.thresholds import NS
from schemas.wire import Alert
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.client.test_stretches import alert
from tests.fleet_service.conftest import Running
from tests.fleet_service.examples import SECOND, batch
from tests.structure import ROOT
from tests.waiting import PATIENCE_S

SCHEMA = ROOT.parent / "shared" / "datex" / "DATEXII_3_D2Payload.xsd"
OURS = Supplier("se", "GripMap test")
NOW = 1_800_000_100 * NS
SPACES = {
    "sit": "http://datex2.eu/schema/3/situation",
    "loc": "http://datex2.eu/schema/3/locationReferencing",
    "com": "http://datex2.eu/schema/3/common",
}


@cache
def schema() -> Any:  # noqa: ANN401 a type of the validator's library
    if not SCHEMA.exists():
        pytest.skip(f"the schema of DATEX II is not at {SCHEMA}")
    import xmlschema

    return xmlschema.XMLSchema11(SCHEMA)


def stretches(*alerts: Alert) -> list[StretchAlert]:
    collected = Stretches()
    for one in alerts:
        collected.apply_alert(one)
    collected.take_changes()
    return collected.standing


def records(document: bytes) -> list[ET.Element]:
    return list(ET.fromstring(document).iterfind(".//sit:situationRecord", SPACES))


def text(record: ET.Element, path: str) -> str:
    return record.findtext(path, "", SPACES)


ICE = [alert(x, sector=s, at=x) for x in range(20) for s in (0, 2)]


@pytest.mark.parametrize(
    "alerts",
    [ICE, [alert(0)], [alert(0, y, sector=3) for y in range(9)], [*ICE, alert(90, mu=0.05)], []],
    ids=["road", "cell", "southward", "two", "none"],
)
def test_every_publication_is_valid_also_when_it_ended(alerts: list[Alert]) -> None:
    begun = make_publication(OURS, stretches(*alerts), NOW)
    for document in (begun, make_publication(OURS, [], NOW + NS, begun)):
        schema().validate(document.decode())


def test_value_spread_count_and_probability_travel() -> None:
    (record,) = records(make_publication(OURS, stretches(*ICE), NOW))
    friction = record.find(".//com:friction", SPACES)
    assert friction is not None
    assert friction.get("numberOfInputValuesUsed") == "2"
    assert float(friction.get("standardDeviation", "")) == pytest.approx(0.2 / 3.29, abs=1e-3)
    assert text(record, ".//com:friction/com:friction") == "0.20"
    assert text(record, "sit:probabilityOfOccurrence") == "probable"
    assert text(record, "sit:weatherRelatedRoadConditionType") == "slippery"
    assert text(record, "sit:safetyRelatedMessage") == "true"


def test_the_line_runs_along_the_cells_the_way_that_vehicles_head() -> None:
    (east,) = records(
        make_publication(OURS, stretches(*(alert(x, sector=0) for x in range(9))), NOW)
    )
    (west,) = records(
        make_publication(OURS, stretches(*(alert(x, sector=2) for x in range(9))), NOW)
    )
    one, other = (
        np.array(text(record, ".//loc:posList").split(), float).reshape(-1, 2)
        for record in (east, west)
    )
    assert len(one) == 9
    assert (np.diff(one[:, 1]) > 0).all()
    assert np.array_equal(one, other[::-1])
    (north,) = records(make_publication(OURS, stretches(alert(0, sector=1)), NOW))
    assert text(north, ".//loc:bearing") == "0", "clockwise from north"


def test_a_stretch_around_a_corner_is_one_line_without_leaps() -> None:
    corner = [alert(x) for x in range(12)] + [alert(11, y) for y in range(12)]
    (record,) = records(make_publication(OURS, stretches(*corner), NOW))
    line = np.array(text(record, ".//loc:posList").split(), float).reshape(-1, 2)
    steps = np.hypot(np.diff(line[:, 0]), np.diff(line[:, 1]) * np.cos(np.radians(line[0, 0])))
    _, south, _, north = (float(v) for v in grid.bounds(corner[0].cell))
    assert len(line) >= 22
    assert steps.max() < 1.5 * (north - south)


def test_a_situation_keeps_its_id_and_counts_its_versions() -> None:
    first = make_publication(OURS, stretches(*ICE[:10]), NOW)
    again = make_publication(OURS, stretches(*ICE[:10]), NOW + 5 * NS, first)
    assert same_but_for_time(again, first)
    grown = make_publication(OURS, stretches(*ICE), NOW + 9 * NS, again)
    over = make_publication(OURS, [], NOW + 12 * NS, grown)
    (a,), (b,), (c,) = (records(document) for document in (first, grown, over))
    assert {a.get("id"), b.get("id"), c.get("id")} == {a.get("id")}
    assert [one.get("version") for one in (a, b, c)] == ["1", "2", "3"]
    assert text(b, "sit:situationRecordCreationTime") == text(a, "sit:situationRecordCreationTime")
    assert not text(b, ".//com:overallEndTime")
    assert text(c, ".//com:overallEndTime") == "2027-01-15T08:01:52Z"
    assert text(c, ".//com:overallStartTime") == text(a, ".//com:overallStartTime")


def test_ended_situation_stays_in_the_publication_for_an_hour() -> None:
    over = make_publication(OURS, [], NOW + NS, make_publication(OURS, stretches(*ICE), NOW))
    assert same_but_for_time(make_publication(OURS, [], NOW + (KEPT_S - 1) * NS, over), over)
    assert not records(make_publication(OURS, [], NOW + (KEPT_S + 2) * NS, over))


def test_restarted_reader_continues_the_same_situation() -> None:
    first = make_publication(OURS, stretches(*ICE), NOW)
    without_its_first = make_publication(OURS, stretches(*ICE[6:]), NOW + NS, first)
    (a,) = records(first)
    (b,) = records(without_its_first)
    assert (a.get("id"), b.get("version")) == (b.get("id"), "2")


def test_ice_that_comes_back_is_a_new_situation() -> None:
    over = make_publication(OURS, [], NOW + NS, make_publication(OURS, stretches(*ICE), NOW))
    later = make_publication(
        OURS, stretches(*(alert(x, at=100) for x in range(20))), NOW + 200 * NS, over
    )
    assert len({record.get("id") for record in records(later)}) == 2


def test_situation_does_not_end_while_no_service_answers() -> None:
    first = make_publication(OURS, stretches(*ICE), NOW)
    assert same_but_for_time(make_publication(OURS, [], NOW + NS, first, lambda *_: False), first)


@pytest.mark.parametrize("foreign", [b"", b"<a/>", b"not xml", b"\x00\xff"])
def test_a_file_of_others_is_not_written_over(foreign: bytes) -> None:
    with pytest.raises(InputError, match="out"):
        make_publication(OURS, [], NOW, foreign)


def test_publication_of_another_supplier_is_not_continued() -> None:
    document = make_publication(OURS, [], NOW)
    make_publication(OURS, [], NOW, document)
    for other in (Supplier("se", "Other"), Supplier("no", OURS.name)):
        with pytest.raises(InputError, match="supplier: .* publication of se GripMap test; give"):
            make_publication(other, [], NOW, document)


@pytest.mark.parametrize(("country", "name"), [("SE", "x"), ("sweden", "x"), ("se", " ")])
def test_supplier_must_be_valid(country: str, name: str) -> None:
    with pytest.raises(InputError):
        Supplier(country, name)


def test_the_file_follows_the_alerts_of_a_service_and_outlives_it(
    router: ZenohSettings,
    session: zenoh.Session,
    start: Callable[..., AbstractContextManager[Running]],
    tmp_path: Path,
) -> None:
    out = tmp_path / "situations.xml"
    words = ["--country", "se", "--supplier", "test", "--connect", router.connect[0]]
    words = ["export", "datex", "--out", str(out), *words]
    with start(tmp_path / "archive"):
        command = [sys.executable, "-m", "fleet_service.cli", *words, "--follow"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as following:
            assert following.stdout is not None
            assert following.stdout.readline() == f"0 slippery stretches in {out}\n"
            fleet = Fleet(session).await_services()
            fleet.settle(
                *(batch(f"sim-{k:03}", 1, time.time_ns() - 9 * SECOND, [0.2]) for k in range(4))
            )
            assert following.stdout.readline() == f"1 slippery stretches in {out}\n"
            fleet.settle(
                *(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.8]) for k in range(10, 22))
            )
            assert following.stdout.readline() == f"0 slippery stretches in {out}\n"
            following.terminate()
            assert following.wait(PATIENCE_S) == 0
    (ended,) = records(out.read_bytes())
    assert text(ended, ".//com:overallEndTime")
    assert ended.get("version") == "2"
    kept = out.read_bytes()
    assert main(words) == 2, "no service speaks"
    assert out.read_bytes() == kept


def test_vehicles_without_grip_demand_cause_no_publication(
    router: ZenohSettings,
    session: zenoh.Session,
    start: Callable[..., AbstractContextManager[Running]],
    tmp_path: Path,
) -> None:
    out = tmp_path / "situations.xml"
    with start(tmp_path / "archive"):
        fleet = Fleet(session).await_services()
        now = time.time_ns() - SECOND
        fleet.settle(
            *(
                batch(f"sim-{k:03}", 1, now, [0.2], with_likelihood=False, used=0.02)
                for k in range(9)
            )
        )
        config = tmp_path / "reader.json"
        config.write_text(json.dumps({"zenoh": {"connect": router.connect}}))
        words = [
            "--country",
            "no",
            "--supplier",
            "who",
            "--status",
            "real",
            "--config",
            str(config),
        ]
        assert main(["export", "datex", "--out", str(out), *words]) == 0
    assert not records(out.read_bytes())
    root = ET.fromstring(out.read_bytes())
    assert [
        root.findtext(f".//com:{name}", "", SPACES) for name in ("country", "nationalIdentifier")
    ] == ["no", "who"]
    real = make_publication(
        Supplier("no", "who", "real"), stretches(alert(0)), NOW, out.read_bytes()
    )
    assert b"<com:informationStatus>real</com:informationStatus>" in real


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["datex", "--out", "a.xml"], "country"),
        (["datex", "--out", "a.xml", "--country", "se"], "supplier"),
        (["datex", "--out", "a.json", "--country", "se", "--supplier", "x"], "out"),
        (
            ["datex", "--out", "a.xml", "--country", "se", "--supplier", "x", "--archive", "a"],
            "archive",
        ),
        (["map", "--out", "a.csv"], "archive"),
        (["map", "--out", "a.csv", "--archive", "a", "--country", "se"], "country"),
    ],
)
def test_options_of_the_other_kind_are_refused(
    words: list[str],
    field: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", *words]) == 2
    assert capsys.readouterr().err.startswith(f"error: {field}: ")
