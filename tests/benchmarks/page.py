"""`make page-bench`: measure the live page, and compare it with a MapLibre page that shows the same
cells as GeoJSON in the same browser.

Writes `.page/figures.json` and prints the table. The times depend on this machine and its software
renderer, so only their ratios are meaningful. Chromium is needed, and npm for MapLibre and
axe-core. A figure whose tool is missing fails.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import functools
import http.server
import json
import math
import re
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import pyarrow as pa

from fleet_service.archive.export import extract
from fleet_service.archive.format import geo
from schemas import keys
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.runtime.palette import FOUR, GROUND, LITTLE, TWO
from schemas.thresholds import NS
from tests import browser, npm
from tests.benchmarks import page_stage
from tests.benchmarks.page_outside import measure_outside
from tests.benchmarks.page_stage import CELLS, Stage, open_stage, pin_to_core, seen_town
from tests.browser import Opened
from tests.colour_vision import SIGHTS, colour_difference, to_lab
from tests.fleet_service.page import scan
from tests.fleet_service.page.contrast import worst_contrasts
from tests.waiting import until

T = TypeVar("T")
OUT: Final = Path(".page")
SEED: Final = 20_319
CHANGED_HZ: Final = 1000  # cells that change per second
# Time between two publications; a service publishes each of the four tiles once a second.
PUT_S: Final = 0.25
PUSHES: Final = 120
DRAWN_S: Final = 10.0
FIRST: Final = 100  # number of the first push; content of the page before it has smaller numbers
WATCHERS: Final = (400, 300, 200, 100, 50)
WATCHED_PUSHES: Final = 20
VIEWPORT: Final = {"width": 1600, "height": 1100}
ROUNDS: Final = 3
ALL: Final = (*FOUR, *TWO, LITTLE, GROUND)

# A picture counts when all cells have been painted. performance.now() is 0 at the start of the
# navigation.
_WATCH: Final = """
  globalThis.shown = null; globalThis.numbers = [];
  document.addEventListener("DOMContentLoaded", () => new MutationObserver(() => {
    if (!shown && document.body.dataset.drawn >= CELLS) globalThis.shown = performance.now();
    for (const place of globalThis.markers ?? []) {
      const number = gripmap.state.now.at_place(...place)[0]?.vehicles;
      if (number && !numbers.some(one => one[0] === number)) numbers.push([number, Date.now()]);
    }
  }).observe(document.body, { attributeFilter: ["data-drawn"] }));
""".replace("CELLS", str(CELLS))
# Move the map at each frame of the browser, as a user does, and count the painted pictures. If the
# script waited for each picture before the next move, every second frame would show none.
_MOVES: Final = """async () => {
  const began = performance.now(), before = painted();
  for (let k = 0; performance.now() - began < 3000; k++) {
    move(k);
    await new Promise(requestAnimationFrame);
    if (!there()) return 0;
  }
  return 1000 * (painted() - before) / (performance.now() - began);
}"""
_OURS: Final = """() => {
  const draw = gripmap.map.drawNow;
  let count = 0;
  gripmap.map.drawNow = function () { count++; draw.call(gripmap.map); };
  globalThis.painted = () => count;
  globalThis.move = k => {
    gripmap.map.view.shift(9 * Math.sin(k / 5), 4 * Math.cos(k / 7));
    gripmap.map.view.turn(1 + .01 * Math.sin(k / 9));
  };
  globalThis.there = () => document.body.dataset.drawn > 0;
}"""
_THEIRS: Final = """() => {
  let count = 0;
  map.on("render", () => count++);
  globalThis.painted = () => count;
  globalThis.move = k => {
    map.jumpTo({ zoom: map.getZoom() + Math.log2(1 + .01 * Math.sin(k / 9)) });
    map.panBy([-9 * Math.sin(k / 5), -4 * Math.cos(k / 7)], { animate: false });
  };
  globalThis.there = () => true;
}"""
_MAPLIBRE: Final = """<!doctype html><meta charset="utf-8">
<link rel="stylesheet" href="maplibre-gl.css">
<style>body { margin: 0 } #map { width: 1184px; height: 1000px }</style><div id="map"></div>
<script src="maplibre-gl.js"></script><script>
const mu = ["coalesce", ["get", "mu"], 1];
const colour = ["step", mu, "#4c007b", .2, "#aa5271", .4, "#f58c41", .6, "#eeea79"];
const paint = { "fill-antialias": false, "fill-color": colour };
const layers = [{ id: "cells", type: "fill", source: "cells", paint }];
const style = { version: 8, sources: { cells: { type: "geojson", data: "town.geojson" } }, layers };
const map = new maplibregl.Map({
  container: "map", center: [LON, LAT], zoom: ZOOM - 1, fadeDuration: 0,
  attributionControl: false, style,
});
map.once("idle", () => { globalThis.shown = performance.now(); });
</script>"""


@contextmanager
def open_window(address: str) -> Iterator[Opened]:
    """Open an address in a large browser window, wait until the page has painted its map, and yield
    the window.
    """
    with browser.open_page("about:blank", unbound=True) as seen:
        size: Any = VIEWPORT
        seen.page.set_viewport_size(size)
        seen.page.add_init_script(_WATCH)
        seen.page.goto(address)
        until(lambda: seen.page.evaluate("globalThis.shown"), 120.0)
        yield seen


def measure_drawing(on: Stage) -> dict[str, float]:
    """Measure in a browser the time of the first picture and the frame rate, alternately of our
    page and of MapLibre. Also count the page's errors and its requests to other hosts. Return the
    figures by name.
    """
    ours: list[tuple[float, float]] = []
    theirs: list[tuple[float, float]] = []
    errors = list[str]()
    foreign = list[str]()
    with serve_maplibre(on) as other:
        for _ in range(ROUNDS):
            with open_window(seen_town(on.address, on.town)) as seen:
                first = float(seen.page.evaluate("shown / 1000"))
                seen.page.evaluate(_OURS)
                ours.append((first, float(seen.page.evaluate(_MOVES))))
                errors += seen.errors
                foreign += [
                    url
                    for url in seen.requests
                    if not url.startswith((on.address, "data:", "about:"))
                ]
            if other is not None:
                with open_window(other) as seen:
                    first = float(seen.page.evaluate("shown / 1000"))
                    seen.page.evaluate(_THEIRS)
                    theirs.append((first, float(seen.page.evaluate(_MOVES))))
    for line in (*errors, *foreign):
        print(f"  {line}", file=sys.stderr)
    picture, frames = (float(np.median([one[k] for one in ours])) for k in (0, 1))
    found = {"first_picture_s": picture, "frames_hz": frames}
    found |= {"console_errors": float(len(errors)), "foreign_requests": float(len(foreign))}
    their_picture, their_frames = (
        float(np.median([one[k] for one in theirs] or [math.nan])) for k in (0, 1)
    )
    return found | {
        "maplibre_first_picture_s": their_picture,
        "maplibre_frames_hz": their_frames,
        "fps": frames / their_frames,
    }


@contextmanager
def serve_maplibre(on: Stage) -> Iterator[str | None]:
    """Yield the address of a MapLibre page with the town as GeoJSON, or None if npm has not
    downloaded MapLibre.
    """
    files = [npm.file_of("maplibre-gl", path) for path in npm.PACKAGES["maplibre-gl"].files]
    if not all(files):
        print("  no MapLibre: npm did not fetch it", file=sys.stderr)
        yield None
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            assert file is not None
            (Path(folder) / file.name).write_bytes(file.read_bytes())
        town = pa.Table.from_batches([on.town.make_batch(tile) for tile in on.town.tiles]).select(
            ["cell", "mu"]
        )
        extract.write_extract(geo.with_cells(town), Path(folder) / "town.geojson")
        x, y = on.town.corner
        longitude = 360.0 * x / 2**14 - 180.0
        latitude = math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / 2**14))))
        text = _MAPLIBRE.replace("LON", str(longitude)).replace("LAT", str(latitude))
        (Path(folder) / "index.html").write_text(text.replace("ZOOM", str(page_stage.ZOOM)))
        handler = functools.partial(_Quiet, directory=folder)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}/index.html"
            server.shutdown()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Suppress the log of the HTTP server that delivers the MapLibre page."""


def pushed_ms(on: Stage) -> float:
    """Return the 95 % quantile of the time [ms] from the publication of a cell at the router until
    it is painted, while CHANGED_HZ cells change per second.
    """
    with open_window(seen_town(on.address, on.town)) as seen:
        tiles = list(on.town.tiles)
        put = dict[int, float]()
        seen.page.evaluate(
            "all => { globalThis.markers = all }",
            [[tile, on.town.local_marker(tile)] for tile in tiles],
        )
        due = time.monotonic()
        for k in range(PUSHES):
            tile = tiles[k % len(tiles)]
            number = FIRST + k
            payload = on.town.change_cells(tile, int(CHANGED_HZ * PUT_S), number)
            put[number] = 1000.0 * time.time()
            on.session.put(keys.map_key(tile), payload)
            due += PUT_S
            time.sleep(max(due - time.monotonic(), 0.0))
        # Zenoh may drop a publication. It then counts as infinitely late.
        with contextlib.suppress(TimeoutError):
            until(
                lambda: seen.page.evaluate(f"numbers.some(one => one[0] === {FIRST + PUSHES - 1})"),
                DRAWN_S,
            )
        drawn_at = {int(number): float(at) for number, at in seen.page.evaluate("numbers")}
    # If the next publication of the same tile overtakes a publication, both count as drawn with the
    # later one.
    late = [
        min(
            (
                at
                for number, at in drawn_at.items()
                if number >= k and (number - k) % len(tiles) == 0
            ),
            default=math.inf,
        )
        - begun
        for k, begun in put.items()
    ]
    return float(np.quantile(late, 0.95, method="higher"))


def bytes_per_cell(on: Stage) -> float:
    """Return the mean number of bytes per cell in the data blocks (encoded cells) that the live
    page sends to browsers, before compression.
    """
    tiles = ",".join(map(str, on.town.tiles))
    with urllib.request.urlopen(f"{on.address}blocks?tiles={tiles}", timeout=30) as answer:
        return len(answer.read()) / CELLS


async def _measure_pushes(on: Stage, count: int) -> float:
    """Let `count` watchers (event streams of browsers) receive changes of the live page. Return the
    95 % quantile of the time [s] from a publication until a watcher has received it. A publication
    that a watcher missed counts as infinity.
    """
    host, _, port = on.address.removeprefix("http://").rstrip("/").partition(":")
    received = [dict[int, float]() for _ in range(count)]
    local = on.town.local_marker(on.town.marker)
    begins = base64.b64encode(struct.pack("<I", on.town.marker))[:5]

    async def watch_events(own: dict[int, float]) -> None:
        reader, writer = await asyncio.open_connection(host, int(port), limit=1 << 22)
        writer.write(f"GET /events HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
        while line := await reader.readline():
            if line.startswith(b"data: " + begins):
                block = base64.b64decode(line[6:])
                cells = int.from_bytes(block[12:16], "little")
                place = np.frombuffer(block, "<u2", cells, 32 + 4 * cells)
                vehicles = np.frombuffer(block, "u1", cells, 32 + 11 * cells)
                for number in vehicles[place >> 2 == local].tolist():
                    own[number] = time.time()

    tasks = [asyncio.create_task(watch_events(own)) for own in received]
    while (
        json.loads(await asyncio.to_thread(_fetch_page, f"{on.address}health"))["watchers"] < count
    ):
        await asyncio.sleep(0.2)
    put = {}
    for number in range(1, WATCHED_PUSHES + 1):
        payload = await asyncio.to_thread(on.town.change_cells, on.town.marker, 250, number)
        put[number] = time.time()
        on.session.put(keys.map_key(on.town.marker), payload)
        await asyncio.sleep(0.5)
    await asyncio.sleep(3.0)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    late = [own.get(number, math.inf) - begun for own in received for number, begun in put.items()]
    return float(np.quantile(late, 0.95, method="higher"))


def _fetch_page(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=30) as answer:
        found: bytes = answer.read()
        return found


def count_watchers(on: Stage) -> float:
    """Return the largest tested number of watchers (event streams of browsers) that get 95 % of the
    updates within a second from a page on one core. Return 0 if even the smallest tested number
    does not.
    """
    pin_to_core(on.process, 0)
    for count in WATCHERS:
        late = asyncio.run(_measure_pushes(on, count))
        print(f"  {count} watchers: p95 {late:.3f} s", file=sys.stderr)
        until(lambda: json.loads(_fetch_page(f"{on.address}health"))["watchers"] == 0, 60.0)
        if late <= 1.0:
            return float(count)
    return 0.0


def count_findings(on: Stage) -> float:
    """Return the number of serious accessibility findings of axe-core in all panels, or NaN if
    axe-core is not installed.
    """
    with open_window(seen_town(on.address, on.town)) as seen:
        seen.page.evaluate(
            "([tile, local]) => gripmap.choose(tile, local)",
            [on.town.marker, on.town.local_marker(on.town.marker)],
        )
        found = scan.findings(seen)
    for line in found or ():
        print(f"  {line}", file=sys.stderr)
    return math.nan if found is None else float(len(found))


def colour_distance() -> float:
    """Return the smallest CIEDE2000 difference between two colour classes, or a class and the
    background, over all kinds of colour vision.
    """
    pairs = [(a, b) for k, a in enumerate(ALL) for b in ALL[:k]]
    return min(
        colour_difference(to_lab(a, sight), to_lab(b, sight)) for sight in SIGHTS for a, b in pairs
    )


def count_states() -> float:
    """Return the number of states of the page (such as "no service") that pass their tests. Each
    test stores a picture in `.page/states`.
    """
    path = "tests/fleet_service/page/test_states.py"
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    print(f"  {done.stdout[-200:].strip()}", file=sys.stderr)
    passed = re.search(r"(\d+) passed", done.stdout)
    return float(passed[1]) if passed and not done.returncode else 0.0


def measure_all() -> list[Figure]:
    """Run all benchmarks of the live page, and return the figures in the order of the printed
    table.
    """
    with open_stage(SEED) as on:
        found = _time_part("drawn", lambda: measure_drawing(on))
        found["push_p95_ms"] = _time_part("pushed", lambda: pushed_ms(on))
        found["bytes_per_cell"] = bytes_per_cell(on)
        found["axe_serious"] = _time_part("scanned", lambda: count_findings(on))
        found["watchers"] = _time_part("watched", lambda: count_watchers(on))
    found["states"] = _time_part("states", count_states)
    found["colour_distance"] = colour_distance()
    found["contrast_text"], found["contrast_classes"] = worst_contrasts()
    rows: list[tuple[str, str, float | None, Any]] = [
        ("first_picture_s", f"s, {CELLS} cells, the middle of {ROUNDS}", 0.5, "less"),
        ("maplibre_first_picture_s", "s", None, "less"),
        ("frames_hz", "frames/s", None, "more"),
        ("maplibre_frames_hz", "frames/s", None, "more"),
        ("fps", "times MapLibre + GeoJSON", 5.0, "more"),
        ("push_p95_ms", f"ms, put to drawn, {CHANGED_HZ} changed cells/s", 500.0, "less"),
        ("bytes_per_cell", "bytes", 16.0, "less"),
        ("watchers", "with p95 of a push within 1 s, one core", 200, "more"),
        ("foreign_requests", "requests", 0, "less"),
        ("console_errors", "errors", 0, "less"),
        ("axe_serious", "findings", 0, "less"),
        ("states", "states with tests and pictures", 10, "more"),
        ("contrast_text", "to 1, the least (WCAG AA)", 4.5, "more"),
        ("contrast_classes", "to 1, the least (WCAG AA)", 3.0, "more"),
        ("colour_distance", "CIEDE2000, the least", 10.0, "more"),
    ]
    own = [
        Figure(f"page.{name}", found[name], unit, bar, better) for name, unit, bar, better in rows
    ]
    return own + _time_part("what leaves the house", measure_outside)


def _time_part(what: str, measure: Callable[[], T]) -> T:
    began = time.monotonic()
    found = measure()
    print(f"  {what}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def main() -> int:
    """Run all benchmarks of the live page, and write and print the figures. Return 1 if a figure
    misses its target, otherwise 0.
    """
    began = time.time_ns()
    rows = measure_all()
    OUT.mkdir(exist_ok=True)
    figures.write_figures(OUT / "figures.json", "page", [SEED], rows)
    print(figures.format_table(rows))
    print(f"{(time.time_ns() - began) / NS:.0f} s", file=sys.stderr)
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except subprocess.CalledProcessError as error:
        sys.exit(str(error))
