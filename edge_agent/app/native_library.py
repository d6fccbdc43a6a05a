"""`python -m edge_agent.app.native_library FILE`: compile the kernels that a running agent calls
into a shared library.

The agent then needs neither Numba nor LLVM. A process of its own builds the library before the
agent's first start, so that the agent never holds the compiler.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from schemas.runtime import progress_messages
from schemas.runtime.jit import native_library_path, use_native_kernels
from schemas.runtime.native_kernels import LINKER, Library
from schemas.runtime.process import end_with_parent


def use_agent_library() -> bool:
    """Take the kernels of this process from the agent's shared library; build it if there is none.
    Call this before other imports.

    Return False if there is no linker or no folder for the library. Numba then compiles the kernels
    in this process.
    """
    path = native_library_path("edge_agent")
    if path is None or not (path.exists() or shutil.which(LINKER)):
        return False
    if not path.exists():
        progress_messages.report_once(progress_messages.COMPILING)
        progress_messages.set_status("compiling the agent's kernels")
        build = [sys.executable, "-m", "edge_agent.app.native_library", str(path)]
        if subprocess.run(build, capture_output=True, check=False).returncode:
            return False
    try:
        use_native_kernels(Library(path))
    except OSError:
        return False
    return True


def build_agent_library(path: Path) -> None:
    """Build the agent's shared library: it contains the kernels that one step of the pipeline
    calls, with beliefs and without visits too.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or it fails.
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
    with np.errstate(all="ignore"):  # the outputs have no values, because nothing runs
        pipeline.step(Block(np.zeros((1, 1)), np.zeros((1, 1), np.int64), signals, context))
        pipeline.beliefs()
    build_library(recorder, path)


if __name__ == "__main__":
    end_with_parent()
    build_agent_library(Path(sys.argv[1]))
