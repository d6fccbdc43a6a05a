"""Shared libraries of a program's kernels (compiled functions) inside the installed package. With
them, the first start needs neither Numba nor a linker.

There is one library for each level of the x86-64 architecture in FEATURES. The name of a library
contains a digest of the sources, and the level.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from schemas.runtime.jit import describe_sources, list_processor_lines
from schemas.runtime.progress_messages import report

LEVEL_3: Final = (
    "abm avx avx2 bmi1 bmi2 cx16 f16c fma lahf_lm movbe popcnt sse4_1 sse4_2 ssse3 xsave"
)
# Processor features of each level by their names in /proc/cpuinfo, the fastest level first.
FEATURES: Final = {
    "x86-64-v4": f"{LEVEL_3} avx512bw avx512cd avx512dq avx512f avx512vl",
    "x86-64-v3": LEVEL_3,
}


def read_processor_features() -> set[str]:
    """Return the features of this machine's processor, in the words of /proc/cpuinfo."""
    return {word for line in list_processor_lines() for word in line.split()}


def find_shipped_library(package: str, folder: Path, features: Iterable[str]) -> Path | None:
    """Return the path of the fastest library in `folder` for the present source files of `package`
    and a processor with these `features`; None if none is suitable. Report the reason if the folder
    contains only unsuitable libraries.
    """
    libraries = set(folder.glob("*.so"))
    sources = describe_sources(package)
    available = set(features)
    for level, needed in FEATURES.items():
        path = folder / f"{sources}-{level}.so"
        if path in libraries and available.issuperset(needed.split()):
            return path
    if libraries:
        fits = any(path.name.startswith(sources) for path in libraries)
        reason = "this processor lacks instructions" if fits else "they are for other sources"
        report(f"kernels in {folder}: not used, because {reason}")
    return None


def build_shipped_libraries(package: str, folder: Path, builder: str, *words: str) -> None:
    """Build the shared libraries of `package` in `folder`, one process per level of the processor
    architecture. `python -m builder FILE`, followed by `words`, builds one. Libraries that are
    there already are removed first.

    On a processor that is not x86-64, build nothing; the program then compiles its kernels at its
    first start.

    Raises:
        subprocess.CalledProcessError: a process has failed; it has printed the reason.
    """
    if platform.machine() != "x86_64":
        print(f"no kernels are shipped for {platform.machine()}", file=sys.stderr)
        return
    print(f"building kernels in {folder}: takes a minute or two", file=sys.stderr, flush=True)
    for old in folder.glob("*.so"):
        old.unlink()
    sources = describe_sources(package)
    with tempfile.TemporaryDirectory() as cache:
        own = os.environ | {"NUMBA_CACHE_DIR": cache, "NUMBA_CPU_FEATURES": ""}
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", builder, f"{folder / sources}-{level}.so", *words],
                env=own | {"NUMBA_CPU_NAME": level},
            )
            for level in FEATURES
        ]
        codes = [process.wait() for process in processes]
    for process, code in zip(processes, codes, strict=True):
        if code:
            raise subprocess.CalledProcessError(code, process.args)
