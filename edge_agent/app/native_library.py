"""`python -m edge_agent.app.native_library [FILE]`: compile the kernels (compiled numerical
functions) that a running agent calls, and write them into the shared library FILE. Without FILE,
write the libraries that the installed package contains, one per level of the x86-64 architecture.

The agent then needs neither Numba nor LLVM. If the package has no library for this machine, a
separate process builds one before the agent's first start, so that the agent never has the compiler
in its memory.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from edge_agent.app.shipped_library import (
    BUILD,
    SHIPPED,
    build_shipped_libraries,
    find_shipped_library,
    read_processor_features,
)
from schemas.runtime import progress_messages
from schemas.runtime.jit import native_library_path, use_native_kernels
from schemas.runtime.native_kernels import LINKER, Library
from schemas.runtime.process import end_with_parent


def use_agent_library() -> bool:
    """Take the kernels (compiled functions) of this process from the agent's shared library. It is
    the library of the package if one suits this machine, else a library that was built on this
    machine, now or at an earlier start. Call this before other imports.

    Return True if the library is used. Return False if there is no linker or no folder for the
    library; Numba then compiles the kernels.
    """
    shipped = find_shipped_library(SHIPPED, read_processor_features())
    if shipped is not None and _load_library(shipped):
        return True
    path = native_library_path("edge_agent")
    if path is None or not (path.exists() or shutil.which(LINKER)):
        return False
    if not path.exists():
        progress_messages.report_once(progress_messages.COMPILING)
        progress_messages.set_status("compiling the agent's kernels")
        build = [sys.executable, "-m", BUILD, str(path)]
        if subprocess.run(build, capture_output=True, check=False).returncode:
            return False
    return _load_library(path)


def _load_library(path: Path) -> bool:
    """Take the kernels (compiled functions) of this process from the library at `path`, and return
    True. If the operating system refuses to load the library, report the reason and return False.
    """
    try:
        use_native_kernels(Library(path))
    except OSError as error:
        progress_messages.report(f"kernels in {path}: not used, because of an error: {error}")
        return False
    return True


def build_agent_library(path: Path) -> None:
    """Build the agent's shared library `path`. The library contains the kernels (compiled
    functions) that a pipeline with one vehicle calls to process a sample and to return its friction
    beliefs.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or the linker fails.
    """
    from schemas.runtime.native_build import CallRecorder, build_library

    recorder = CallRecorder()
    use_native_kernels(recorder)
    import numpy as np

    from edge_agent.app.estimator_factory import bank_of
    from edge_agent.inputs.block import Block
    from edge_agent.observe.pipeline import Pipeline
    from schemas.config import AgentConfig
    from schemas.signals import CHANNELS, CONTEXT
    from schemas.vehicle import load_vehicle

    config = AgentConfig()
    pipeline = Pipeline(bank_of(config.estimator, [load_vehicle("class:compact")]), 1, config)
    signals = np.full((1, 1, len(CHANNELS)), np.nan)
    context = np.full((1, 1, len(CONTEXT)), np.nan)
    with np.errstate(all="ignore"):  # outputs are undefined, because kernels are only recorded
        pipeline.step(Block(np.zeros((1, 1)), np.zeros((1, 1), np.int64), signals, context))
        pipeline.beliefs()
    build_library(recorder, path)


if __name__ == "__main__":
    end_with_parent()
    if sys.argv[1:]:
        build_agent_library(Path(sys.argv[1]))
    else:
        build_shipped_libraries()
