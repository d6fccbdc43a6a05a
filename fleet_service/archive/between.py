"""Which rows are wanted, by the range of a column: what a file's statistics can tell before anything is read.

Ranges and not expressions of Arrow's, whose machinery brings pandas along: 40 MB of a process, and a scan that holds
several row groups whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

Bound = int | float | str | None


class Between(NamedTuple):
    """Rows whose value lies from `least` to `most`, both included; None: without an end. Times are whole microseconds.
    A row without a value is not wanted."""

    column: str
    least: Bound = None
    most: Bound = None


Where = Sequence[Between]


def those(table: pa.Table, where: Where) -> pa.Table:
    """The rows of a table that are wanted; it has all of the columns."""
    for column, least, most in where:
        values = table[column]
        if pa.types.is_timestamp(values.type):
            values = values.cast(pa.int64())
        for compare, bound in ((pc.greater_equal, least), (pc.less_equal, most)):
            if bound is not None:
                mask = compare(values, pa.scalar(bound, values.type))
                table, values = table.filter(mask), values.filter(mask)
    return table


def groups(footer: pq.FileMetaData, where: Where) -> list[int]:
    """Row groups of a file that may hold rows that are wanted, by their statistics."""
    places = {footer.schema.column(at).path: at for at in range(footer.num_columns)}
    known = [(places[one.column], one) for one in where if one.column in places]
    return [
        group
        for group in range(footer.num_row_groups)
        if all(_may(footer.row_group(group).column(at).statistics, one) for at, one in known)
    ]


def _may(statistics: Any, wanted: Between) -> bool:  # noqa: ANN401 pyarrow's has no name
    if statistics is None or not statistics.has_min_max:
        return True
    least, most = (bound.encode() if isinstance(bound, str) else bound for bound in wanted[1:])
    return (most is None or statistics.min_raw <= most) and (least is None or statistics.max_raw >= least)
