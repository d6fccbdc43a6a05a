"""Local Spark sessions that repeat failed tasks as a cluster does, and tasks whose process is
killed at the first attempt.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from schemas.runtime import spark

_Task = TypeVar("_Task")
_Outcome = TypeVar("_Outcome")
TRIES = 3


@contextmanager
def spark_session(count: int) -> Iterator[Any]:
    """Yield a Spark session with `count` cores. It replaces any other session of this process."""
    from pyspark.sql import SparkSession

    if (other := SparkSession.getActiveSession()) is not None:
        other.stop()  # an active session would be reused with its own number of cores
    # `spark.open_session` uses the same setting.
    os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    # Spark reads the environment only when its Java process starts. Otherwise the second session
    # would equal the first one.
    builder = SparkSession.builder.master(f"local[{count},{TRIES}]").config(
        "spark.ui.showConsoleProgress", "false"
    )
    found = builder.config(map={**spark.SETTINGS}).getOrCreate()
    try:
        yield spark.open_session()
    finally:
        found.stop()


def killed_at_first(
    work: Callable[[_Task], _Outcome], name_of: Callable[[_Task], str], tries: Path
) -> Callable[[_Task], _Outcome]:
    """Return a function that does the same as `work`, but kills its process at the first attempt of
    each task.

    Args:
        work: function of a task.
        name_of: function that returns a task's name.
        tries: folder that records the names of attempted tasks.
    """
    tries.mkdir()

    def work_or_die(task: _Task) -> _Outcome:
        outcome = work(task)
        if not (mark := tries / name_of(task)).exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return outcome

    return work_or_die
