"""Campaign on the age of an archive: the time until a service is ready on a large archive, and the
cost of a query about the past.

20 million observations and 40 million states (vehicle positions and speeds) of six days are
generated once and stored in `age-archive` next to the campaigns' folders. A service starts from
Parquet files only, writes a checkpoint (saved state), and starts again from this checkpoint and the
few later rows. Each start runs in a separate process, and the campaign measures the peak memory of
this process. Finally a service starts twice more: from an archive of one day, and from this day
plus the other days moved back by months. Both starts must cost the same, because expired days are
not read.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from datetime import date, timedelta
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.analytics import synthetic
from fleet_service.analytics.synthetic import LATITUDE, LONGITUDE, START_NS, SyntheticFleet
from fleet_service.app.historical_maps import LOOKED_ROWS, PastQuery, box_of, encode_question
from fleet_service.archive.format import layout
from fleet_service.archive.format.layout import CHECKPOINTS, DAY_NS, MAP_DAYS
from fleet_service.archive.format.segments import SCHEMAS, Writer
from fleet_service.replay.rebuild import rows_near
from schemas import query
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site

DAYS: Final = 6
SINCE: Final = 20_000  # observations after the last checkpoint
SEGMENT: Final = 20_000
OWN: Final = ("processor_s", "mb")  # cost of a start itself: processor time and memory
# Box around a quarter of a road.
NEAR: Final = f"{LONGITUDE},{LATITUDE + 0.011},{LONGITUDE + 0.01},{LATITUDE + 0.013}"


def run(site: Site) -> list[Figure]:
    """Generate an archive of twenty million observations and forty million states (in a quick run,
    eighty thousand observations). Measure how long a service needs to start from it, and the cost
    of a query about the past; return the figures.
    """
    millions = site.choose_amount(2000, 8) / 100
    shares = (0.1,) if site.quick else (0.1, 0.3)
    smaller = [_measure_smaller(site, millions * share) for share in shares]
    root = _ensure_archive(
        site,
        (site.folder if site.quick else site.folder.parent) / "age-archive",
        round(millions * 1e6),
    )
    shutil.rmtree(root / CHECKPOINTS, ignore_errors=True)
    cold = _measure_process("ready", root)
    site.say(f"from Parquet alone: {cold}")
    warm, then = _measure_archive(root)
    site.say(f"from a checkpoint: {warm}; a question about the past: {then}")
    young, old = (
        _last_day(root, site.folder / name, times) for name, times in (("one", 0), ("old", 2))
    )
    tries = [(_measure_process("ready", young), _measure_process("ready", old)) for _ in range(2)]
    # The minimum of two runs counts, because other load on the machine only adds time.
    alone, aged = (
        {name: min(one[name] for one in side) for name in OWN} for side in zip(*tries, strict=True)
    )
    site.say(f"one day alone: {alone}; after {DAYS - 1} days of months ago: {aged}")
    return [
        make_figure("faults.age.ready_s", warm["seconds"]),
        make_figure("faults.age.ready_mb", warm["mb"]),
        make_figure("faults.age.at_mb", then["mb"]),
        make_figure("faults.age.cold_s", cold["seconds"]),
        make_figure("faults.age.cold_mb", cold["mb"]),
        make_figure("faults.age.cells", min(cold["cells"], warm["cells"])),
        make_figure("faults.age.at_bytes", then["bytes"]),
        make_figure("faults.age.old_days", max(aged[name] / alone[name] for name in OWN)),
        make_figure(
            "faults.age.tenfold",
            max(
                now["mb"] / before["mb"]
                for now, before in zip((warm, then), smaller[0], strict=True)
            ),
        ),
        Figure("faults.age.observations", millions, "10^6 observations"),
        Figure("faults.age.at_s", then["seconds"], "s"),
        Figure("faults.age.cold_processor_s", cold["processor_s"], "s"),
    ]


def _measure_smaller(site: Site, millions: float) -> tuple[dict[str, float], dict[str, float]]:
    """Generate an archive of `millions` million observations, and return the figures of a service's
    start from a checkpoint (saved state) and of a query about the past, both on this archive.
    """
    root = _ensure_archive(site, site.folder / f"age-{millions:g}", round(millions * 1e6))
    ready, past = _measure_archive(root)
    site.say(f"{millions:g} million: from a checkpoint {ready}; a question about the past {past}")
    shutil.rmtree(root)
    return ready, past


def _measure_archive(root: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Measure how long a service takes to start from a checkpoint (saved state) of the archive
    `root`, and to answer a query about the past. Return the figures.
    """
    _measure_process("checkpoint", root)
    synthetic.write_archive(
        root, SyntheticFleet(SINCE, 1, vehicles=50, seed=int(time.time())), SEGMENT
    )
    return _measure_process("ready", root), _measure_process("past", root, _encode_past_query(root))


def _ensure_archive(site: Site, root: Path, observations: int) -> Path:
    """Return the folder `root` of an archive with `observations` observations. Generate the archive
    if `root` contains none of this size.
    """
    size_file = root / "size"
    if size_file.exists() and size_file.read_text() == str(observations):
        return root
    shutil.rmtree(root, ignore_errors=True)
    synthetic.write_archive(root, SyntheticFleet(observations, DAYS, vehicles=1000), SEGMENT)
    _write_states(root, 2 * observations)
    site.say("written; being compacted")
    words = ["compact", "--archive", str(root), "--round-rows", "1000000"]
    subprocess.run(
        [sys.executable, "-m", "fleet_service.cli", *words], check=True, stdout=subprocess.DEVNULL
    )
    size_file.write_text(str(observations))
    return root


def _last_day(root: Path, to: Path, old: int) -> Path:
    """Create an archive in the folder `to` whose files are links to files of the archive `root`,
    and return `to`. It has the last day of `root`. If `old` is not 0, it also has the other days,
    moved into the past by `old` times MAP_DAYS, so that they are expired.
    """
    shutil.copytree(root / "keys", to / "keys") if (root / "keys").exists() else None
    days = sorted({folder.name for folder in root.glob("observations/date=*")})
    for folder in root.glob("*/date=*"):
        on = date.fromisoformat(folder.name.removeprefix("date="))
        if folder.name != days[-1]:
            on -= timedelta(days=old * MAP_DAYS)
        if folder.parent.name in layout.TABLES.values() and (old or folder.name == days[-1]):
            shutil.copytree(folder, to / folder.parent.name / f"date={on}", copy_function=os.link)
    return to


def _write_states(root: Path, rows: int) -> None:
    """Write `rows` states (vehicle positions and speeds) of a thousand vehicles into an archive.
    Each batch has two states. The vehicles drive on the roads of the archive's observations.
    """
    writer = Writer(root, "shard-1")
    rng = np.random.default_rng(1)
    at = 0
    model = next(synthetic.make_chunks(SyntheticFleet(SEGMENT, 1, vehicles=1000), 24))
    while at < rows:
        n = min(SEGMENT, rows - at)
        part = {name: column[:n].copy() for name, column in model.items()}
        order = at + np.arange(n)
        part["time"] = START_NS + order * (DAYS * DAY_NS // rows) // 1000 * 1000
        part["boot"] = part["boot"] * 0 + 7
        part["row"] = (order % 2).astype(np.int32)
        part["vehicle"] = np.array([f"{one:016x}" for one in (order // 2 % 1000 + 1).tolist()])
        part["seq"] = order // 2 // 1000 + 1
        part["first_held"] = np.maximum(part["seq"] - 5, 1)
        for name in ("vx", "vy", "yaw_rate", "sideslip"):
            part[name] = rng.normal(10.0, 1.0, n).astype(np.float32)
        part["received_at"] = part["time"] + 10**9
        columns = {
            f.name: part[f.name] if f.name in part else np.zeros(n, np.float32)
            for f in SCHEMAS[Kind.STATE]
        }
        writer.write(Kind.STATE, columns | {"with_likelihood": np.zeros(n, bool)})
        writer.sync()
        at += n


def _encode_past_query(root: Path) -> bytes:
    """Return a query about the map at a past moment, encoded for the program `age_process`. Its
    moment and its box (rectangle of latitude and longitude) are chosen so that the service would
    accept the query.
    """
    question = PastQuery(query.parse({"bbox": NEAR}), START_NS + (DAYS - 1) * DAY_NS, 120.0, None)
    assert 0 < rows_near(root, question.at, box_of(question), LOOKED_ROWS) <= LOOKED_ROWS
    return encode_question(question)


def _measure_process(what: str, root: Path, asked: bytes = b"") -> dict[str, float]:
    """Run the program `age_process` on an archive. `what` names its operation: "ready",
    "checkpoint" or "past"; `asked` is the encoded query for "past". Return the time [s] and the
    peak memory [MB] that the program prints.
    """
    command = [sys.executable, "-m", "tests.faults.age_process", what, str(root)]
    done = subprocess.run(command, input=asked, stdout=subprocess.PIPE, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found
