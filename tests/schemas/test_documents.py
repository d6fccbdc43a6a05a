"""Tests that statements of the .proto file and the README for other languages agree
with the code.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edge_agent.publish import resend_schedule
from fleet_service.fusion import weather as fused_weather
from fleet_service.ingest import dedup, rate_limit, validation
from fleet_service.ingest import weather as weather_in
from fleet_service.serve import alerts
from schemas import grid, mugrid, query, regions, tables, thresholds, wire
from schemas.config import NAME_PATTERN, ServiceConfig
from schemas.keys import TOPICS
from schemas.signals import Health
from schemas.wire import Kind, codec

SCHEMAS = Path(wire.__file__).parents[1]
PROTO = (SCHEMAS / "proto" / "gripmap.proto").read_text(encoding="utf-8")
README = (SCHEMAS / "README.md").read_text(encoding="utf-8")
COMMENTS = " ".join(re.findall(r"//\s*(.*)", PROTO))
BOTH = pytest.mark.parametrize(
    "text", [COMMENTS, " ".join(README.split())], ids=["proto", "README"]
)
SERVICE = ServiceConfig()
ENCODINGS = (
    *wire.ENCODING.values(),
    wire.ACK_ENCODING,
    wire.ALERT_ENCODING,
    wire.STANDING_ENCODING,
    wire.WEATHER_ENCODING,
    wire.ARROW,
    wire.JSON,
)


@BOTH
@pytest.mark.parametrize("flag", [flag for flag in Health if flag])
def test_contract_lists_every_health_flag_with_its_bit(text: str, flag: Health) -> None:
    assert re.search(rf"\b{flag.value}\W+{flag.name}\b", text)


@BOTH
def test_contract_lists_only_existing_health_flags(text: str) -> None:
    named = set(
        re.findall(
            r"\b(?:NO_[A-Z]{3,}(?:_[A-Z]+)?|TIME_GAP|OUTLIER|SLIDING|RESET|CONTRADICTION)\b", text
        )
    )
    assert named == {flag.name for flag in Health if flag}


# Statements that both texts must contain. The numbers come from the code.
SHARED = (
    f"{mugrid.BINS} equal bins on [{mugrid.LOWER}, {mugrid.UPPER:.2f}]",
    f"1/{mugrid.STEPS_PER_NAT} nat below the maximum",
    f"{mugrid.FLOOR_STEPS} is the floor",
    f"{wire.MAX_BYTES}",
    f"StandingAlerts: {codec.MAX_STANDING_BYTES}",
    f"1 to {wire.MAX_ROWS}",
    f"{dedup.MAX_GAPS}",
    f"segment every {SERVICE.segment_s} s",
    f"lateness ({SERVICE.lateness_s:.0f} s)",
    f"after {resend_schedule.FIRST_RESEND_S:.0f} s",
    f"up to {resend_schedule.LONGEST_RESEND_S:.0f} s",
    f"mu_utilised >= {thresholds.EXCITED_SHARE} mu",
    f"within {np.degrees(validation.YAW_TOLERANCE):.0f}° of",
    f"mu < {thresholds.SLIPPERY_MU}",
    NAME_PATTERN.strip("^$"),
    validation.ESTIMATOR_PATTERN,
)
IN_PROTO = (
    f"P(mu < {thresholds.SLIPPERY_MU}) > {alerts.RAISE_ABOVE}",
    f"{mugrid.LOWER} + (i + 0.5) {mugrid.UPPER - mugrid.LOWER:.2f} / {mugrid.BINS}",
    f"last {thresholds.UTILISED_WINDOW_S} s",
    *(f"z{zoom} quadint" for zoom in (grid.CELL_ZOOM, grid.REGION_ZOOM)),
    next(field.unit for field in tables.OBSERVATION if field.name == "sector"),
    next(field.unit for field in tables.OBSERVATION if field.name == "tyre_season"),
    next(field.unit for field in tables.OBSERVATION if field.name == "abs_active"),
)
IN_README = (
    f"{mugrid.LOWER} + k·{mugrid.UPPER - mugrid.LOWER:.2f}/{mugrid.BINS}",
    "{:.3f}, {:.3f}, …, {:.3f}".format(*mugrid.CENTRES[[0, 1, -1]]),
    f"within {np.degrees(grid.SECTOR_MARGIN):.0f}° of an edge",
    f"zoom {grid.CELL_ZOOM}, {grid.TILE_ZOOM}, {grid.REGION_ZOOM} and {grid.ZONE_ZOOM}",
    f"at most {SERVICE.clock_ahead_s:.0f} s ahead",
    f"at most {SERVICE.oldest_s / 86400:.0f} days old",
    f"{SERVICE.vehicle_kb_s:.0f} kB/s, {SERVICE.vehicle_burst_kb:.0f} kB at once",
    f"counts {rate_limit.LEAST_BYTES} bytes at least",
    (
        f"{query.MAX_TEXT} characters, {query.MAX_ROUTE_POINTS} points of a route, "
        f"{regions.ROUTE_MOST_M / 1e3:.0f} km"
    ),
    *(f"`{encoding}`" for encoding in ENCODINGS),
    *(f"`{name}/<" for name in TOPICS),
)


def to_plain_letters(text: str) -> str:
    """Return a text with Greek letters and symbols written as in the .proto file."""
    letters = {"·`mu`": " mu", "`": "", "≥": ">=", "μ": "mu", " degrees of": "° of"}
    for letter, replacement in letters.items():
        text = text.replace(letter, replacement)
    return text


@BOTH
@pytest.mark.parametrize("statement", SHARED)
def test_contract_readme_states_the_numbers_of_the_code(text: str, statement: str) -> None:
    assert statement in to_plain_letters(text)


@pytest.mark.parametrize("statement", IN_PROTO)
def test_proto_file_states_the_numbers_of_the_code(statement: str) -> None:
    assert statement in COMMENTS


@pytest.mark.parametrize("statement", IN_README)
def test_contract_readme_states_the_numbers_for_other_languages(statement: str) -> None:
    assert statement in " ".join(README.split())


def test_limits_that_are_written_in_words_are_those_of_the_code() -> None:
    day = 86_400 * thresholds.NS
    assert (day, day, day // 8) == (
        validation.MAX_VISIT_NS,
        weather_in.AHEAD_NS,
        fused_weather.VALID_NS,
    )
    assert alerts.LEAST_SOURCES == 2


def table_of_ranges() -> str:
    """Return the README's table of the ranges of a report's columns, computed from the tables of
    the contract (`schemas`).
    """
    lines = ["| column | unit | range |", "|---|---|---|"]
    fields = {
        field.name: field
        for field in (*tables.OBSERVATION, *tables.STATE)
        if field.range is not None
    }
    for name, field in fields.items():
        least, most = field.range or (0, 0)
        lines.append(f"| `{name}` | {field.unit} | {least:.9g} … {most:.10g} |")
    return "\n".join(lines)


def test_the_ranges_of_the_readme_are_those_that_are_checked() -> None:
    assert table_of_ranges() in README
    checked = {
        kind: [(r.column, r.least, r.most) for r in ranges]
        for kind, ranges in validation.RANGES.items()
    }
    for kind, fields in ((Kind.OBSERVATION, tables.OBSERVATION), (Kind.STATE, tables.STATE)):
        assert checked[kind] == [(f.name, *f.range) for f in fields if f.range is not None]


def test_the_module_of_the_messages_is_the_one_that_the_proto_gives(tmp_path: Path) -> None:
    words = [
        "-m",
        "grpc_tools.protoc",
        "-I",
        str(SCHEMAS / "proto"),
        f"--python_out={tmp_path}",
        "gripmap.proto",
    ]
    subprocess.run([sys.executable, *words], check=True)
    made, kept = (
        (folder / "gripmap_pb2.py").read_text() for folder in (tmp_path, SCHEMAS / "proto")
    )
    assert read_descriptor(made) == read_descriptor(kept)


def read_descriptor(module: str) -> str:
    """Return the message definitions in a module that protoc generated. Parts that depend on
    protoc's version are left out.
    """
    found = re.search(r"AddSerializedFile\((.*)\)", module)
    assert found
    return found[1]
