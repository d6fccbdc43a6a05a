"""`python -m edge_agent.app.native_library [FILE]`: compile the kernels (compiled numerical
functions) that a running agent calls, and write them into the shared library FILE. Without FILE,
write the libraries that the installed package contains, one per level of the x86-64 architecture.

The agent then needs neither Numba nor LLVM. If the package has no library for this machine, a
separate process builds one before the agent's first start, so that the agent never has the compiler
in its memory.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from schemas.runtime.jit import use_native_kernels
from schemas.runtime.kernel_library import KernelLibrary
from schemas.runtime.process import end_with_parent

LIBRARY: Final = KernelLibrary(
    "edge_agent", "edge_agent.app.native_library", Path(__file__).parents[1] / "kernels"
)


def use_agent_library() -> bool:
    """Take the kernels of this process from the agent's shared library. Call this before other
    imports. Return False if there is none, see `KernelLibrary.use`.
    """
    return LIBRARY.use()


def build_agent_library(path: Path) -> None:
    """Build the agent's shared library `path`. The library contains the kernels that a pipeline
    with one vehicle calls to process a sample and to return its friction beliefs, and those that
    correct a sample.

    Raises:
        OSError, subprocess.CalledProcessError: there is no linker, or the linker fails.
    """
    from schemas.runtime.native_build import CallRecorder, build_library

    recorder = CallRecorder()
    use_native_kernels(recorder)
    import numpy as np

    from edge_agent.app.estimator_factory import bank_of
    from edge_agent.inputs.block import Block
    from edge_agent.inputs.driving_direction import sign_wheels
    from edge_agent.observe.pipeline import Pipeline
    from schemas.config import AgentConfig
    from schemas.signals import CHANNELS, CONTEXT
    from schemas.vehicle import load_vehicle

    config = AgentConfig()
    vehicle = load_vehicle("class:compact")
    pipeline = Pipeline(bank_of(config.estimator, [vehicle]), 1, config)
    signals = np.full((1, 1, len(CHANNELS)), np.nan)
    context = np.full((1, 1, len(CONTEXT)), np.nan)
    with np.errstate(all="ignore"):  # outputs are undefined, because kernels are only recorded
        pipeline.step(Block(np.zeros((1, 1)), np.zeros((1, 1), np.int64), signals, context))
        pipeline.beliefs()
        sign_wheels(np.zeros(1), signals[:, 0], vehicle)
    build_library(recorder, path)


if __name__ == "__main__":
    end_with_parent()
    if sys.argv[1:]:
        build_agent_library(Path(sys.argv[1]))
    else:
        LIBRARY.build_shipped()
