"""`make package`: build sdist and wheels, and try the wheel for this machine in a fresh environment
outside the source tree.

The wheel is tried with each Python version of VERSIONS that this machine has, on the PATH or in
pyenv, with as many at the same time as there are cores. Missing versions are printed. `--python`
adds interpreters.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.platform_wheel import build_packages
from tests.structure import ROOT

FIRST_USE = """
import gripmap
assert {"schemas", "edge_agent", "fleet_service", "deploy"} == set(gripmap.PACKAGES)
import deploy, edge_agent, fleet_service, schemas
from importlib.metadata import metadata
about = metadata("gripmap")
assert about["License-Expression"] == "Apache-2.0", about
assert about["Summary"] and about["Description"], about
from pathlib import Path
for package in (schemas, edge_agent, fleet_service, deploy):
    assert (Path(package.__file__).parent / "py.typed").is_file(), package
"""
# The wheel's native kernels must give the same estimates as kernels that Numba compiles here.
NATIVE = """
import sys
from edge_agent.app.native_library import LIBRARY, use_agent_library
from schemas.runtime.shipped_library import find_shipped_library, read_processor_features
if find_shipped_library("edge_agent", LIBRARY.shipped, read_processor_features()) is None:
    sys.exit(print("the wheel has no kernels for this processor"))
assert use_agent_library()
import numpy as np, pyarrow.parquet
from edge_agent import estimate, load_vehicle, read_log
made = estimate(read_log("drive.parquet"), load_vehicle("car.json"))
by_numba = pyarrow.parquet.read_table("estimates.parquet")
for name in ("mu", "mu_lower", "mu_upper"):
    np.testing.assert_allclose(made[name].to_numpy(), by_numba[name].to_numpy(), rtol=1e-5)
assert "numba" not in sys.modules
"""
# A service of the wheel needs neither Numba nor a linker, unless the processor has other features.
NATIVE_SERVICE = """
import sys
from fleet_service.app.native_library import LIBRARY, use_service_library
from schemas.runtime.shipped_library import find_shipped_library, read_processor_features
if find_shipped_library("fleet_service", LIBRARY.shipped, read_processor_features()) is None:
    sys.exit(print("the wheel has no kernels for this processor"))
assert use_service_library()
from fleet_service.app.precompile import exercise_map
exercise_map()
assert "numba" not in sys.modules
"""
# A foreign folder of this name hides the installed package. The import of each module listed here
# must then report this.
HIDING = {
    "schemas": ("gripmap", "edge_agent", "fleet_service"),
    "deploy": ("gripmap",),
}
VERSIONS = ("3.11", "3.12", "3.13")
WORKS = "import ensurepip, sys, venv; print('%d.%d' % sys.version_info[:2])"


def find_interpreters() -> list[str]:
    """Return the commands of the Python versions in VERSIONS that work on this machine. Print the
    other versions, and why they are left out.
    """
    found = []
    for version in VERSIONS:
        why = "no such command on this machine"
        for python in list_candidates(version):
            completed = subprocess.run(
                [python, "-c", WORKS], capture_output=True, text=True, check=False, timeout=60
            )
            if completed.stdout.strip() == version:
                found.append(python)
                break
            last = ((completed.stderr or completed.stdout).strip() or "says nothing").splitlines()[
                -1
            ]
            why = f"{python} does not work ({last[:100]})"
        else:
            print(f"python{version} skipped: {why}", flush=True)
    return found


def list_candidates(version: str) -> list[str]:
    """Return possible commands of a Python version: this interpreter, the command of that name, and
    the versions installed by pyenv.
    """
    this = sys.executable if version == ".".join(map(str, sys.version_info[:2])) else None
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    return [
        *([this] if this else []),
        *([command] if (command := shutil.which(f"python{version}")) else []),
        *sorted(map(str, kept.glob(f"{version}.*/bin/python"))),
    ]


def main() -> int:
    """Build the packages, install the wheel and use it. Return 1 and print the reason if a step
    fails.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.packaging", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--python",
        nargs="*",
        help=f"interpreters (default: {', '.join(VERSIONS)} where there are such)",
    )
    pythons = parser.parse_args().python or find_interpreters()
    if not pythons:
        raise SystemExit(f"none of {', '.join(VERSIONS)} works here")
    with tempfile.TemporaryDirectory() as folder:
        wheel = build_packages(Path(folder) / "dist")
        places = [Path(folder) / f"use{number}" for number in range(len(pythons))]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(install_and_use, pythons, [wheel] * len(pythons), places))
    return 0


def install_and_use(python: str, wheel: Path, folder: Path) -> None:
    """Install the wheel for an interpreter, and run the first steps of a new user in an empty
    folder.
    """
    folder.mkdir()
    run_command([python, "-m", "venv", folder / "venv"], folder)
    scripts = folder / "venv" / "bin"
    install: list[str | Path] = [
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--constraint",
        ROOT / "constraints.txt",
        wheel,
    ]
    run_command([scripts / "python", "-m", "pip", *install], folder)
    run_command([scripts / "python", "-c", FIRST_USE], folder)
    log: list[str | Path] = ["--out", "drive.parquet", "--vehicle-out", "car.json"]
    run_command([scripts / "edge-agent", "simulate", "slalom", "--mu", ".6", *log], folder)
    run_command(
        [
            scripts / "edge-agent",
            "replay",
            "drive.parquet",
            "--vehicle",
            "car.json",
            "--out",
            "estimates.parquet",
        ],
        folder,
    )
    run_command([scripts / "python", "-c", NATIVE], folder)
    run_command([scripts / "python", "-c", NATIVE_SERVICE], folder)
    run_command([scripts / "fleet-service", "--help"], folder)
    for name, imports in HIDING.items():
        own = folder / f"own-{name}" / name
        own.mkdir(parents=True)
        (own / "__init__.py").touch()
        for module in imports:
            hidden = subprocess.run(
                [scripts / "python", "-c", f"import {module}"],
                cwd=own.parent,
                capture_output=True,
                text=True,
                check=False,
                timeout=60,
            )
            if (
                hidden.returncode == 0
                or str(own) not in hidden.stderr
                or "rename it" not in hidden.stderr
            ):
                raise SystemExit(
                    f"a package `{name}` of the user's own is not named: {hidden.stderr}"
                )


def run_command(command: list[str | Path], folder: Path) -> None:
    """Run a command in a folder and print its duration. Raise SystemExit with the command's output
    if it fails.
    """
    began = time.monotonic()
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    line = " ".join(
        Path(str(part)).name if "/" in str(part) else str(part) for part in command
    ).split("\n")[0]
    print(f"{time.monotonic() - began:6.1f} s  {folder.name}: {line[:100]}", flush=True)
    if done.returncode != 0:
        raise SystemExit(f"{done.stdout}\n{done.stderr}")


if __name__ == "__main__":
    sys.exit(main())
