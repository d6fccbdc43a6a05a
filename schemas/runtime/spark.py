"""Spark session, and distribution of tasks over a cluster.

Tasks run independently, and a task is repeated if its machine fails. Therefore a task writes each
file under a temporary name first, and renames it to a name that depends on the task alone.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

import pyarrow as pa

from schemas.errors import InputError
from schemas.runtime.installing import install_command

_Task = TypeVar("_Task")
_Outcome = TypeVar("_Outcome")
_TASK: Final = pa.schema([pa.field("task", pa.binary())])
SETTINGS: Final = {
    "spark.ui.enabled": "false",
    "spark.sql.session.timeZone": "UTC",
    "spark.sql.execution.arrow.pyspark.enabled": "true",
    # Ibis computes 0/0 for empty groups, which ANSI mode treats as an error.
    "spark.sql.ansi.enabled": "false",
}


def open_session(*, progress: bool = False) -> Any:  # noqa: ANN401 pyspark has no types
    """Return the Spark session of this process. It uses the cluster that spark-submit or Spark's
    settings name, or else this machine.

    Raises:
        InputError: Spark or Java is missing.
    """
    try:
        from pyspark.errors import PySparkRuntimeError
        from pyspark.sql import SparkSession
    except ImportError as error:
        raise InputError("engine", "Spark is not installed", install_command("spark")) from error
    # The workers must use the Python of this environment, which contains the package.
    os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    builder = SparkSession.builder.appName("gripmap")
    for key, value in (*SETTINGS.items(), ("spark.ui.showConsoleProgress", str(progress).lower())):
        builder = builder.config(key, value)
    try:
        return builder.getOrCreate()
    except PySparkRuntimeError as error:
        raise InputError(
            "engine", "Spark does not start", "install Java 17 or 21, or set JAVA_HOME"
        ) from error


def run_tasks(
    session: Any,  # noqa: ANN401 pyspark has no types
    tasks: Sequence[_Task],
    work: Callable[[_Task], _Outcome],
) -> list[_Outcome]:
    """Run `work` for all tasks, each as one Spark task; return the results ("outcomes") in the
    order of the tasks.

    A failed task is repeated up to `spark.task.maxFailures` times. The result of a failed attempt
    is ignored, so that each task has exactly one outcome.

    Args:
        session: Spark session.
        tasks: arguments of `work`; picklable.
        work: function that processes one task; it must belong to a module that is installed on all
            machines, or be a partial of such a function.

    Raises:
        InputError: raised by a task; such a task is not repeated.
    """
    from py4j.protocol import Py4JError
    from pyspark.errors import PySparkException
    from pyspark.sql.pandas.types import from_arrow_schema

    if not tasks:
        return []

    def run_batches(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        for batch in batches:
            for number, task in _unpack_column(batch["task"]):
                try:
                    outcome: object = work(task)
                except InputError as error:
                    outcome = error
                yield pa.record_batch(
                    [pa.array([pickle.dumps((number, outcome))], pa.binary())], schema=_TASK
                )

    packed = [pickle.dumps(numbered) for numbered in enumerate(tasks)]
    frame = session.createDataFrame(pa.table([pa.array(packed, pa.binary())], schema=_TASK))
    # `repartition` distributes the rows of a single partition in turn, so that each partition gets
    # one task.
    each = frame.coalesce(1).repartition(len(tasks))
    try:
        answers: pa.Table = each.mapInArrow(run_batches, from_arrow_schema(_TASK)).toArrow()
    except (PySparkException, Py4JError) as error:
        problem = str(error).strip().partition("\n")[0][:200]
        raise InputError(
            "engine",
            f"Spark gave up: {problem}",
            "its log gives the reason; finished parts are kept",
        ) from error
    outcomes = dict(_unpack_column(answers["task"]))
    for outcome in outcomes.values():
        if isinstance(outcome, InputError):
            raise outcome
    return [outcomes[number] for number in range(len(tasks))]


def _unpack_column(column: Any) -> Iterator[tuple[int, Any]]:  # noqa: ANN401 an Arrow array
    """Unpickle each value of a column of bytes, and yield the resulting pairs. In the input of a
    Spark job, a pair is the number of a task and the task itself. In the output, it is the number
    of a task and its outcome.
    """
    return (pickle.loads(one) for one in column.to_pylist())
