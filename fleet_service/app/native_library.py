"""`python -m fleet_service.app.native_library [FILE [CALLS]]`: compile the kernels (compiled
functions) of a running service, and write them into the shared library FILE. Without FILE, write
the libraries that the installed package contains, one per level of the x86-64 architecture. The
file CALLS lists the kernels; without it, they are recorded first.

The service then needs neither Numba nor LLVM, which saves 100 MB of memory and a second of each
start.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from schemas.runtime.jit import use_native_kernels
from schemas.runtime.kernel_library import KernelLibrary
from schemas.runtime.process import end_with_parent

RECORD: Final = (
    "import sys; from pathlib import Path; from fleet_service.app.native_library import "
    "record_calls; record_calls(Path(sys.argv[1]))"
)
LIBRARY: Final = KernelLibrary(
    "fleet_service", "fleet_service.app.native_library", Path(__file__).parents[1] / "kernels"
)


def use_service_library() -> bool:
    """Take the kernels of this process from the service's shared library. Call this before other
    imports. Return False if there is none, see `KernelLibrary.use`.
    """
    return LIBRARY.use()


def build_service_library(path: Path, calls: Path) -> None:
    """Build the service's shared library `path`. The library contains the kernels whose calls the
    file `calls` lists.

    This process may compile for a processor with instructions that the processor of this machine
    lacks. Therefore it does not run the kernels.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or the linker fails.
        TypeError: a kernel allocates memory.
    """
    from schemas.runtime.native_build import CallRecorder, build_library

    recorder = CallRecorder()
    use_native_kernels(recorder)
    recorder.load_calls(calls)
    build_library(recorder, path)


@contextmanager
def recorded_calls() -> Iterator[Path]:
    """Yield a file with the calls of kernels by `precompile.exercise_map`. A separate process
    records them, because it runs the kernels.

    Raises:
        subprocess.CalledProcessError: the process has failed; it has printed the reason.
    """
    with tempfile.TemporaryDirectory() as folder:
        calls = Path(folder) / "calls"
        subprocess.run([sys.executable, "-c", RECORD, str(calls)], check=True)
        yield calls


def record_calls(path: Path) -> None:
    """Run `precompile.exercise_map`, and write the calls of kernels to the file `path`."""
    from schemas.runtime.native_build import CallRecorder

    recorder = CallRecorder(runs=True)
    use_native_kernels(recorder)
    from fleet_service.app.precompile import exercise_map

    exercise_map()
    recorder.save_calls(path)


if __name__ == "__main__":
    end_with_parent()
    if sys.argv[2:]:
        build_service_library(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        with recorded_calls() as recorded:
            if sys.argv[1:]:
                build_service_library(Path(sys.argv[1]), recorded)
            else:
                LIBRARY.build_shipped(str(recorded))
