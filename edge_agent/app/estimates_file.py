"""File with the estimates of one vehicle: the columns of `schemas.tables.ESTIMATES`, one row per
sample.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from edge_agent.app.mcap_file import McapTableWriter
from edge_agent.app.output_path import prepare_path
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.durable import open_durably
from schemas.signals import per_wheel
from schemas.tables import ESTIMATES_SCHEMA

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates

ENDINGS: Final[dict[str, Any]] = {
    "": pq.ParquetWriter,
    ".parquet": pq.ParquetWriter,
    ".csv": pacsv.CSVWriter,
    ".mcap": McapTableWriter,
}
WHEEL_COLUMNS = tuple(
    f"{wheel}{end}" for wheel in per_wheel("mu") for end in ("", "_lower", "_upper")
)


def write_table(field: str, path: Path, table: pa.Table) -> None:
    """Write a table atomically in the format given by the path's suffix.

    Raises:
        InputError: the path cannot be written, or its suffix is not one of ENDINGS.
    """
    with (
        open_durably(prepare_path(field, path)) as file,
        _table_writer(path, field)(file, table.schema) as writer,
    ):
        writer.write_table(table)


def _table_writer(path: Path, field: str = "out") -> Any:  # noqa: ANN401 an Arrow class
    if path.suffix not in ENDINGS:
        problem = f"{path.name} has no known ending"
        fix = f"use one of {', '.join(name for name in ENDINGS if name)}"
        raise InputError(field, problem, fix)
    return ENDINGS[path.suffix]


class EstimatesFile:
    """Writer of a file of estimates, which receives the samples block by block. The file gets its
    final name only when it is complete.

    Raises:
        InputError: the path cannot be written, or its suffix is not one of ENDINGS.
    """

    def __init__(self, path: Path) -> None:
        with ExitStack() as opened:
            writer = _table_writer(path)
            file = opened.enter_context(open_durably(prepare_path("out", path)))
            self._writer = opened.enter_context(writer(file, ESTIMATES_SCHEMA))
            self._opened = opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._opened.__exit__(kind, error, trace)

    def write(self, t: FloatArray, estimates: Estimates) -> None:
        """Add a block of T samples to the file: times t (T, 1) and the estimates of an estimator
        for one vehicle.
        """
        self._writer.write_table(estimates_table(t, estimates))


def estimates_table(t: FloatArray, estimates: Estimates) -> pa.Table:
    """Return estimates (T, 1) as a table of ESTIMATES_SCHEMA. The columns with one value per wheel
    are null if the estimator uses a single friction value for all wheels.
    """
    wheels = estimates.mu_wheel
    columns: list[Any] = []
    for field in ESTIMATES_SCHEMA:
        if field.name == "t":
            columns.append(pa.array(t[:, 0], field.type))
        elif field.name not in WHEEL_COLUMNS:
            columns.append(pa.array(getattr(estimates, field.name)[:, 0], field.type))
        elif wheels is None:
            columns.append(pa.nulls(len(t), field.type))
        else:
            wheel, end = divmod(WHEEL_COLUMNS.index(field.name), 3)
            columns.append(pa.array(np.ascontiguousarray(wheels[:, 0, wheel, end]), field.type))
    return pa.Table.from_arrays(columns, schema=ESTIMATES_SCHEMA)
