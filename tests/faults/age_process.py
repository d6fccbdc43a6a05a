"""`python -m tests.faults.age_process WHAT ARCHIVE`: one operation of a service in a separate
process that measures itself.

`ready` starts a service from the archive, `checkpoint` also writes a checkpoint (saved state), and
`past` answers the query on stdin. The process prints its time [s] and its peak memory [MB].
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import closing
from io import BytesIO
from pathlib import Path

from fleet_service.app import UNUSED
from schemas.runtime.process import limit_memory


def main() -> None:
    """Run the chosen operation of a service on an archive, and print its time [s] and peak memory
    [MB].
    """
    what = sys.argv[1]
    root = Path(sys.argv[2])
    began = time.perf_counter()
    limit_memory(*UNUSED)
    found = _answer_past(root) if what == "past" else _start_engine(root, what == "checkpoint")
    print(json.dumps({"seconds": time.perf_counter() - began, "mb": _most_mb(), **found}))


def _answer_past(root: Path) -> dict[str, float]:
    from fleet_service.app.historical_maps import answer_line

    out = BytesIO()
    answer_line(root, sys.stdin.buffer.read(), out)
    return {"bytes": len(out.getvalue())}


def _start_engine(root: Path, and_checkpoint: bool) -> dict[str, float]:
    from fleet_service.app.engine import Engine
    from schemas.config import ServiceConfig
    from tests.fleet_service.checkpoint_writer import save_checkpoint

    with closing(Engine(ServiceConfig(), root)) as engine:
        if and_checkpoint:
            save_checkpoint(engine)
        return {"cells": engine.state.fusion.size, "processor_s": time.process_time()}


def _most_mb() -> float:
    """Return the peak memory of this process [MB]. `getrusage` is not used because its value
    includes the parent process.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


if __name__ == "__main__":
    main()
