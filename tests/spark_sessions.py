"""Local Spark sessions that retry a task as clusters do, and tasks whose process dies at the first
try.
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
    """A session of Spark on so many cores, in the place of any other of this process."""
    from pyspark.sql import SparkSession

    if (other := SparkSession.getActiveSession()) is not None:
        other.stop()  # it would be taken, with its own cores
    os.environ.setdefault(
        "PYSPARK_PYTHON", sys.executable
    )  # as `spark.session` does, for what it then finds
    # of the environment, Spark looks only at what it holds when its Java starts: the second session
    # would be the first
    builder = SparkSession.builder.master(f"local[{count},{TRIES}]").config(
        "spark.ui.showConsoleProgress", "false"
    )
    found = builder.config(map={**spark.SETTINGS}).getOrCreate()
    try:
        yield spark.session()
    finally:
        found.stop()


def killed_at_first(
    work: Callable[[_Task], _Outcome], name_of: Callable[[_Task], str], tries: Path
) -> Callable[[_Task], _Outcome]:
    """Run the same work, but kill its process after the first try at each task. `tries` stores the
    names of tasks.
    """
    tries.mkdir()

    def work_or_die(task: _Task) -> _Outcome:
        outcome = work(task)
        if not (mark := tries / name_of(task)).exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return outcome

    return work_or_die
