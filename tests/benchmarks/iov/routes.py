"""Routes around ice that Valhalla computes in a street network, with the costs that `export
valhalla` writes.

The Python package of Valhalla needs Python 3.12, but its wheel also contains Valhalla's own
programs, which run without Python.
"""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fleet_service.client import routing
from schemas import grid
from schemas.numeric import FloatArray
from schemas.thresholds import METRES_PER_DEGREE

VERSION: Final = "3.9.1"
STREETS: Final = 14  # streets in each direction
APART_M: Final = 150.0
ORIGIN: Final = (57.70, 11.95)
ICY_SHARE: Final = 0.08  # share of icy links; a link joins two crossings
EDGE: Final = "edge_walk"
NO_PATH: Final = 442  # Valhalla's error code when there is no route


@dataclass(frozen=True)
class StreetTown:
    """Street network: crossings (n, 2) [deg], and streets as pairs of crossing indices."""

    crossings: FloatArray
    streets: list[tuple[int, int]]

    def line(self, street: tuple[int, int]) -> routing.RoadLine:
        """Return a street as the polyline that the computation of route costs takes. `street` is a
        pair of crossing indices. The polyline runs from the first crossing to the second.
        """
        first, last = self.crossings[list(street)]
        return routing.RoadLine(np.array([first[0], last[0]]), np.array([first[1], last[1]]))


def make_town(draw: np.random.Generator) -> StreetTown:
    """Return a town of crooked streets in which a tenth of the links is missing."""
    wide = APART_M / METRES_PER_DEGREE
    k = np.arange(STREETS)
    north, east = (part.ravel() for part in np.meshgrid(k, k, indexing="ij"))
    jitter = draw.normal(0.0, 0.12, (2, STREETS**2))
    scale = np.cos(np.radians(ORIGIN[0]))
    crossings = np.stack(
        (ORIGIN[0] + wide * (north + jitter[0]), ORIGIN[1] + wide * (east + jitter[1]) / scale), 1
    )
    all_links = [(i, i + 1) for i in range(STREETS**2) if (i + 1) % STREETS]
    all_links += [(i, i + STREETS) for i in range(STREETS**2 - STREETS)]
    return StreetTown(crossings, [link for link in all_links if draw.random() > 0.1])


def write_town(town: StreetTown, path: Path) -> None:
    """Write the street network of a town as OpenStreetMap XML, from which Valhalla is built."""
    nodes = [
        f'<node id="{n + 1}" version="1" lat="{a:.7f}" lon="{b:.7f}"/>'
        for n, (a, b) in enumerate(town.crossings)
    ]
    ways = [
        f'<way id="{n + 1}" version="1"><nd ref="{a + 1}"/><nd ref="{b + 1}"/>'
        f'<tag k="highway" v="residential"/><tag k="name" v="Street {n + 1}"/></way>'
        for n, (a, b) in enumerate(town.streets)
    ]
    path.write_text("\n".join(['<osm version="0.6">', *nodes, *ways, "</osm>"]), encoding="utf-8")


def icy_map(town: StreetTown, icy: Sequence[tuple[int, int]]) -> pa.Table:
    """Return a map in which the given streets are ice in both directions, and all
    others have grip.
    """
    rows: dict[tuple[int, int], float] = {}
    for street in sorted(town.streets, key=lambda one: one in icy, reverse=True):
        line = town.line(street)
        for road in (line, routing.RoadLine(line.latitude[::-1], line.longitude[::-1])):
            latitude, longitude, yaw = routing._sample_road(road)
            inner = slice(4, -4)  # leave out the ends: crossings belong to several streets
            for cell, sector in zip(
                grid.cell_of(latitude[inner], longitude[inner]).tolist(),
                grid.sector_of(yaw[inner]).tolist(),
                strict=True,
            ):
                rows.setdefault((cell, sector), 0.12 if street in icy else 0.6)
    cell, sector = np.array(list(rows)).T
    lower = np.array(list(rows.values()))
    return pa.table(
        {
            "cell": cell,
            "sector": sector.astype(np.int8),
            "mu_lower": lower,
            "mu_upper": lower + 0.1,
            "p_slippery": np.where(lower < 0.4, 0.99, 0.01),
            "basis": ["measured"] * len(cell),
        }
    )


def unpack_wheel(name: str, version: str, target: Path) -> None:
    """Download the wheel of a package, and unpack it into a folder without installing it."""
    words = ["--no-deps", "--python-version", "3.12", "--only-binary=:all:"]
    place = ["--dest", str(target.parent), f"{name}=={version}"]
    subprocess.run([sys.executable, "-m", "pip", "download", "--quiet", *words, *place], check=True)
    pattern = f"{name.replace('-', '_')}-*.whl"
    with zipfile.ZipFile(next(target.parent.glob(pattern))) as packed:
        packed.extractall(target)


class Valhalla:
    """Programs of the route planner Valhalla, unpacked from the wheel into a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        programs = folder / "wheel"
        if not programs.exists():
            unpack_wheel("pyvalhalla", VERSION, programs)
        self._bin = programs / "valhalla" / "bin"
        for program in self._bin.iterdir():
            program.chmod(0o755)
        self.config = folder / "valhalla.json"

    def build(self, network: Path) -> None:
        """Build Valhalla's routing tiles from a street network in OpenStreetMap XML."""
        sys.path.insert(0, str(self.folder / "wheel" / "valhalla"))
        try:
            import valhalla_build_config as made  # type: ignore[import-not-found]

            config = made.config
        finally:
            sys.path.pop(0)
        config = json.loads(json.dumps(config, default=lambda _: None))
        tiles = self.folder / "tiles"
        tiles.mkdir(exist_ok=True)
        config["mjolnir"] |= {"tile_dir": str(tiles), "concurrency": 1}
        for unused in (
            "tile_extract",
            "traffic_extract",
            "admin",
            "timezone",
            "landmarks",
            "transit_dir",
        ):
            config["mjolnir"].pop(unused, None)
        config["service_limits"] |= {
            "min_linear_cost_factor": 0.1,
            "max_linear_cost_edges": 100_000,
        }
        self.config.write_text(json.dumps(_present(config)))
        pbf = network.with_suffix(".pbf")
        _pack(network, pbf)
        self._run("valhalla_build_tiles", "-c", str(self.config), str(pbf))

    def ask(self, action: str, request: dict[str, Any]) -> dict[str, Any]:
        """Send a routing request (`action` is its kind) to the route planner Valhalla, and return
        the answer. If Valhalla finds no route, the answer has an `error_code`.
        """
        done = self._call("valhalla_service", str(self.config), action, json.dumps(request))
        line = next((line for line in done.stdout.splitlines() if line.startswith("{")), None)
        assert line is not None, (done.stdout + done.stderr)[-2000:]
        found: dict[str, Any] = json.loads(line)
        assert found.get("error_code", NO_PATH) == NO_PATH, line
        return found

    def _run(self, program: str, *arguments: str) -> None:
        done = self._call(program, *arguments)
        assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]

    def _call(self, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [str(self._bin / program), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False)


def _present(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {name: _present(one) for name, one in value.items() if one is not None}
    return value


def _pack(network: Path, pbf: Path) -> None:
    import osmium

    pbf.unlink(missing_ok=True)
    writer = osmium.SimpleWriter(str(pbf))
    for one in osmium.FileProcessor(str(network)):
        writer.add(one)
    writer.close()
