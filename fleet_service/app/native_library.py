"""`python -m fleet_service.app.native_library [FILE]`: compile the kernels (compiled functions) of
a running service, and write them into the shared library FILE. Without FILE, write the libraries
that the installed package contains, one per level of the x86-64 architecture.

The service then needs neither Numba nor LLVM, which saves 100 MB of memory and a second of each
start.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from schemas.runtime.jit import use_native_kernels
from schemas.runtime.kernel_library import KernelLibrary
from schemas.runtime.process import end_with_parent

RECORD: Final = (
    "import sys; from pathlib import Path; from fleet_service.app.native_library import "
    "record_calls; record_calls(Path(sys.argv[1]))"
)
# Variables with which Numba compiles for another processor than that of this machine.
OTHER_PROCESSOR: Final = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
LIBRARY: Final = KernelLibrary(
    "fleet_service", "fleet_service.app.native_library", Path(__file__).parents[1] / "kernels"
)


def use_service_library() -> bool:
    """Take the kernels (compiled functions) of this process from the service's shared library. Call
    this before other imports. Return False if there is none, see `KernelLibrary.use`.
    """
    return LIBRARY.use()


def build_service_library(path: Path) -> None:
    """Build the service's shared library `path`. The library contains the kernels (compiled
    functions) that `precompile.exercise_map` calls.

    A separate process records the calls, because it runs the kernels. This process may compile them
    for a processor with instructions that the processor of this machine lacks.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or a step fails.
        TypeError: a kernel allocates memory.
    """
    from schemas.runtime.native_build import CallRecorder, build_library

    recorder = CallRecorder()
    use_native_kernels(recorder)
    with tempfile.TemporaryDirectory() as folder:
        calls = Path(folder) / "calls"
        own = {name: value for name, value in os.environ.items() if name not in OTHER_PROCESSOR}
        subprocess.run([sys.executable, "-c", RECORD, str(calls)], env=own, check=True)
        recorder.load_calls(calls)
    build_library(recorder, path)


def record_calls(path: Path) -> None:
    """Run `precompile.exercise_map`, and write the calls of kernels (compiled functions) to the
    file `path`.
    """
    from schemas.runtime.native_build import CallRecorder

    recorder = CallRecorder(runs=True)
    use_native_kernels(recorder)
    from fleet_service.app.precompile import exercise_map

    exercise_map()
    recorder.save_calls(path)


if __name__ == "__main__":
    end_with_parent()
    if sys.argv[1:]:
        build_service_library(Path(sys.argv[1]))
    else:
        LIBRARY.build_shipped()
