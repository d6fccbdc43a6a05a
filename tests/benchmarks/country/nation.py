"""Benchmark of a country's reports, sent to several services at once: delay of the services, growth
of memory, and processor time of each process.

Router, services and the sender of all vehicles run in separate processes on the same two cores. In
a real deployment router and senders would run on other machines, so processor time is measured per
process.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
import urllib.request
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow.parquet as pq

from schemas.config import ServiceConfig, ZenohSettings
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from tests.benchmarks.country.coefficients import Coefficients
from tests.benchmarks.country.replayed import PERIOD_S, RATE, ROWS, VEHICLES, ZONES, Country
from tests.benchmarks.country.sender import EVERY_S as SAYS_S
from tests.faults.processes import Part
from tests.faults.soak import fit_slope, memory_mb

# The measurement begins after this time. By then all cells were visited, the window is full, and
# two checkpoints have released their memory.
WARM_S: Final = 660.0
MEASURED_S: Final = 600.0
EVERY_S: Final = 5.0
MEMORY_S: Final = 0.25
# Compaction then runs once before the measured ten minutes and twice during them.
COMPACT_S: Final = 240.0
SERVICES: Final = ("west", "middle", "east")
_TICKS: Final = os.sysconf("SC_CLK_TCK")


class Look(NamedTuple):
    """Sample of the run at one moment.

    Attributes:
        time: time since the beginning of the run [s].
        memory: memory of each process except the sender [MB]. It is the minimum since the previous
            sample, because writing a segment (file of new rows) temporarily needs 20 MB.
        spent: processor time of each process [s].
        cells: number of map cells of each service.
        rows: number of admitted rows of each service.
        queued: number of messages that wait in each service.
    """

    time: float
    memory: list[float]
    spent: list[float]
    cells: list[float]
    rows: list[float]
    queued: list[float]


def spent_s(part: Part) -> float:
    """Return the processor time [s] of a process and of its child processes that have ended."""
    fields = Path(f"/proc/{part.pid}/stat").read_text().rpartition(")")[2].split()
    return sum(int(field) for field in fields[11:15]) / _TICKS


class Service(NamedTuple):
    """Fleet service that serves a part of the country, with the address of its metrics."""

    part: Part
    archive: Path
    metrics: str

    def read_metrics(self) -> dict[str, float]:
        """Return the service's current metrics by name and labels."""
        with urllib.request.urlopen(f"{self.metrics}/metrics", timeout=30.0) as page:
            lines = page.read().decode().splitlines()
        return {
            line.rpartition(" ")[0]: float(line.rpartition(" ")[2])
            for line in lines
            if not line.startswith("#")
        }

    def count_archived(self) -> int:
        """Return the number of observation rows in the service's archive, from the footers of its
        files.
        """
        files = [
            *self.archive.glob("inbox/**/*.parquet"),
            *self.archive.glob("observations/**/*.parquet"),
        ]
        return sum(pq.read_metadata(file).num_rows for file in files)


def start_service(folder: Path, endpoint: str, name: str, region: str) -> Service:
    """Start a fleet service, and return it when it is ready."""
    config = ServiceConfig(
        name=name,
        regions=[region],
        zenoh=ZenohSettings(connect=[endpoint]),
        metrics_port=0,
        compact_s=COMPACT_S,
    )
    path = folder / f"{name}.json"
    archive = folder / name
    path.write_text(
        config.model_dump_json(include={"name", "regions", "zenoh", "metrics_port", "compact_s"})
    )
    words = ("-m", "fleet_service.cli", "run", "--archive", str(archive), "--config", str(path))
    part = Part(name, [sys.executable, *words], folder)
    part.start()
    return Service(part, archive, part.line_with("ready: ").split()[-1])


def simulate_nation(
    city: Path, folder: Path, seed: int, coefficients: Coefficients
) -> list[Figure]:
    """Run the country's services and vehicles, and measure delay, memory and processor time. The
    samples of the run stay in `folder`/course.npz.
    """
    country = Country(city, seed)
    seconds = WARM_S + MEASURED_S
    with ExitStack() as stack:
        router = Part(
            "router", [sys.executable, "-m", "deploy.router", "--listen", "tcp/127.0.0.1:0"], folder
        )
        stack.callback(router.kill)
        router.start()
        endpoint = router.line_with("router: ").split()[1]
        services = []
        for name, region in zip(SERVICES, country.list_expressions(), strict=True):
            services.append(start_service(folder, endpoint, name, region))
            stack.callback(services[-1].part.kill)
        words = [endpoint, str(city), str(folder / "waits.npz"), "--seconds", str(seconds)]
        words += ["--vehicles", str(VEHICLES), "--seed", str(seed)]
        sender = Part(
            "sender", [sys.executable, "-m", "tests.benchmarks.country.sender", *words], folder
        )
        stack.callback(sender.kill)
        sender.start()
        sender.line_with("{")
        looks = _watch_parts([*(one.part for one in services), router, sender], services, sender)
        sent = _last_line(sender)
        counts = [one.read_metrics() for one in services]
        codes = [one.part.stop() for one in services]
    _save_course(folder, looks)
    if any(codes):
        raise RuntimeError(f"services left with {codes}")
    with np.load(folder / "waits.npz") as waits:
        found = _make_wait_figures(waits["put"], waits["wait"], waits["region"])
    return [
        *found,
        *_make_growth_figures(looks, coefficients),
        *_make_share_figures(looks, int(sent["observations"])),
        *_make_archive_figures(services, sent, counts),
    ]


def _make_archive_figures(
    services: Sequence[Service], sent: dict[str, float], counts: list[dict[str, float]]
) -> list[Figure]:
    """Return the figures of lost batches and observations, and of the size of the archives, after
    the services have ended. `sent` is the sender's summary, and `counts` the services' metrics.
    """
    archived = sum(one.count_archived() for one in services)
    files = [file for one in services for file in one.archive.glob("observations/**/*.parquet")]
    size = sum(file.stat().st_size for file in files)
    compacted = sum(pq.read_metadata(file).num_rows for file in files)
    return [
        Figure(
            "country.unacknowledged",
            sent["unacknowledged"],
            "batches, half a minute after the last",
            0,
        ),
        Figure(
            "country.missing",
            sent["observations"] - archived,
            "observations that the archives do not hold",
            0,
        ),
        Figure("country.not_fused", _not_fused(counts), "observations that were archived only"),
        Figure(
            "country.archive_bytes", size / max(compacted, 1), "bytes per compacted observation"
        ),
    ]


def _watch_parts(parts: Sequence[Part], services: Sequence[Service], sender: Part) -> list[Look]:
    """Sample all processes every EVERY_S seconds while the sender process runs, and return the
    samples.
    """
    looks: list[Look] = []
    began = time.monotonic() - SAYS_S
    least = [float("inf")] * (len(parts) - 1)
    while sender.is_alive:
        values = [one.read_metrics() for one in services]
        looks.append(
            Look(
                time.monotonic() - began,
                _update_least(least, parts),
                [spent_s(part) for part in parts],
                [value["gripmap_cells"] for value in values],
                [value['gripmap_rows_total{kind="observation"}'] for value in values],
                [value["gripmap_queue_messages"] for value in values],
            )
        )
        if len(looks) % 6 == 0:
            now = looks[-1]
            last = _last_line(sender)
            memory = ", ".join(f"{value:.0f}" for value in now.memory)
            waits = f"oldest {last.get('oldest_s', 0.0):.1f} s, p99 {last.get('p99_s', 0.0):.2f} s"
            late = f"sender {last.get('late_s', 0.0):.1f} s late"
            print(
                f"  {now.time:4.0f} s: {sum(now.cells):.0f} cells, {memory} MB, {waits}, {late}",
                flush=True,
            )
        least = _update_least([float("inf")] * len(least), parts)
        while time.monotonic() < began + SAYS_S + len(looks) * EVERY_S:
            time.sleep(MEMORY_S)
            least = _update_least(least, parts)
    return looks


def _update_least(before: list[float], parts: Sequence[Part]) -> list[float]:
    """Return, for each process in `parts`, the smaller of its entry in `before` and its present
    memory size [MB]. Repeated calls thus give the minimum over an interval. The last process, the
    sender, is left out.
    """
    return [min(then, memory_mb(part)) for then, part in zip(before, parts[:-1], strict=True)]


def _last_line(sender: Part) -> dict[str, float]:
    """Return the last complete line that the sender process printed, parsed from JSON."""
    whole = [line for line in sender.read_lines() if line.endswith("}")]
    summary: dict[str, float] = json.loads(whole[-1])
    return summary


def _save_course(folder: Path, looks: Sequence[Look]) -> None:
    time_s, memory, spent, cells, rows, queued = (
        np.array(column) for column in zip(*looks, strict=True)
    )
    np.savez(
        folder / "course.npz",
        time=time_s,
        memory=memory,
        spent=spent,
        cells=cells,
        rows=rows,
        queued=queued,
    )


def _make_wait_figures(put: FloatArray, wait: FloatArray, region: FloatArray) -> list[Figure]:
    """Return figures of the acknowledgement delay, the time from sending a batch to its
    acknowledgement. Only batches sent in the measured ten minutes count.

    The figures are the sending rate, and the maximum, the 99th percentile and the median of the
    delay over all batches. For median and 99th percentile, another figure gives the ratio of the
    slowest region to the fastest region.
    """
    measured = (put >= WARM_S) & (put < WARM_S + MEASURED_S)
    waits = np.where(np.isnan(wait), np.inf, wait)
    halves, most = np.transpose(
        [
            np.quantile(waits[:, region == k][measured[:, region == k]], (0.5, 0.99))
            for k in range(sum(ZONES))
        ]
    )
    rate = measured.sum() * ROWS / MEASURED_S
    return [
        Figure("country.rate", float(rate), "observations/s that were sent", 0.98 * RATE, "more"),
        Figure(
            "country.lag_s",
            float(waits[measured].max()),
            "s, the longest that any batch waited for its ack",
            5,
        ),
        Figure("country.ack_p99_s", float(np.quantile(waits[measured], 0.99)), "s"),
        Figure("country.ack_p50_s", float(np.median(waits[measured])), "s"),
        Figure(
            "country.region_p50_ratio",
            float(halves.max() / halves.min()),
            "slowest region over the fastest",
            1.2,
        ),
        Figure(
            "country.region_p99_ratio",
            float(most.max() / most.min()),
            "slowest region over the fastest; depends on when a checkpoint is written",
        ),
    ]


def _make_growth_figures(looks: Sequence[Look], coefficients: Coefficients) -> list[Figure]:
    """Return figures of the growth of the services' memory over the measured ten minutes, and of
    the part due to new cells.
    """
    time_s = np.array([look.time for look in looks])
    # Whole minutes: the fitted line goes through the minimum of each minute.
    late = (time_s >= WARM_S) & (time_s < WARM_S + MEASURED_S)
    memory, cells = (
        np.array([getattr(look, name) for look in looks])[late] for name in ("memory", "cells")
    )
    grown = sum(fit_slope(time_s[late], memory[:, k]) for k in range(len(SERVICES)))
    new = float(cells[-1].sum() - cells[0].sum())
    beyond = grown - new * coefficients.cell_bytes / 1e6
    return [
        Figure(
            "country.growth_mb_per_10min",
            beyond,
            f"MB of all services, beyond {new:.0f} new cells",
            5,
        ),
        Figure("country.grown_mb", grown, "MB in the ten minutes with them"),
        Figure("country.cells", float(cells[-1].sum()), "cells of the country"),
        Figure(
            "country.memory_mb",
            float(memory[-1, : len(SERVICES)].sum()),
            "MB of all services at the end",
        ),
        Figure(
            "country.memory_largest_mb",
            float(memory[:, : len(SERVICES)].max()),
            "MB of one of them, at the most",
        ),
    ]


def _make_share_figures(looks: Sequence[Look], observations: int) -> list[Figure]:
    """Return figures of the processor time that services, router and sender used in the measured
    ten minutes: cores used by each of them, and time per observation.
    """
    late = [look for look in looks if look.time >= WARM_S]
    first = late[0]
    last = late[-1]
    apart = last.time - first.time
    rows = np.array(last.rows) - first.rows
    spent = (np.array(last.spent) - first.spent) / apart
    per_row = spent[: len(SERVICES)] * apart / rows
    return [
        Figure(
            "country.observations",
            float(observations),
            f"of {VEHICLES} vehicles, one batch each {PERIOD_S:.0f} s",
        ),
        Figure(
            "country.busiest_rows",
            float(rows.max() / rows.min()),
            "rows of the busiest service over the least",
            1.2,
        ),
        Figure(
            "country.busiest_cores",
            float(spent[: len(SERVICES)].max()),
            "cores of the busiest service",
        ),
        Figure("country.cores", float(spent[: len(SERVICES)].sum()), "cores of all services"),
        Figure("country.router_cores", float(spent[-2]), "cores of the router"),
        Figure("country.sender_cores", float(spent[-1]), "cores of the vehicles' sender"),
        Figure(
            "country.service_us", float(1e6 * per_row.mean()), "µs of a service per observation"
        ),
        Figure(
            "country.router_us",
            float(1e6 * spent[-2] * apart * ROWS / rows.sum()),
            "µs of the router per batch",
        ),
    ]


def _not_fused(counts: Sequence[dict[str, float]]) -> float:
    wanted = re.compile(r"gripmap_(late|implausible_moves|too_many_places)_total")
    return sum(value for one in counts for name, value in one.items() if wanted.fullmatch(name))
