"""Typical mistakes at the command line: each must end with one line and exit code 2, or with an
error of argparse, and never with a traceback.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import edge_agent.cli
import fleet_service.cli

EDGE: Final = (
    "",
    "no-such-command",
    "simulate",
    "simulate no-such-manoeuvre --out {d}/x.parquet",
    "simulate slalom",
    "simulate slalom --mu 5 --out {d}/x.parquet",
    "simulate slalom --mu nan --out {d}/x.parquet",
    "simulate slalom --rate 0 --out {d}/x.parquet",
    "simulate slalom --duration -1 --out {d}/x.parquet",
    "simulate slalom --out /proc/none/x.parquet",
    "simulate slalom --out {d}/x.xlsx",
    "simulate slalom --sensors bad",
    "import",
    "import {d}/none.blf --out {d}/y.parquet",
    "import {d}/text.csv --out {d}/text.csv",
    "import {d}/text.csv --profile no-such --out {d}/y.parquet",
    "check {d}/none.parquet",
    "check {d}/text.csv",
    "check {d}/log.parquet --vehicle {d}/none.json",
    "calibrate {d}/none.parquet --vehicle {d}/car.json --out {d}/c.json",
    "calibrate {d}/log.parquet --vehicle {d}/bad.json --out {d}/c.json",
    "replay {d}/none.parquet --out {d}/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --out {d}/log.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --out {d}/e.xlsx",
    "replay {d}/log.parquet --vehicle {d}/car.json --out /proc/none/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --out /proc/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --estimator none --out {d}/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/bad.json --out {d}/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --memberships {d}/bad.json --out {d}/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --start yesterday --out {d}/e.parquet",
    "replay {d}/log.parquet --vehicle {d}/car.json --config {d}/bad.json --out {d}/e.parquet",
    "replay {d}/log.parquet {d}/log.parquet --out {d}/folder",
    "replay {d}/log.parquet --jobs 0 --out {d}",
    "run --source {d}/log.parquet",
    "run --source nothing:here --vehicle {d}/car.json",
    "run --name X",
    "run --config {d}/none.json",
    "fleet --vehicles -1",
    "fleet --scenario none",
    "tune --ants 0",
    "tune --seed -1",
    "evaluate --out /proc/none",
    "evaluate --seeds 1 --out {d}/ev",
    "completion abacus",
)
FLEET: Final = (
    "",
    "no-such-command",
    "router --config {d}/none.json5",
    "run --archive /proc/none",
    "run --archive {d}/a --config {d}/bad.json",
    "query --bbox 1,2",
    "query --bbox -181,0,1,1",
    "query --bbox a,b,c,d",
    "query --route 1,2",
    "query --at yesterday",
    "query --format xml",
    "query --out {d}/x.xlsx",
    "query --out /proc/none/x.json",
    "query --min-vehicles none",
    "page --port none",
    "page --port 70000",
    "page --config {d}/none.json",
    "page --archive {d}",
    "page --country se",
    "page --base-map {d}/none.mbtiles",
    "page --host no.such.host.invalid --port 0",
    "roads {d}/none.osm.pbf --out {d}/r.parquet",
    "size --vehicles 0 --road-km 1",
    "roads {d}/text.csv --out {d}/r.parquet",
    "roads {d}/none.gpkg --out {d}/r.xlsx",
    "rebuild --archive {d} --out {d}/r",
    "rebuild --archive {a} --out /proc/none/r",
    "rebuild --archive {a} --out {d}/r --to yesterday",
    "rebuild --archive {a} --out {d}/r --engine abacus",
    "export datex --out {d}/x.xml",
    "analyze contract --archive {a}",
    "query --connect tcp/127.0.0.1:1",
    "query --connect nonsense",
    "query --config {d}/none.json",
    "watch --bbox 1",
    "watch --webhook nonsense",
    "watch --config {d}/bad.json",
    "compact --archive {d}",
    "cits --amqp nonsense",
    "hand-over nowhere --to north-b",
    "hand-over */*/* --to north-b --connect tcp/127.0.0.1:1",
    "hand-over */*/*",
    "compact --archive {d}/none",
    "compact --archive {a} --round-rows 0",
    "compact --archive {a} --put-to nonsense://x",
    "retention --archive {a} --raw-days 1",
    "retention --archive {d} --raw-days 31",
    "forget --archive {a} --period x",
    "forget --archive {a} --period 1999-01",
    "export map --archive {d} --out {d}/x.csv",
    "export map --archive {a} --out {d}/x.xlsx",
    "export map --archive {a} --out /proc/none/x.csv",
    "export nothing --archive {a} --out {d}/x.csv",
    "export map --archive {a} --out {d}/x.csv --from z",
    "export map --archive {a} --out {d}/x.csv --from 2030-01-01",
    "analyze nothing --archive {a}",
    "analyze grip --archive {d}",
    "analyze grip --archive {a} --at 2024-10-04",
    "analyze grip --archive {a} --engine x",
    "analyze grip --archive {a} --out {d}/x.xlsx",
    "analyze grip --archive {a} --from 1980-01-01 --to 1980-01-02",
    "analyze before-after --archive {a}",
    "analyze weather --archive {a}",
    "analyze weather --archive {a} --stations {d}/text.csv",
    "analyze weather --archive {a} --stations {d}/none.csv",
    "analyze replay --archive {a} --step -5",
    "analyze replay --archive {a} --step nan",
    "analyze worst --archive {a} --min-vehicles 0",
    "analyze vehicles --archive {a} --out {d}/x.html",
    "certs --fleet {d}/none.json --out {d}/c",
    "certs --fleet {d}/bad.json --out {d}/c",
    "certs --fleet {d}/bad.json --out {d}/c --days 0",
    "evaluate --out /proc/none --quick --skip-end-to-end",
    "completion abacus",
)


def prepare_files(folder: Path) -> None:
    """Create the files to which the mistaken commands refer."""
    (folder / "text.csv").write_text("a;b\n1,5;x\n")
    (folder / "bad.json").write_text(json.dumps({"mass": "heavy", "surprise": 1}))
    words = ["simulate", "slalom", "--duration", "1", "--out", str(folder / "log.parquet")]
    assert edge_agent.cli.main([*words, "--vehicle-out", str(folder / "car.json")]) == 0


def find_tracebacks(folder: Path, archive: Path) -> tuple[int, list[str]]:
    """Run the command lines that contain a mistake. Return their number, and a list of those that
    ended with a traceback or with exit code 0.
    """
    bad = []
    lines: list[tuple[Callable[[list[str]], int], str]] = [
        (edge_agent.cli.main, line) for line in EDGE
    ]
    lines += [(fleet_service.cli.main, line) for line in FLEET]
    for main, line in lines:
        words = line.format(d=folder, a=archive).split()
        stderr = io.StringIO()
        try:
            with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
                code = main(words)
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else 1
        except BaseException as error:  # noqa: BLE001 a user would see any exception
            bad.append(f"{line}: {type(error).__name__}: {error}")
            continue
        if code == 0 or "Traceback" in stderr.getvalue():
            bad.append(f"{line}: exit code {code}")
    return len(lines), bad
