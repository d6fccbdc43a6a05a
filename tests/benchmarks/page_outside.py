"""Benchmarks of the page's interfaces for other systems: DATEX II, OGC API Features, and links of a
road network.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import zenoh

from deploy.router import open_router
from fleet_service.client import map_client
from fleet_service.client.datex import Supplier, make_publication
from fleet_service.client.datex_feed import DatexFile
from fleet_service.client.stretches import Stretches
from fleet_service.client.watching import standing_alerts
from fleet_service.page.server import PageSettings, run
from schemas import grid
from schemas.config import ZenohSettings
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import NS
from schemas.wire import Alert
from tests.benchmarks import roads
from tests.fleet_service.conftest import running
from tests.fleet_service.page import street
from tests.structure import ROOT
from tests.waiting import until

SCHEMA: Final = ROOT.parent / "shared" / "datex" / "DATEXII_3_D2Payload.xsd"
OURS: Final = Supplier("se", "GripMap bench")
STEPS = 40
SEED = 20_319
LEAST_ENDED = 20
PATIENCE_S: Final = 120.0
# Age of the reported ice at the time when it has melted. Within seconds no road changes, so no
# alert would end.
ICE_NS: Final = 1800 * NS
_SPACES: Final = {
    "sit": "http://datex2.eu/schema/3/situation",
    "loc": "http://datex2.eu/schema/3/locationReferencing",
    "com": "http://datex2.eu/schema/3/common",
}
READERS: Final = {
    "GDAL": "import pyogrio; found = pyogrio.read_dataframe('OAPIF:{address}', layer='grip')",
    "geopandas": (
        "import geopandas; "
        "found = geopandas.read_file('{address}collections/grip/items?limit=10000')"
    ),
}
_COUNT: Final = (
    "; print(len(found), int((found.basis == 'bound').sum()), int(found.mu.notna().sum()))"
)


def list_records(document: bytes) -> list[ET.Element]:
    """Return the situation records of a DATEX II publication."""
    return list(ET.fromstring(document).iterfind(".//sit:situationRecord", _SPACES))


def is_over(record: ET.Element) -> bool:
    """Return True if a situation record of a DATEX II publication states the end of the
    situation.
    """
    return record.find(".//com:overallEndTime", _SPACES) is not None


def is_valid() -> Callable[[bytes], bool] | None:
    """Return a function that takes the bytes of a DATEX II publication, and returns True if they
    follow the schema. Return None if the schema is not installed.
    """
    if not SCHEMA.exists():
        print(f"  the schema of DATEX II is not at {SCHEMA}", file=sys.stderr)
        return None
    import xmlschema

    schema = xmlschema.XMLSchema11(SCHEMA)
    return lambda document: bool(schema.is_valid(document.decode()))


def made_up(valid: Callable[[bytes], bool] | None) -> tuple[float, float]:
    """Make STEPS DATEX II publications of simulated alerts that begin and end at random. Check each
    publication with the function `valid`.

    Return two sums over all publications: the number of invalid publications, and the error of the
    number of open situations. A publication must have one open situation per road stretch with an
    active alert.

    Both are NaN if fewer than LEAST_ENDED situations ended. The first is also NaN if `valid` is
    None, because the schema is not installed.
    """
    rng = np.random.default_rng(SEED)
    stretches = Stretches()
    before: bytes | None = None
    invalid = 0
    unended = 0
    ended = set[str]()
    standing = dict[tuple[int, int], bool]()
    for step in range(STEPS):
        now = (1_800_000_000 + 30 * step) * NS
        for x, sector in zip(
            rng.integers(0, 60, 8).tolist(), (2 * rng.integers(0, 2, 8)).tolist(), strict=True
        ):
            raised = bool(rng.random() < 0.4)
            if raised == standing.get((x, sector), False):
                continue
            standing[x, sector] = raised
            cell = int(
                grid.interleave(np.array([street.MIDDLE[0] + 5 * x]), np.array([street.MIDDLE[1]]))[
                    0
                ]
            )
            latitude, longitude = (float(v) for v in grid.centre(cell))
            mu = float(rng.uniform(0.1, 0.3))
            stretches.apply_alert(
                Alert(
                    cell,
                    sector,
                    raised,
                    now,
                    mu,
                    mu / 2,
                    mu + 0.1,
                    0.95,
                    3,
                    latitude,
                    longitude,
                    "made",
                )
            )
        stretches.take_changes()
        before = make_publication(OURS, stretches.standing, now, before)
        records = list_records(before)
        ended |= {f"{one.get('id')}" for one in records if is_over(one)}
        unended += abs(sum(not is_over(one) for one in records) - len(stretches.standing))
        invalid += valid is not None and not valid(before)
    enough = len(ended) >= LEAST_ENDED
    return (float(invalid) if valid and enough else math.nan), (
        float(unended) if enough else math.nan
    )


def measure_publication() -> dict[str, float]:
    """Return figures by name of the page's DATEX II publication and features, measured with a
    service and six cars on ice that melts.

    `leaked`: number of cells in published situations for which the map has only a lower bound or an
    estimate, and no measurement. `unended`: situations that are still open when their alert is
    over. `readers_failed`: failures among GDAL, geopandas and, if installed, ogrinfo.
    """
    street.PARTS["melted"] = street.PARTS["ice"]._replace(mu=0.85)
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(connect=endpoints)
    with (
        tempfile.TemporaryDirectory() as folder,
        router,
        running(settings, Path(folder) / "archive"),
    ):
        file = DatexFile(OURS, Path(folder) / "situations.xml", lambda _: None)
        stop = threading.Event()
        lines = list[str]()
        page = threading.Thread(
            target=run, args=(PageSettings(settings, port=0, datex=file), stop, lines.append)
        )
        page.start()
        session = open_session(settings)
        assert session is not None
        try:
            with session:
                until(lambda: lines)
                address = lines[0].removeprefix("page: ")
                seq = street.put(session, ("ice", "passed", "wet"), time.time_ns() - ICE_NS)
                until(lambda: list_records(fetch_publication(address)), PATIENCE_S)
                until(
                    lambda: count_features(address) == street.count_known("ice", "passed", "wet"),
                    PATIENCE_S,
                )
                table = map_client.served_table(map_client.query_map(settings, {}))
                leaked = len(cells_of(fetch_publication(address)) - measured_cells(table))
                failed = sum(not can_open(reader, address) for reader in READERS)
                failed += shutil.which("ogrinfo") is not None and not ogrinfo_opens(address)
                _melt_ice(session, seq)
                time.sleep(1.0)  # time for the feed's next update
                unended = sum(not is_over(one) for one in list_records(fetch_publication(address)))
        finally:
            stop.set()
            page.join(10.0)
    return {"leaked": float(leaked), "unended": float(unended), "readers_failed": float(failed)}


def _melt_ice(session: zenoh.Session, seq: int) -> None:
    """Publish that the ice has melted until no alert stands; `seq` is the last number used."""
    for _ in range(12):
        if not standing_alerts(session):
            break
        time.sleep(1.0)
        seq = street.put(session, ("melted",), time.time_ns(), seq)
    until(lambda: not standing_alerts(session), PATIENCE_S)


def fetch_publication(address: str) -> bytes:
    """Return the current DATEX II publication of the page, or empty bytes if there is none yet."""
    try:
        with urllib.request.urlopen(f"{address}datex2/situation.xml", timeout=30) as answer:
            found: bytes = answer.read()
            return found
    except OSError:
        return b"<none/>"


def count_features(address: str) -> int:
    """Return the number of features (map cells) in an answer of the page's OGC API, or 0 if the
    page does not answer.
    """
    try:
        with urllib.request.urlopen(f"{address}collections/grip/items", timeout=30) as answer:
            return int(json.loads(answer.read())["numberReturned"])
    except OSError:
        return 0


def cells_of(document: bytes) -> set[int]:
    """Return the map cells that lie in a situation of a DATEX II publication."""
    found = set[int]()
    for record in list_records(document):
        words = record.findtext(".//loc:posList", "", _SPACES).split()
        point = record.find(".//loc:pointCoordinates", _SPACES)
        if point is not None:
            words = [child.text or "nan" for child in point]
        numbers = np.array(words, float).reshape(-1, 2)
        found |= {int(cell) for cell in np.atleast_1d(grid.cell_of(numbers[:, 0], numbers[:, 1]))}
    return found


def measured_cells(table: pa.Table) -> set[int]:
    """Return the cells of a map table whose basis (kind of evidence) is `measured`."""
    is_measured = np.array(table["basis"].to_pylist()) == "measured"
    return set(table["cell"].to_numpy()[is_measured].tolist())


def can_open(reader: str, address: str) -> bool:
    """Return True if a program, such as GDAL, reads all features (map cells) that the page offers.
    Features with only a lower bound of the friction μ must have no value of μ in the program.
    """
    script = READERS[reader].format(address=address) + _COUNT
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )
    whole = street.count_known("ice", "passed", "wet")
    bounds = street.count_known("passed")
    held = done.stdout.split() == [str(whole), str(bounds), str(whole - bounds)]
    if not held:
        print(f"  {reader}: {done.stdout} {done.stderr[-500:]}", file=sys.stderr)
    return held


def ogrinfo_opens(address: str) -> bool:
    """Return True if GDAL's program ogrinfo lists all features (map cells) of the page's
    OGC API.
    """
    words = ["ogrinfo", "-ro", "-al", "-q", f"OAPIF:{address}", "grip"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    held = done.stdout.count("OGRFeature(grip)") == street.count_known("ice", "passed", "wet")
    if not held:
        print(f"  ogrinfo: {done.stdout[:300]} {done.stderr[-500:]}", file=sys.stderr)
    return held


def join_right() -> float:
    """Return the share of positions that are assigned to the right road link (figure
    `roads.join_right`). It is taken from an earlier `make roads-bench` of this commit, or measured
    now.
    """
    path = roads.FOLDER / "figures.json"
    rows = json.loads(path.read_text()) if path.exists() else [{}]
    if rows[0].get("commit") != figures.find_commit(Path(roads.__file__)):
        try:
            roads.main()
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"  the roads were not measured: {error}", file=sys.stderr)
            return math.nan
        rows = json.loads(path.read_text())
    return next(float(row["value"]) for row in rows if row.get("name") == "roads.join_right")


def measure_outside() -> list[Figure]:
    """Run all benchmarks of this module (DATEX II, OGC API Features, links of a road network), and
    return the figures.
    """
    invalid, unended = made_up(is_valid())
    try:
        found = measure_publication()
    except (TimeoutError, subprocess.TimeoutExpired) as error:
        print(f"  no figures of the drive: {error}", file=sys.stderr)
        found = dict.fromkeys(("leaked", "unended", "readers_failed"), math.nan)
    return [
        Figure("datex.invalid", invalid, f"of {STEPS} publications", 0),
        Figure(
            "datex.bound_leaked", found["leaked"], "cells of situations that are not measured", 0
        ),
        Figure(
            "datex.unended", unended + found["unended"], "situations without an end, alert over", 0
        ),
        Figure(
            "roads.join_right",
            join_right(),
            f"of fixes, {roads.NOISE_M:g} m noise, the worst seed",
            0.95,
            "more",
        ),
        Figure(
            "oapif.readers_failed", found["readers_failed"], "of GDAL, geopandas (and ogrinfo)", 0
        ),
    ]
