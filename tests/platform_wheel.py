"""Build sdist and wheel, and on x86-64 also a wheel with the compiled kernels of agent and
service.

The wheels are built from the sdist, so that a file missing in the sdist is noticed. An installer
chooses the wheel with kernels where it fits; the other one is for all other machines.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from edge_agent.app.native_library import LIBRARY as AGENT
from fleet_service.app.native_library import LIBRARY as SERVICE
from schemas.runtime.kernel_library import KernelLibrary
from tests.structure import ROOT


def build_packages(out: Path) -> Path:
    """Build sdist and wheels into a folder, and return the path of the wheel for this machine.

    Raises:
        subprocess.CalledProcessError: a step fails.
    """
    build = [sys.executable, "-m", "build", "--outdir", str(out)]
    subprocess.run([*build, str(ROOT)], cwd=ROOT, check=True)
    sdist = find_newest(out, "*.tar.gz")
    if platform.machine() != "x86_64":
        return find_newest(out, "*.whl")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(sdist) as packed:
            packed.extractall(folder, filter="data")
        (source,) = Path(folder).iterdir()
        own = os.environ | {"PYTHONPATH": str(source)}

        def build_kernels(library: KernelLibrary) -> None:
            command = [sys.executable, "-m", library.builder]
            subprocess.run(command, cwd=source, env=own, check=True)

        with ThreadPoolExecutor() as pool:
            list(pool.map(build_kernels, (AGENT, SERVICE)))
        tag = platform_tag(b"".join(path.read_bytes() for path in source.rglob("*.so")))
        option = f"--config-setting=--build-option=--plat-name={tag}"
        subprocess.run([*build, "--wheel", option, str(source)], cwd=source, check=True)
    return find_newest(out, f"*{tag}.whl")


def find_newest(folder: Path, pattern: str) -> Path:
    """Return the newest file in a folder whose name matches a pattern."""
    return max(folder.glob(pattern), key=lambda path: path.stat().st_mtime)


def platform_tag(code: bytes) -> str:
    """Return the platform tag (PEP 600) of a wheel that contains the machine code `code`. The tag
    names the oldest C library that has all functions which this code calls.
    """
    versions = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", code)]
    return f"manylinux_2_{max(versions)}_x86_64"
